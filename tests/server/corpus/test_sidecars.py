"""Files and folders beside videos: the same in a folder and in object storage, read once, and checked when opened."""

from __future__ import annotations

import itertools
import json
import os
import shutil
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest

from tests.clips import panned_luma, write_clip
from v2v_protocol import sample
from v2v_protocol.errors import VideoChanged, VideoError, VideoGone
from v2v_protocol.sample import ArrayForm, Needs
from v2v_server.corpus import probe as collecting
from v2v_server.corpus.catalogue import Catalogue, open_catalogue
from v2v_server.corpus.sources import listing, sidecars
from v2v_server.corpus.sources.sidecars import open_sidecar, read_files
from v2v_server.corpus.sources.source import SourceOptions, open_source

JSON, MASKS = ".boxes.json", ".masks/"
ARRAYS = ("boxes", "masks")


@pytest.fixture(autouse=True)
def _arrays(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, ending in zip(ARRAYS, (JSON, MASKS), strict=True):
        monkeypatch.setitem(
            sample.ARRAYS, name, ArrayForm(lambda recipe, _: ("uint8", (1,)), Needs(sidecars=(ending,)))
        )


@pytest.fixture
def corpus(tmp_path: Path) -> Path:
    folder = tmp_path / "videos"
    (folder / "deep").mkdir(parents=True)
    write_clip(folder / "a.mp4", panned_luma(12))
    shutil.copy(folder / "a.mp4", folder / "deep" / "b.x.mp4")
    (folder / "a.boxes.json").write_text("[1]")
    masks = folder / "deep" / "b.x.masks"
    (masks / "more").mkdir(parents=True)
    for name in ("1.png", "2.png", "more/3.png", ".hidden"):
        (masks / name).write_bytes(name.encode())
    (folder / "a.masks").write_text("a file where a folder belongs is none")
    return folder


KINDS = ["folder", pytest.param("bucket", marks=pytest.mark.filterwarnings("ignore"))]


def name_of(corpus: Path, kind: str) -> str:
    if kind == "bucket":
        pytest.importorskip("fsspec", reason="the extra 'cloud' is not installed")
        return f"file://{corpus}"
    return str(corpus)


@contextmanager
def opened(corpus: Path, kind: str) -> Iterator[Catalogue]:
    with closing(open_catalogue(name_of(corpus, kind), cache_dir=corpus.parent / "cache", processes=0)) as catalogue:
        yield catalogue


@pytest.mark.parametrize("kind", KINDS)
def test_a_catalogue_knows_them_and_its_digest_does_not(
    corpus: Path, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with opened(corpus, kind) as catalogue:
        facts = catalogue.facts
        found = {video.id: facts.sidecars_of(video.id, ARRAYS) for video in catalogue.videos}
        assert {id: list(each) for id, each in found.items()} == {"a.mp4": [JSON], "deep/b.x.mp4": [MASKS]}
        assert found["deep/b.x.mp4"][MASKS].startswith("20-")
        assert facts.sidecars_of("a.mp4", ("frames", "masks")) == {}
        assert facts.sidecars_digest(("frames",)) == ""
        digests = {facts.sidecars_digest(arrays) for arrays in (("boxes",), ("masks",), ARRAYS)}
        assert len(digests) == 3
        assert "1 of 2 videos have a sidecar .masks/" in catalogue.notes

    read: list[object] = []
    monkeypatch.setattr(collecting, "read_files", lambda opened: read.append(opened) or read_files(opened))
    with opened(corpus, kind) as again:
        assert {again.facts.sidecars_digest(arrays) for arrays in (("boxes",), ("masks",), ARRAYS)} == digests
    assert not read, "what is unchanged is not read again"
    (corpus / "deep/b.x.masks/2.png").write_bytes(b"2.pnG")
    (corpus / "a.boxes.json").unlink()
    with opened(corpus, kind) as changed:
        assert changed.digest == catalogue.digest
        assert changed.facts.sidecars_of("a.mp4", ARRAYS) == {}
        assert changed.facts.sidecars_digest(("masks",)) not in digests
    assert len(read) == 1


def test_an_interrupted_start_keeps_what_it_has_read(corpus: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (corpus / "deep/b.x.boxes.json").write_text("[2]")
    monkeypatch.setattr(listing, "_TOGETHER", 1)
    read: list[str] = []

    def interrupted(opened: Path) -> tuple[str, bytes]:
        if read:
            raise KeyboardInterrupt
        read.append(opened.name)
        return read_files(opened)

    monkeypatch.setattr(collecting, "read_files", interrupted)
    with pytest.raises(KeyboardInterrupt), opened(corpus, "folder"):
        pass
    monkeypatch.setattr(collecting, "read_files", lambda opened: read.append(opened.name) or read_files(opened))
    with opened(corpus, "folder"):
        assert read == ["a.boxes.json", "b.x.boxes.json", "b.x.masks"]


@pytest.mark.parametrize("name", ["a.boxes.json", "deep/b.x.masks/2.png"])
def test_a_fifo_is_not_opened(corpus: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    (corpus / name).unlink()
    os.mkfifo(corpus / name)

    def read(opened: Path) -> tuple[str, bytes]:
        """Fail before opening it, which would wait for a writer."""
        assert not any(map(Path.is_fifo, (opened, *opened.glob("*"))))
        return read_files(opened)

    monkeypatch.setattr(collecting, "read_files", read)
    with opened(corpus, "folder") as catalogue:
        notes = [note for note in catalogue.notes if "not a regular file" in note]
    assert len(notes) == 1
    assert notes[0].startswith("1 sidecars cannot be read and count as missing (")


def test_links_in_circles_are_not_followed_by_all_paths(corpus: Path) -> None:
    for name in ("here", "there"):
        (corpus / "deep/b.x.masks" / name).symlink_to(".")
    with opened(corpus, "folder") as catalogue:
        assert catalogue.facts.sidecars_of("deep/b.x.mp4", ARRAYS) == {}
        assert any("a link that leads nowhere" in note for note in catalogue.notes)


def test_a_bucket_has_those_of_its_folder(corpus: Path) -> None:
    with opened(corpus, "folder") as local, opened(corpus, "bucket") as remote:
        assert remote.facts.sidecars_digest(ARRAYS) == local.facts.sidecars_digest(ARRAYS)


@pytest.mark.parametrize("kind", KINDS)
def test_it_is_opened_like_the_video_and_a_changed_and_a_missing_one_are_told_apart(corpus: Path, kind: str) -> None:
    table = read_files(corpus / "deep/b.x.masks")[1]
    with opened(corpus, kind) as catalogue:
        boxes = catalogue.facts.sidecars_of("a.mp4", ARRAYS)[JSON]
        masks = catalogue.facts.sidecars_of("deep/b.x.mp4", ARRAYS)[MASKS]
        catalogue.check("a.mp4", boxes, JSON)
        catalogue.check("deep/b.x.mp4", masks, MASKS)
        source = open_source(name_of(corpus, kind), SourceOptions(cache_dir=corpus.parent / "other"))
        if source.copies is not None:
            source.copies.make()
        files = {"a.boxes.json": boxes, "deep/b.x.masks/": masks}
        assert source.has(files) is source.is_local
        source.fetch(files)
        assert source.has(files)
        with open_sidecar(source, "a.boxes.json", boxes) as file:
            assert file.read_text() == "[1]"
        with open_sidecar(source, "deep/b.x.masks/", masks, table) as folder:
            assert (folder / "2.png").read_bytes() == b"2.png"
            assert (folder / "more" / "3.png").read_bytes() == b"more/3.png"
        if source.copies is not None:
            source.copies.release()
        (corpus / "a.boxes.json").write_text("[2]")
        (corpus / "deep/b.x.masks/3.png").write_text("new")
        for id, ending, mark in (("a.mp4", JSON, boxes), ("deep/b.x.mp4", MASKS, masks)):
            with pytest.raises(VideoChanged, match="since it was catalogued"):
                catalogue.check(id, mark, ending)
        (corpus / "a.boxes.json").unlink()
        shutil.rmtree(corpus / "deep/b.x.masks")
        for id, ending, mark in (("a.mp4", JSON, boxes), ("deep/b.x.mp4", MASKS, masks)):
            with pytest.raises(VideoGone):
                catalogue.check(id, mark, ending)
        for video in catalogue.videos:
            catalogue.check(video.id, video.fingerprint)
    fresh = open_source(name_of(corpus, kind), SourceOptions(cache_dir=corpus.parent / "fresh"))
    if fresh.copies is not None:
        fresh.copies.make()
    with pytest.raises(VideoGone), open_sidecar(fresh, "a.boxes.json", boxes):
        pass
    with pytest.raises(VideoError), open_sidecar(fresh, "deep/b.x.masks/", masks, table):
        pass


def test_only_videos_with_such_a_name_beside_them_are_asked_about(corpus: Path) -> None:
    source, ids = open_source(str(corpus), SourceOptions()), ["a.mp4", "deep/b.x.mp4"]
    assert source.with_sidecars(ids, (JSON, MASKS)) == {JSON: ["a.mp4"], MASKS: ids}
    shutil.rmtree(corpus / "deep")  # a folder that cannot be listed
    assert source.with_sidecars(ids, (JSON, MASKS)) == {JSON: ids, MASKS: ids}


MASKED = "deep/b.x.mp4"


@pytest.mark.parametrize("processes", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_a_sidecar_beyond_the_limits_is_not_read(corpus: Path, processes: int, monkeypatch: pytest.MonkeyPatch) -> None:
    if not processes:
        monkeypatch.setattr(collecting, "read_files", lambda opened: pytest.fail(f"reads {opened}"))
    shutil.rmtree(corpus / "deep/b.x.masks")
    with (corpus / "a.boxes.json").open("wb") as file:
        file.truncate(40 << 30)
    said: list[str] = []
    with closing(
        open_catalogue(corpus, cache_dir=corpus.parent / "cache", processes=processes, notice=said.append)
    ) as catalogue:
        assert catalogue.facts.sidecars_of("a.mp4", ARRAYS) == {}
        assert "with 42949672960 bytes or more: the limit is" in catalogue.sidecars[JSON].problems["a.mp4"]
        assert any("1 sidecars cannot be read and count as missing (a.boxes.json: " in each for each in catalogue.notes)
    assert any(f"looking for sidecars {JSON}" in each for each in said)


def test_links_that_double_at_each_level_are_bounded(corpus: Path) -> None:
    shutil.rmtree(corpus / "deep/b.x.masks")
    folders = [corpus.parent / f"level{number}" for number in range(24)]
    for folder, below in itertools.pairwise(folders):
        folder.mkdir()
        for name in "ab":
            (folder / name).symlink_to(below)
    folders[-1].mkdir()
    (folders[-1] / "1.png").write_bytes(b"1")
    (corpus / "deep/b.x.masks").symlink_to(folders[0])
    with opened(corpus, "folder") as catalogue:
        assert "more than 4096 folders, the limit" in catalogue.sidecars[MASKS].problems[MASKED]


@pytest.mark.parametrize("kind", KINDS)
def test_a_lease_names_only_the_files_of_its_frames(corpus: Path, kind: str) -> None:
    with opened(corpus, kind) as catalogue:
        mark = catalogue.sidecars[MASKS].fingerprints[MASKED]
        table = catalogue.sidecar_files(MASKED, MASKS, mark, 2, 5)
        assert isinstance(table, bytes)
        assert catalogue.sidecar_files(MASKED, MASKS, "20-x", 2, 5) == (
            "differs from the index, which another program changed: restart the server to serve it as it is now"
        )
    masks = corpus / "deep/b.x.masks"
    (masks / "1.png").write_bytes(b"a file of no frame of the lease")
    source = open_source(str(corpus), SourceOptions())
    with open_sidecar(source, "deep/b.x.masks/", mark, table) as folder:
        assert [each.name for each in folder.iterdir()] == ["2.png", "more"]
        (masks / "2.png").write_bytes(b"another file once it was read")
        assert (folder / "2.png").read_bytes() == b"2.png"
    with (
        pytest.raises(VideoChanged, match=r"changed since it was catalogued: 2\.png"),
        open_sidecar(source, "deep/b.x.masks/", mark, table),
    ):
        pass
    os.utime(masks / "more/3.png", (1, 1))
    (masks / "2.png").write_bytes(b"2.png")
    with open_sidecar(source, "deep/b.x.masks/", mark, table):
        pass  # times name nothing


def test_files_too_large_for_one_clip_are_an_error_of_the_sidecar(
    corpus: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sidecars, "MOST_LENT_BYTES", 6)
    fingerprint, table = read_files(corpus / "deep/b.x.masks")
    source = open_source(str(corpus), SourceOptions())
    with (
        pytest.raises(VideoError, match="more than 6 bytes") as raised,
        open_sidecar(source, "deep/b.x.masks/", fingerprint, table),
    ):
        pass
    assert type(raised.value) is VideoError, "not of this host: no other worker tries"


def test_labels_that_do_not_fit_are_said_once_read(corpus: Path) -> None:
    masks = "deep/b.x.masks/1.png"
    for _ in range(2):  # the second time from the index
        with opened(corpus, "folder") as catalogue:
            assert catalogue.sidecars[MASKS].problems.keys() == {MASKED}
            assert catalogue.sidecars[MASKS].fingerprints.keys() == {MASKED}
            (note,) = [each for each in catalogue.notes if f"{MASKS} are refused" in each]
            assert note.startswith(
                f"1 sidecars {MASKS} are refused, and their videos are served without these labels ("
            )
    assert (corpus / masks).exists()


@pytest.mark.slow
def test_a_sidecar_that_kills_its_reader_costs_itself(corpus: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(collecting, "LARGEST_PROBE_BYTES", 256 << 20)
    boxes = {"images": [{"id": n, "frame_id": n} for n in range(500_000)], "annotations": []}
    (corpus / "a.boxes.json").write_text(json.dumps(boxes))
    with closing(open_catalogue(corpus, cache_dir=corpus.parent / "cache", processes=1)) as catalogue:
        assert len(catalogue.videos) == 2
        assert "memory" in catalogue.sidecars[JSON].problems["a.mp4"].lower()
