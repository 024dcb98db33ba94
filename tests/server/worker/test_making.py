"""From a lease to a sample: what may be wrong with a lease of a sound server, and with the sidecars of its video."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.clips import panned_luma, write_clip
from tests.protocol.persisted_values import example
from tests.server.named_corpus import SMALL_SPEC
from v2v_protocol import sample
from v2v_protocol.errors import ProtocolError, SidecarError, VideoChanged, VideoError, VideoUnreadable
from v2v_protocol.messages import Lease, decode, encode
from v2v_protocol.sample import ArrayForm, Needs, Refusal, Sample
from v2v_server.broker.leases import Request
from v2v_server.corpus.catalogue import Catalogue, open_catalogue
from v2v_server.corpus.sources.folder import Folder
from v2v_server.corpus.sources.sidecars import sidecar_fingerprint
from v2v_server.quarantine import QuarantineEntry, quarantine_path, read_quarantine, write_entry
from v2v_server.schedule import Schedule, SequenceTable
from v2v_server.worker.job import ClipJob, SampleJob
from v2v_server.worker.making import make, read
from v2v_server.worker.making.make import errors_of_sidecar, make_sample
from v2v_server.worker.making.read import Clips, Decoded, decode_for, open_sidecars
from v2v_tools.remake import lease_for, remake
from v2v_tools.simulate import main as simulate

CHANGED = ("voxels_per_clip", "bins", "crop_height_px", "crop_width_px")
"""Fields of the small recipe that are not the paper's."""
SMALL_RECIPE = [f"--set={name}={value}" for name, value in SMALL_SPEC.recipe.to_dict().items() if name in CHANGED]


@pytest.fixture
def catalogue(tmp_path: Path) -> Iterator[Catalogue]:
    write_clip(tmp_path / "a.mp4", panned_luma(30, 16, 24), gop=12)
    with closing(open_catalogue(tmp_path, processes=0)) as opened:
        yield opened


@pytest.fixture
def lease(catalogue: Catalogue) -> Lease:
    schedule = Schedule(SequenceTable(catalogue.videos, catalogue.rows, SMALL_SPEC), SMALL_SPEC)
    return lease_for(
        Request(b"", 0, 2),
        sequence=schedule.candidate(0, 0, 2, 0),
        catalogue=catalogue,
        spec=SMALL_SPEC,
        seed=0,
        arrays=("voxels", "frames"),
    )


@pytest.fixture
def job(lease: Lease) -> SampleJob:
    return SampleJob.of(lease)


def changed(job: SampleJob, **changes: Any) -> SampleJob:
    """Return the same sample of another clip."""
    return dataclasses.replace(job, clip=dataclasses.replace(job.clip, **changes))


def made(job: SampleJob, catalogue: Catalogue) -> Sample:
    return make_sample(job, decode_for(job.clip, [job.index], catalogue.source)[0])


def test_a_whole_index_and_its_slice_make_the_same_sample(catalogue: Catalogue, job: SampleJob) -> None:
    index = catalogue.frame_index("a.mp4")
    assert job.clip.index_bytes == index.to_bytes()
    part_of_index = index.slice(job.clip.start_frame, SMALL_SPEC.recipe.frames_needed)
    whole, part = (made(each, catalogue) for each in (job, changed(job, index_bytes=part_of_index.to_bytes())))
    assert whole.provenance == part.provenance
    assert all(np.array_equal(array, part.arrays[name]) for name, array in whole.arrays.items())


@pytest.mark.parametrize("video", ["../a.mp4", "sub/../../a.mp4", "/etc/passwd", "..", "//a.mp4"])
def test_a_lease_that_leads_out_of_the_corpus_is_no_job(lease: Lease, video: str) -> None:
    """Its worker may be on another host than the server that sent it. No tool can make such a job either."""
    clip = ClipJob.of(lease)
    with pytest.raises(ProtocolError, match="leads out of the corpus folder"):
        ClipJob.of(dataclasses.replace(lease, video=video))
    with pytest.raises(ProtocolError, match="leads out of the corpus folder"):
        dataclasses.replace(clip, video=video)


