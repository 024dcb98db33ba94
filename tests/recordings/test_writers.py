"""Test the writers of all forms: the pieces in which events come change nothing; what is wrong leaves no part."""

from __future__ import annotations

import json
import resource
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from v2v_protocol.errors import UsageError, V2VError
from v2v_protocol.events import EventList
from v2v_recordings import writers
from v2v_recordings.items import ConvertOptions, EventChunk, FlowField, Picture, SensorSize
from v2v_recordings.reading import read_items
from v2v_recordings.writers import EVENT_FORMS, PLANES, open_writer

WIDTH, HEIGHT = SIZE = 24, 16
WITH_PLANES = [form for form, each in EVENT_FORMS.items() if each.planes]


def some_events(count: int, seed: int, most_us: int = 300_000) -> EventList:
    random = np.random.default_rng(seed)
    t = np.sort(random.integers(0, most_us, count))
    t[:1], t[-1:] = 0, most_us - 1  # readers refuse pictures at times long before or after all events
    x, y = (random.integers(0, side, count).astype(np.uint16) for side in SIZE)
    return EventList(x, y, t, random.random(count) < 0.5, *SIZE)


def part(events: EventList, first: int, last: int | None) -> EventList:
    return EventList(*(getattr(events, name)[first:last] for name in "xytp"), WIDTH, HEIGHT)


def plane(kind: str, number: int) -> npt.NDArray[Any]:
    dtype, axes = PLANES[kind]
    return np.random.default_rng(number).integers(0, 200, (*axes, HEIGHT, WIDTH)).astype(dtype)


def named(folder: Path, form: str, name: str = "a") -> Path:
    return folder / f"{name}{EVENT_FORMS[form].ending}"


def write(path: Path, form: str, pieces: list[EventList], pictures: int = 0, at: tuple[int, ...] = ()) -> Path:
    """Write pieces, and pictures of all kinds of the form, 20 ms apart; ``at``: before which piece each one comes."""
    kinds = EVENT_FORMS[form].planes if pictures else ()
    with open_writer(path, form, SIZE, kinds) as writer:
        done = 0
        for number, piece in enumerate([*pieces, None]):
            while done < pictures and (piece is None or at[done] <= number):
                for kind in kinds:
                    writer.add_plane(kind, 20_000 * done, plane(kind, done))
                done += 1
            if piece is not None:
                writer.add(piece)
    return path


def files(path: Path) -> dict[str, bytes]:
    found = sorted(path.rglob("*")) if path.is_dir() else [path]
    return {each.name if path.is_dir() else "": each.read_bytes() for each in found}


