"""Copies of objects on this host; the store is a folder, asked through fsspec, that may fail on purpose."""

from __future__ import annotations

import fcntl
import multiprocessing
import os
import stat
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest

from tests.clips import panned_luma, write_clip
from v2v_protocol.errors import (
    CorpusError,
    ProtocolError,
    UsageError,
    VideoChanged,
    VideoDenied,
    VideoGone,
    VideoUnreadable,
)
from v2v_server.corpus.catalogue import Catalogue, open_catalogue
from v2v_server.corpus.sources import copies as bucket_module
from v2v_server.corpus.sources import copies as copies_module
from v2v_server.corpus.sources.copies import Bucket, Copies, is_url
from v2v_server.corpus.sources.source import GONE, SourceOptions, VideoSource, open_source
from v2v_server.store.quota import PARTIAL, count_bytes, used_bytes
from v2v_server.video.fingerprint import fingerprint

pytest.importorskip("fsspec", reason="the extra 'cloud' is not installed")

SIZE = 1000


@pytest.fixture(autouse=True)
def _no_waiting(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bucket_module, "_FIRST_WAIT_SECONDS", 0.001)
    monkeypatch.setattr("v2v_server.corpus.sources.copy_folder._ROOM_SECONDS", 0.01)


@pytest.fixture
def store(tmp_path: Path) -> Path:
    folder = tmp_path / "store"
    (folder / "deep").mkdir(parents=True)
    for number, name in enumerate(("a.mp4", "b.mp4", "deep/c.mp4")):
        (folder / name).write_bytes(bytes([number]) * SIZE)
    return folder


_MADE: list[Copies] = []


@pytest.fixture(autouse=True)
def _nothing_held() -> Iterator[None]:
    yield
    while _MADE:
        _MADE.pop().copies.release()


def copies(store: Path, most: int = 10 * SIZE) -> Copies:
    made = Copies(Bucket(f"file://{store}"), store.parent / "copies", most)
    made.copies.make()
    _MADE.append(made)
    return made


def files(made: Copies) -> set[bytes]:
    """The first byte of each copy."""
    found = list(made.copies.folder.glob("??/*"))
    assert (
        sum(path.stat().st_size for path in found) == used_bytes(made.copies.folder) == count_bytes(made.copies.folder)
    )
    return {path.read_bytes()[:1] for path in found}


def test_what_an_address_holds(store: Path) -> None:
    made, names = copies(store), ("a.mp4", "b.mp4", "deep/c.mp4")
    assert set(made.videos({}, Counter())) == set(names)
    states = made.states([*names, "none.mp4"])
    assert list(states[::3]) == [SIZE, SIZE, SIZE, GONE[0]]
    (store / "a.mp4").write_bytes(b"x" * SIZE)
    assert made.states(["a.mp4"]) == states[:3], "the states are those of one listing"
    assert copies(store).states(["a.mp4"]) != states[:3]


@pytest.mark.parametrize(
    ("source", "expected"),
    [("s3://bucket/videos", True), ("memory://x", True), ("/data", False), ("C:/data", False)],
)
def test_an_address_is_told_from_a_path(source: str, expected: bool) -> None:
    assert is_url(source) is expected
    if not expected:
        assert copies_module.open_source(source, SourceOptions()) is None


def test_a_video_is_fetched_once(store: Path) -> None:
    made, mark = copies(store), fingerprint(store / "a.mp4")
    assert not made.has({"a.mp4": mark})
    with made.open_local("a.mp4", f"{mark}-content") as path:
        assert path.read_bytes() == (store / "a.mp4").read_bytes()
        assert path.suffix == ".mp4"
    (store / "a.mp4").unlink()
    assert made.has({"a.mp4": f"{mark}-content"})
    with made.open_local("a.mp4", f"{mark}-content") as path:
        assert path.stat().st_size == SIZE
    assert [each.name for each in (made.copies.folder / PARTIAL).iterdir() if each.suffix != ".lock"] == []
    found = [path for path in made.copies.folder.rglob("*") if path.is_file()]
    assert {path.suffix for path in found} >= {".mp4", ".lock"}
    modes = {path.suffix == ".lock": stat.S_IMODE(path.stat().st_mode) for path in found}
    assert modes == {False: 0o600, True: 0o200}, "other users cannot lock a copy"


def test_an_object_that_changed_in_the_middle_only_is_fetched_again(store: Path) -> None:
    """Another host knows it by the fingerprint alone, and must not make samples of its old copy."""
    content = bytes(100_000) + b"old" + bytes(100_000)
    (store / "a.mp4").write_bytes(content)
    made, mark = copies(store, 10 * len(content)), fingerprint(store / "a.mp4")
    made.fetch({"a.mp4": f"{mark}-old"})
    (store / "a.mp4").write_bytes(content.replace(b"old", b"new"))
    assert fingerprint(store / "a.mp4") == mark
    with made.open_local("a.mp4", f"{mark}-new") as path:
        assert b"new" in path.read_bytes()
    assert made.has({"a.mp4": f"{mark}-new"})