def test_jobs_of_siblings_share_their_clip_and_keep_their_stamps(lease: Lease) -> None:
    """Whatever else a lease says, such as the place of the sample or what was refused before it."""
    refusals = {"refusals": [Refusal("b.mp4", 3, "cut short").to_dict()]}
    other = dataclasses.replace(lease, lease=9, indices=(5,), candidate=1, refusals=refusals, quarantine=4, slot=2)
    one, two = SampleJob.of(lease), SampleJob.of(other)
    assert one.clip == two.clip
    assert (one.index, one.stamp.candidate, one.stamp.refusals) == (2, 0, ())
    assert (two.index, two.stamp.candidate, two.stamp.quarantine) == (5, 1, 4)
    assert two.stamp.refusals == (Refusal("b.mp4", 3, "cut short"),)
    for change in ({"start_frame": 1}, {"arrays": ("voxels",)}, {"seed": 3}, {"thresholds": (0.2, 0.2)}):
        assert ClipJob.of(dataclasses.replace(lease, **change)) != one.clip  # type: ignore[arg-type]


def test_sub_steps_do_not_depend_on_the_arrays_that_are_asked_for(catalogue: Catalogue, job: SampleJob) -> None:
    """They change the voxels of what moves, and flow with its larger margin changes nothing in them."""
    divided = changed(job, spec=dataclasses.replace(SMALL_SPEC, substep_px=0.5))
    asked = ("voxels", "event_counts", "frames", "flow"), ("frames",)
    samples = [made(each, catalogue) for each in (job, divided, *(changed(divided, arrays=names) for names in asked))]
    plain, alone, beside_flow, _ = (sample.arrays for sample in samples)
    substeps = [sample.provenance.substeps for sample in samples]
    assert substeps[0] == substeps[3] == 0 < SMALL_SPEC.recipe.steps < substeps[1] == substeps[2]
    np.testing.assert_array_equal(alone["frames"], plain["frames"])
    np.testing.assert_array_equal(beside_flow["voxels"], alone["voxels"])
    on_and_off = beside_flow["event_counts"].astype(int)
    np.testing.assert_array_equal(on_and_off[:, 1] - on_and_off[:, 0], alone["voxels"])
    assert not np.array_equal(alone["voxels"], plain["voxels"])


@pytest.mark.parametrize("rate", [25.0, 0.0])
def test_a_time_surface_changes_no_other_array(catalogue: Catalogue, job: SampleJob, rate: float) -> None:
    """Without a known frame rate there are no seconds: it is empty and says so, and the video stays of use."""
    plain = changed(job, arrays=("voxels", "frames"), frames_per_second=rate)
    asked = changed(plain, arrays=("voxels", "time_surface", "frames"))
    without, beside = made(plain, catalogue), made(asked, catalogue)
    for name in without.arrays:
        np.testing.assert_array_equal(beside.arrays[name], without.arrays[name])
    assert beside.provenance.params == without.provenance.params
    ages = beside.arrays["time_surface"]
    if rate:
        assert beside.provenance.labelled
        assert np.isfinite(ages).any()
        assert (ages >= 0).all()
    else:
        assert np.isinf(ages).all()
        assert "its frame rate is unknown, and time_surface needs it" in beside.provenance.unlabelled["time_surface"]


def test_events_need_no_flow(catalogue: Catalogue, job: SampleJob, monkeypatch: pytest.MonkeyPatch) -> None:
    with_flow = changed(job, arrays=("voxels", "flow"))
    decoded = decode_for(with_flow.clip, [job.index], catalogue.source)[0]
    voxels = make_sample(with_flow, decoded).arrays["voxels"]
    monkeypatch.delattr(make, "flow_for")
    events = make.list_sample_events(with_flow.clip, decoded)
    signs = np.where(events.p, 1, -1)
    assert len(events) > 0
    assert signs.sum() == voxels.sum()


FIRST, SECOND = VideoError("a.mp4", 3, "does not decode"), VideoError("a.mp4", 3, "does not decode again")
MISSING = VideoUnreadable("a.mp4", None, "cannot be read")