@pytest.mark.parametrize("form", EVENT_FORMS)
@settings(max_examples=12, deadline=None)
@given(data=st.data())
def test_any_pieces_give_the_same_bytes_and_the_events_are_read_back(
    form: str, tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    """Pieces of a file hold few events here, so that theirs and those of the caller meet in every way."""
    events = some_events(data.draw(st.just(0) | st.integers(2, 300)), data.draw(st.integers(0, 99)))
    edges = sorted(data.draw(st.lists(st.integers(0, len(events)), max_size=9)))
    pieces = [part(events, first, last) for first, last in zip([0, *edges], [*edges, None], strict=True)]
    pictures = data.draw(st.integers(0, 4))
    at = tuple(sorted(data.draw(st.integers(0, len(pieces))) for _ in range(pictures)))
    folder = tmp_path_factory.mktemp("writers")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(writers, "EVENTS_AT_ONCE", 64)
        path = write(named(folder, form), form, pieces, pictures, at)
        assert files(path) == files(write(named(folder, form, "b"), form, [events], pictures, (0,) * pictures))
    assert len(list(folder.iterdir())) == 2
    items = list(read_items(path, None, ConvertOptions())) if len(events) else []
    chunks = [item for item in items if isinstance(item, EventChunk)]
    if not chunks:
        return
    back = EventChunk.join(chunks)
    np.testing.assert_array_equal(back.t_ns, events.t * 1000)
    for name in "xyp":
        np.testing.assert_array_equal(getattr(back, name), getattr(events, name))
    assert SensorSize(*SIZE) in items
    if EVENT_FORMS[form].planes:
        shown = [item for item in items if isinstance(item, Picture)]
        assert [item.t_ns for item in shown] == [20_000_000 * number for number in range(pictures)]
        for number, item in enumerate(shown):
            np.testing.assert_array_equal(item.pixels, plane("images", number))


@pytest.mark.parametrize("form", WITH_PLANES)
def test_flow_and_masks_are_kept_with_their_times(form: str, tmp_path: Path) -> None:
    path = write(named(tmp_path, form), form, [some_events(50, 1)], 3, (0, 1, 1))
    for kind in ("flow", "masks"):
        expected = [plane(kind, number) for number in range(3)]
        if form == "h5":
            with h5py.File(path) as file:
                found = [file[kind][key] for key in sorted(file[kind])]
                stamps, values = [each.attrs["timestamp"] for each in found], [each[:] for each in found]
        else:
            arrays = np.load(path) if path.is_file() else {each.stem: np.load(each) for each in path.glob("*.npy")}
            stamps, values = arrays[f"{kind}_ts"], arrays[kind]
        np.testing.assert_allclose(stamps, [0, 0.02, 0.04], atol=1e-12)
        np.testing.assert_array_equal(np.reshape(values, np.shape(expected)), expected)
    if form == "h5":
        fields = [item.flow for item in read_items(path, None, ConvertOptions()) if isinstance(item, FlowField)]
        np.testing.assert_array_equal(fields, [plane("flow", number) for number in range(3)])


def test_a_loader_as_event_flows_finds_what_it_reads(tmp_path: Path) -> None:
    """Access as its h5 loader does: seconds since t0, pictures and flow by their names, flow by its end."""
    events = some_events(500, 3, 60_000)
    with h5py.File(write(named(tmp_path, "h5"), "h5", [events], 4, (0,) * 4)) as file:
        t0, duration = file.attrs["t0"], file.attrs["duration"]
        ts = file["events/ts"][0:500]
        ts -= t0
        assert (ts[0], ts[-1]) == (0, duration)
        assert duration == pytest.approx((events.t[-1] - events.t[0]) * 1e-6)
        found: dict[str, tuple[list[str], list[float]]] = {}
        for group in ("images", "flow_dt1"):
            names: list[str] = []
            file[group].visititems(lambda name, _, names=names: names.append(name))
            found[group] = names, [file[group][name].attrs["timestamp"] for name in names]
        assert found["images"][1] == found["flow_dt1"][1] == pytest.approx([0, 0.02, 0.04, 0.06])
        names, ends = found["flow_dt1"]
        for index in range(1, 4):
            first, last = np.searchsorted(file["events/ts"], ends[index - 1 : index + 1])
            window = (events.t >= 20_000 * (index - 1)) & (events.t < 20_000 * index)
            assert last - first == window.sum() > 0
            np.testing.assert_array_equal(file["flow_dt1"][names[index]][:], plane("flow", index - 1))
        np.testing.assert_array_equal(file["events/ps"][0:500], events.p)


def test_a_data_set_as_evreals_finds_what_it_reads(tmp_path: Path) -> None:
    """Access as its memory-mapped data set does: events between pictures by their numbers, one channel."""
    events, folder = some_events(500, 4, 60_000), tmp_path / "a"
    write(folder, "evreal", [events], 4, (0,) * 4)
    images = np.load(folder / "images.npy", mmap_mode="r")
    t, xy, p = (np.load(folder / f"events_{name}.npy", mmap_mode="r").squeeze() for name in ("ts", "xy", "p"))
    indices, stamps = (
        np.load(folder / "image_event_indices.npy"),
        [each.item() for each in np.load(folder / "images_ts.npy")],
    )
    assert json.loads((folder / "metadata.json").read_text())["sensor_resolution"] == [HEIGHT, WIDTH]
    assert len(images) == len(indices) == len(stamps) == 4
    assert len(p) == len(xy) == len(t) == 500
    assert set(p * 2.0 - 1.0) == {-1.0, 1.0}
    start = 0
    for number, event_index in enumerate(indices):
        end = event_index[0]
        assert (t[start:end] < stamps[number]).all()
        assert (t[end:] >= stamps[number]).all()
        np.testing.assert_array_equal(images[number][:, :, 0], plane("images", number))
        start = end


@pytest.mark.parametrize("form", EVENT_FORMS)
def test_an_error_leaves_the_old_file_and_no_part(form: str, tmp_path: Path) -> None:
    path = named(tmp_path, form)
    if form != "evreal":  # a folder is not replaced
        write(path, form, [some_events(9, 1)])
    before = files(path) if path.exists() else {}

    def stopped() -> None:
        with open_writer(path, form, SIZE, EVENT_FORMS[form].planes) as writer:
            writer.add(some_events(200_000, 2))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        stopped()
    assert list(tmp_path.iterdir()) == ([path] if before else [])
    assert not before or files(path) == before


@pytest.mark.parametrize("form", EVENT_FORMS)
def test_a_full_disk_is_words_and_leaves_no_part(form: str, tmp_path: Path) -> None:
    """A limit of the file's size stands for it; Python ignores the signal that comes with it."""
    old = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, old[1]))
        with pytest.raises(V2VError, match=rf"{named(tmp_path, form)}: cannot be written: .*[Ll]arge"):
            write(named(tmp_path, form), form, [some_events(200_000, 2)])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, old)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("form", sorted(set(EVENT_FORMS) - set(WITH_PLANES)))
def test_a_form_without_pictures_says_which_have_them(form: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=f"{form} holds no images; give another form: h5, npz, evreal hold it"):
        open_writer(named(tmp_path, form), form, SIZE, ["images"])
    assert list(tmp_path.iterdir()) == []


def test_what_is_wrong_is_refused_in_words(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    with pytest.raises(UsageError, match="unknown form 'mp4' of events; give one of h5"):
        open_writer(path, "mp4", SIZE)
    with pytest.raises(UsageError, match="is a folder, and is not replaced"):
        open_writer(tmp_path, "npz", SIZE)
    with open_writer(path, "npz", SIZE, ["images"]) as writer:
        writer.add(some_events(9, 1))
        with pytest.raises(UsageError, match="step back behind"):
            writer.add(some_events(9, 1))
        writer.add_plane("images", 5, plane("images", 0))
        with pytest.raises(UsageError, match=r"images \[16, 24\] at 4 us; they must be \[16, 24\], in order of time"):
            writer.add_plane("images", 4, plane("images", 0))
        with pytest.raises(UsageError, match=r"images \[2, 3\] at 6 us; they must be \[16, 24\]"):
            writer.add_plane("images", 6, np.zeros((2, 3), np.uint8))
        with pytest.raises(UsageError, match="flow were not announced"):
            writer.add_plane("flow", 6, plane("flow", 0))
    assert len(np.load(path)["t"]) == 9