def test_what_was_fetched_to_be_probed_is_not_fetched_again(store: Path) -> None:
    made, mark = copies(store), fingerprint(store / "a.mp4")
    with made.open_local("a.mp4", ""):
        pass
    with made.open_local("a.mp4", "") as reading:
        for _ in range(3):  # as several processes do
            made.copies.keep_as("a.mp4", mark, f"{mark}-content")
        assert reading.read_bytes() == (store / "a.mp4").read_bytes()
    assert used_bytes(made.copies.folder) == 2 * SIZE  # under two names while it was read
    made.copies.keep_as("a.mp4", mark, f"{mark}-content")
    assert used_bytes(made.copies.folder) == SIZE
    (store / "a.mp4").unlink()
    assert made.has({"a.mp4": f"{mark}-content"})
    made.copies.keep_as("b.mp4", "absent", "absent-content")
    assert [each.name for each in (made.copies.folder / PARTIAL).iterdir() if each.suffix != ".lock"] == []


def test_a_slot_that_another_process_keeps_is_not_waited_for(store: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("v2v_server.corpus.sources.copy_folder._SLOT_SECONDS", 0.0)
    made, mark = copies(store), fingerprint(store / "a.mp4")
    with ExitStack() as held:
        for number in range(63):
            lock = held.enter_context((made.copies.folder / PARTIAL / f"{number:02}.lock").open("wb"))
            fcntl.flock(lock, fcntl.LOCK_EX)
        made.fetch({"a.mp4": mark})
        assert made.has({"a.mp4": mark})
        last = held.enter_context((made.copies.folder / PARTIAL / "63.lock").open("wb"))
        fcntl.flock(last, fcntl.LOCK_EX)
        with pytest.raises(VideoUnreadable, match="other processes keep all 64 of its slots"):
            made.fetch({"b.mp4": fingerprint(store / "b.mp4")})
    made.fetch({"b.mp4": fingerprint(store / "b.mp4")})


def test_an_object_that_is_gone_or_changed(store: Path) -> None:
    made, mark = copies(store), fingerprint(store / "a.mp4")
    state = made.state("a.mp4")
    made.verify("a.mp4", mark, state)
    (store / "a.mp4").write_bytes(b"y" * SIZE)
    with pytest.raises(VideoChanged, match="changed in file:"):
        made.verify("a.mp4", mark, state)
    made.verify("a.mp4", mark, None)
    with pytest.raises(VideoChanged, match="changed in file:"):
        made.fetch({"a.mp4": mark})
    (store / "a.mp4").unlink()
    with pytest.raises(VideoGone):
        made.verify("a.mp4", mark, state)
    with pytest.raises(VideoGone, match=r"is not in file:.* any more"):
        made.fetch({"a.mp4": mark})
    assert files(made) == set()


class Flaky:
    """A store that raises what it is told to before it answers."""

    def __init__(self, store: Any, errors: list[Exception]) -> None:
        self._store, self._errors, self.asked = store, errors, 0

    def __getattr__(self, name: str) -> Any:
        def call(*arguments: Any, **more: Any) -> Any:
            self.asked += 1
            if self._errors:
                raise self._errors.pop(0)
            return getattr(self._store, name)(*arguments, **more)

        return call if name in ("find", "info", "get_file") else getattr(self._store, name)


class NoCredentialsError(Exception):
    """As botocore calls it, which is no OSError."""


def flaky(store: Path, *errors: Exception) -> tuple[Copies, Flaky]:
    made = copies(store)
    made.bucket.__dict__["_store"] = wrapped = Flaky(made.bucket._store, list(errors))
    return made, wrapped


def test_what_may_pass_is_tried_again(store: Path) -> None:
    made, asked = flaky(store, OSError("SlowDown"), TimeoutError("read"))
    made.fetch({"a.mp4": fingerprint(store / "a.mp4")})
    assert asked.asked == 3
    made, asked = flaky(store, *[OSError("SlowDown")] * 9)
    with pytest.raises(VideoUnreadable, match=r"the store gives no answer \(OSError: SlowDown; tried 3 times\)"):
        made.fetch({"b.mp4": fingerprint(store / "b.mp4")})
    assert asked.asked == 3
    made.verify("b.mp4", "", (SIZE, 0, 0))  # a store that does not answer condemns nothing
    assert asked.asked == 4
    with pytest.raises(VideoUnreadable):
        made.bucket.state("b.mp4")
    with pytest.raises(VideoGone):
        copies(store).bucket.state("none.mp4")


@pytest.mark.parametrize("error", [PermissionError("403"), NoCredentialsError("Unable to locate credentials")])
def test_a_credentials_problem_is_one_message_and_not_tried_again(store: Path, error: Exception) -> None:
    made, asked = flaky(store, error, error)
    with pytest.raises(CorpusError, match=r"access is denied .* AWS_PROFILE") as raised:
        list(made.videos({}, Counter()))
    assert "\n" not in str(raised.value)
    assert asked.asked == 1
    with pytest.raises(VideoDenied):
        made.bucket.state("a.mp4")


def test_what_was_not_read_for_longest_goes(store: Path) -> None:
    made = copies(store, most=2 * SIZE)
    marks = {name: fingerprint(store / name) for name in ("a.mp4", "b.mp4", "deep/c.mp4")}
    for name in ("a.mp4", "b.mp4"):
        with made.open_local(name, marks[name]):
            pass
    assert files(made) == {b"\0", b"\1"}
    assert made.has({"a.mp4": marks["a.mp4"]})  # read again: b is the older one now
    made.copies.release()
    made.fetch({"deep/c.mp4": marks["deep/c.mp4"]})
    assert b"\1" not in files(made)
    assert b"\2" in files(made)


def test_what_is_being_read_stays(store: Path) -> None:
    made, other = copies(store, most=SIZE), copies(store, most=SIZE)
    mark = fingerprint(store / "a.mp4")
    with made.open_local("a.mp4", mark) as path:
        with pytest.raises(VideoUnreadable, match="raise --copies-gib"):
            other.fetch({"b.mp4": fingerprint(store / "b.mp4")})
        assert path.exists()
    other.fetch({"b.mp4": fingerprint(store / "b.mp4")})
    assert files(made) == {b"\1"}
    assert not made.has({"a.mp4": mark})


def _read(plain: bytes, marks: dict[str, str], turns: int) -> set[tuple[str, bytes]]:
    made, got = VideoSource.from_bytes(plain), set()
    for _ in range(turns):
        for name, mark in marks.items():
            with made.open_local(name, mark) as path:
                got.add((name, path.read_bytes()))
    made.copies.release()
    return got


def test_many_at_once(store: Path) -> None:
    """Two processes with room for two of three videos evict what the other wants next: both see whole files only."""
    made = copies(store, most=2 * SIZE)
    marks = {name: fingerprint(store / name) for name in ("a.mp4", "b.mp4", "deep/c.mp4")}
    backwards = dict(reversed(marks.items()))
    expected = {(name, bytes([number]) * SIZE) for number, name in enumerate(marks)}
    with multiprocessing.get_context("spawn").Pool(1) as processes:
        processes.apply(os.getpid)  # it is at work
        told = processes.apply_async(_read, (made.to_bytes(), backwards, 100))
        assert _read(made.to_bytes(), marks, 100) == told.get(60) == expected
    assert 1 <= len(files(made)) <= 2


def test_addresses_that_cannot_be(store: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="leave user and password out") as raised:
        Bucket("ftp://me:secret@host/videos")
    assert "secret" not in str(raised.value)
    with pytest.raises(UsageError, match="nonsense"):
        _ = Bucket("nonsense://x").objects()
    with pytest.raises(ProtocolError, match="leads out"):
        copies(store).fetch({"../a.mp4": "1-2"})
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(CorpusError, match="cannot be written to"):
        Copies(Bucket("file:///x"), tmp_path / "file", 1).copies.make()
    for limit in (0.0, float("inf")):
        with pytest.raises(UsageError, match=f"--copies-gib {limit:g}"):
            open_source("file:///x", SourceOptions(copies=tmp_path, copies_gib=limit))


# --- a catalogue of videos in object storage --------------------------------------------------------------------------


@pytest.fixture(scope="module")
def _written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("written")
    write_clip(folder / "a.mp4", panned_luma(20))
    write_clip(folder / "b.mkv", panned_luma(24, step=(2, 1)))
    return folder


@pytest.fixture
def clips(_written: Path, tmp_path: Path) -> Path:
    folder = tmp_path / "clips"
    (folder / "deep").mkdir(parents=True)
    for source, name in (("a.mp4", "a.mp4"), ("b.mkv", "deep/b.mkv"), ("a.mp4", ".hidden/a.mp4"), ("a.mp4", "a.txt")):
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes((_written / source).read_bytes())
    return folder


@pytest.fixture
def fetched(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What was fetched so far."""
    ids: list[str] = []
    fetch = Bucket.fetch

    def noted(self: Bucket, id: str, to: Path) -> None:
        ids.append(id)
        fetch(self, id, to)

    monkeypatch.setattr(Bucket, "fetch", noted)
    return ids


@contextmanager
def catalogue(clips: Path, *, is_folder: bool = False, list_file: Path | None = None) -> Iterator[Catalogue]:
    source = str(clips) if is_folder else f"file://{clips}"
    opened = open_catalogue(source, cache_dir=clips.parent / "cache", list_file=list_file, processes=0)
    try:
        yield opened
    finally:
        opened.close()


def test_it_is_the_catalogue_of_the_folder(clips: Path, fetched: list[str]) -> None:
    with catalogue(clips, is_folder=True) as local, catalogue(clips) as remote:
        assert remote.digest == local.digest
        assert list(remote.videos) == list(local.videos)
        assert not remote.source.is_local
        with pytest.raises(CorpusError, match="not a folder of this host"):
            remote.path("a.mp4")
    assert sorted(fetched) == ["a.mp4", "deep/b.mkv"]


def test_what_is_new_or_changed_is_fetched(clips: Path, fetched: list[str]) -> None:
    with catalogue(clips) as first:
        fetched.clear()
        with catalogue(clips) as again:
            assert (again.digest, fetched) == (first.digest, [])
        (clips / "a.mp4").write_bytes((clips / "deep" / "b.mkv").read_bytes())
        os.rename(clips / "deep" / "b.mkv", clips / "c.mkv")
        with pytest.raises(VideoChanged):
            first.check("a.mp4", first.videos[0].fingerprint)
        with pytest.raises(VideoGone):
            first.check("deep/b.mkv", first.videos[1].fingerprint)
    with catalogue(clips) as later:
        assert [video.id for video in later.videos] == ["a.mp4", "c.mkv"]
        assert sorted(fetched) == ["a.mp4", "c.mkv"]
        later.check("a.mp4", later.videos[0].fingerprint)
        later.mark_stale("a.mp4")
        with pytest.raises(VideoChanged):  # that it is in doubt must not hide that it was found wanting
            later.check("a.mp4", later.videos[0].fingerprint)


def test_a_list_restricts_it(clips: Path, tmp_path: Path, fetched: list[str]) -> None:
    names = tmp_path / "names.txt"
    names.write_text("deep/b.mkv\nnone.mp4\n", encoding="utf-8")
    with catalogue(clips, list_file=names) as remote:
        assert [video.id for video in remote.videos] == ["deep/b.mkv"]
        assert [(each.video, each.reason) for each in remote.refusals] == [
            ("none.mp4", f"is not in file://{clips} any more")
        ]
    assert fetched == ["deep/b.mkv"]


def test_a_prepared_corpus_has_to_be_on_a_disk(clips: Path) -> None:
    (clips / "deep" / "v2v-prepared.jsonl").write_text("{}\n", encoding="utf-8")
    with pytest.raises(CorpusError, match="makes it a prepared corpus"), catalogue(clips):
        pass


def test_an_object_of_another_mark_is_read_whole(clips: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Size, head and tail stay: an object that was uploaded again is served, and another middle is not kept."""
    luma = panned_luma(126, 90, 70)
    file = write_clip(clips / "a.avi", luma, codec="rawvideo")
    right = file.read_bytes()
    luma[60] ^= 255
    wrong = write_clip(clips.parent / "a.avi", luma, codec="rawvideo").read_bytes()
    read: list[Path] = []
    content_of = copies_module.content_of

    def noted(pixels: Any) -> str:
        read.append(pixels)
        return content_of(pixels)

    monkeypatch.setattr(copies_module, "content_of", noted)
    with catalogue(clips) as found:
        number = found.videos.find("a.avi")
        assert number is not None
        wanted = {"a.avi": found.videos[number].fingerprint}
        state = found.state("a.avi")
        assert state is not None

    def fetched() -> bytes:
        made = copies(clips, 1 << 30)
        made.expected = "a.avi", state
        try:
            made.fetch(wanted)
            with made.open_local("a.avi", wanted["a.avi"]) as path:
                return path.read_bytes()
        finally:
            made.copies.release()
            for path in made.copies.folder.glob("??/*"):
                path.unlink()
            assert [each.name for each in (made.copies.folder / PARTIAL).iterdir() if each.suffix != ".lock"] == []

    assert (fetched(), read) == (right, []), "the mark is that of the catalogue"
    file.write_bytes(wrong)
    with pytest.raises(VideoChanged, match="what it stores has the hash"):
        fetched()
    file.write_bytes(right)
    assert (fetched(), len(read)) == (right, 2)

    fetch = Bucket.fetch

    def late(self: Bucket, id: str, to: Path) -> None:
        file.write_bytes(wrong)
        fetch(self, id, to)
        file.write_bytes(right)

    monkeypatch.setattr(Bucket, "fetch", late)
    with pytest.raises(VideoChanged, match="what it stores has the hash"):
        fetched()