@pytest.mark.parametrize(
    ("ends", "is_replaced", "error", "words"),
    [
        pytest.param([FIRST], False, None, "", id="makes the sample"),
        pytest.param([FIRST, SECOND], False, VideoError, "does not decode again", id="has the last word"),
        pytest.param([FIRST], True, VideoChanged, r"a\.mp4", id="finds a file that was replaced meanwhile"),
        pytest.param(
            [MISSING, SECOND], False, VideoUnreadable, "cannot be read", id="is not made where the file is missing"
        ),
    ],
)
def test_a_second_attempt(
    catalogue: Catalogue, job: SampleJob, monkeypatch: pytest.MonkeyPatch, ends: list[VideoError], is_replaced: bool,
    error: type[VideoError] | None, words: str,
) -> None:  # fmt: skip
    """What a file does, it does again; storage may fail for a moment."""
    left = list(ends)

    def decode(*arguments: Any) -> tuple[Decoded, ...]:
        if left:
            raise left.pop(0)
        return decode_for(*arguments)

    monkeypatch.setattr(read, "decode_for", decode)
    if is_replaced:
        (catalogue.folder / "a.mp4").write_bytes(b"another")
    if error is None:
        decoded, _ = Clips(catalogue.source).take(job.clip, [job.index])
        expected = made(job, catalogue)
        assert np.array_equal(make_sample(job, decoded).arrays["voxels"], expected.arrays["voxels"])
    else:
        with pytest.raises(error, match=words):
            Clips(catalogue.source).take(job.clip, [job.index])


def test_what_this_host_cannot_read_is_not_made_from_another_video(catalogue: Catalogue) -> None:
    write_clip(catalogue.folder / "b.mp4", panned_luma(30, 16, 24), gop=12)
    with closing(open_catalogue(catalogue.folder, processes=0)) as both:
        (catalogue.folder / "a.mp4").unlink()
        ended = set()
        for index in range(4):
            try:
                ended.add(remake(both, SMALL_SPEC, seed=0, epoch=0, index=index).provenance.video)
            except VideoUnreadable as error:
                ended.add(f"no {error.video}")
        assert ended == {"b.mp4", "no a.mp4"}


def test_a_sample_is_made_again_under_its_quarantine_snapshot(catalogue: Catalogue, tmp_path: Path) -> None:
    write_clip(catalogue.folder / "b.mp4", panned_luma(30, 16, 24), gop=12)
    cache = str(tmp_path / "cache")

    def video_of(*flags: str) -> str:
        out = tmp_path / "sample.npz"
        assert (
            simulate(
                [str(catalogue.folder), f"--out={out}", f"--cache-dir={cache}", "--index=2", *SMALL_RECIPE, *flags]
            )
            == 0
        )
        with np.load(out) as content:
            video: str = json.loads(str(content["provenance"]))["video"]
        return video

    first = video_of()
    mark = next(video.fingerprint for video in catalogue.videos if video.id == first)
    file = quarantine_path(catalogue.folder, cache)
    for frame in (0, 10):  # two verdicts refuse the file
        write_entry(file, QuarantineEntry(0, first, mark, frame, "crash", "t"), read_quarantine(file))
    assert (video_of(), video_of("--quarantine=2")) == (first, {"a.mp4": "b.mp4", "b.mp4": "a.mp4"}[first])
    with pytest.raises(AssertionError):
        video_of("--quarantine=3")


@pytest.mark.parametrize("damage", ["garbage", "cut short", "too few frames"])
def test_a_damaged_index_costs_its_video_only(catalogue: Catalogue, job: SampleJob, damage: str) -> None:
    """The server hands a small one on unopened."""
    index = catalogue.frame_index("a.mp4")
    damaged = {
        "garbage": b"no index",
        "cut short": index.to_bytes()[:-3],
        "too few frames": index.slice(0, job.clip.start_frame + 1).to_bytes(),
    }[damage]
    with pytest.raises(VideoError, match=r"^a\.mp4.*: its index from the server is damaged: "):
        made(changed(job, index_bytes=damaged), catalogue)


@pytest.mark.parametrize("file", ["sample", "sample.mp4"])
def test_a_sample_gets_no_name_of_another_kind(file: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert simulate([str(tmp_path / "a.mp4"), f"--out={tmp_path / file}", *SMALL_RECIPE]) == 2
    assert f"{file}: unknown ending; give a name that ends in .npz" in capsys.readouterr().err
    assert not (tmp_path / file).exists()


# --- what a lease says of sidecars ------------------------------------------------------------------------------------

ENDING = ".label.json"


@pytest.fixture(autouse=True)
def _label(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(
        sample.ARRAYS, "label", ArrayForm(lambda recipe, _: ("float32", (1,)), Needs(sidecars=(ENDING,)))
    )


def leased(**changes: object) -> Lease:
    plain = {
        "spec": SMALL_SPEC.canonical(),
        "rows": "full",
        "video": "deep/a.mp4",
        "arrays": ("frames", "label"),
        "sidecars": {},
    }
    return dataclasses.replace(example(Lease), **plain | changes)  # type: ignore[arg-type]


def clip_of(**changes: object) -> ClipJob:
    return ClipJob.of(leased(**changes))


def test_only_the_sidecars_of_asked_arrays_are_opened(tmp_path: Path) -> None:
    file = tmp_path / "deep" / "a.label.json"
    file.parent.mkdir()
    file.write_text("[1]")
    mark = sidecar_fingerprint(file)
    known = clip_of(sidecars={ENDING: mark, ".other": "3-x"})
    assert known.sidecars == {ENDING: (mark, b"")}
    assert clip_of(arrays=("frames",), sidecars={ENDING: mark}).sidecars == {}
    with open_sidecars(known, Folder(tmp_path)) as opened:
        assert opened == {ENDING: file}
    with open_sidecars(clip_of(), Folder(tmp_path)) as opened:
        assert opened == {ENDING: None}
    for text, reason in (("[2]", "changed since it was catalogued"), (None, "there is no such sidecar")):
        file.unlink() if text is None else file.write_text(text)
        with pytest.raises(SidecarError, match=reason) as raised, open_sidecars(known, Folder(tmp_path)):
            pass
        assert (raised.value.video, raised.value.ending, raised.value.here) == ("deep/a.mp4", ENDING, True)


def test_any_error_over_a_sidecar_is_the_sidecars(tmp_path: Path) -> None:
    opened = {ENDING: tmp_path}
    text = r"^a\.mp4: its sidecar \.label\.json: KeyError: 'boxes'$"
    with pytest.raises(SidecarError, match=text) as raised, errors_of_sidecar("a.mp4", "label", opened):
        raise KeyError("boxes")
    assert not raised.value.here
    with pytest.raises(VideoError), errors_of_sidecar("a.mp4", "label", opened):
        raise VideoError("a.mp4", 3, "is damaged")
    for array, sidecars in (("frames", opened), ("label", {ENDING: None})):
        with pytest.raises(KeyError), errors_of_sidecar("a.mp4", array, sidecars):
            raise KeyError("a fault of the program")


def test_a_sidecar_that_the_catalogue_refuses_is_not_opened(tmp_path: Path) -> None:
    refused = leased(sidecars={ENDING: ["3-abc", "has labels of frame 9"]})
    clip = ClipJob.of(refused)
    assert (clip.sidecars, clip.refused_sidecars) == ({}, {ENDING: "has labels of frame 9"})
    with open_sidecars(clip, Folder(tmp_path)) as opened:
        assert opened == {ENDING: None}
    with (
        pytest.raises(SidecarError, match=r"^a\.mp4: its sidecar \.label\.json: has labels of frame 9$") as raised,
        errors_of_sidecar("a.mp4", "label", opened, clip.refused_sidecars),
    ):
        pytest.fail("the array is made")
    assert not raised.value.here
    assert decode(encode(refused)[0]) == refused
    for malformed in (7, [1, b""], ["3-abc", 7], ["3-abc"], {}):
        with pytest.raises(ProtocolError, match="fingerprint"):
            clip_of(sidecars={ENDING: malformed})


def test_memory_that_labels_take_is_their_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def short(*_: object) -> None:
        raise MemoryError

    monkeypatch.setattr(read, "open_sidecar", short)
    with (
        pytest.raises(SidecarError, match="too much memory"),
        open_sidecars(clip_of(sidecars={ENDING: "3-abc"}), Folder(tmp_path)),
    ):
        pass
