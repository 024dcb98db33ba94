"""The copy of an index's columns: used where it is one, and of no account where it is not."""

from __future__ import annotations

import errno
import math
import os
import sqlite3
import stat
from collections.abc import Iterator
from contextlib import closing, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from v2v_server.corpus import refresh
from v2v_server.corpus.catalogue import Catalogue, open_catalogue
from v2v_server.corpus.index import copy as copy_module
from v2v_server.corpus.index import file as file_module
from v2v_server.corpus.index.columns import Records
from v2v_server.corpus.index.copy import NoCopy, copied, copy_path, read_copy
from v2v_server.corpus.index.file import IndexRow, Store
from v2v_server.corpus.refresh import index_path
from v2v_server.corpus.scene import COLUMNS, Scene
from v2v_server.corpus.scenes import Looking
from v2v_server.video.rows import Rows

PARTS = [{"ids": [b"a", b"1"], "n": [1, 2]}, {"ids": [b"b", b"2"], "n": []}]


class Corpus:
    """Files that nobody opens, because the index knows them."""

    def __init__(self, place: Path, count: int = 40) -> None:
        self.folder, self.cache = place / "videos", place / "cache"
        self.folder.mkdir()
        for number in range(count):
            (self.folder / f"{number:03d}.mp4").touch()
        self.index = index_path(self.folder.resolve(), self.cache)
        self.know(*(path.name for path in self.folder.iterdir()))

    def know(self, *names: str, frames: int = 300) -> None:
        """Notes them down in the index."""
        rows = []
        for name in names:
            status = (self.folder / name).stat()
            times = status.st_mtime_ns, status.st_ctime_ns
            rows.append(IndexRow(name, status.st_size, *times, f"0-{name}", frames, 596, 336, 25.0, "h264"))
        with closing(Store(self.index)) as store:
            store.put(rows)

    def open(self) -> Catalogue:
        return open_catalogue(self.folder, cache_dir=self.cache, processes=0)


@pytest.fixture
def corpus(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Corpus:
    monkeypatch.setattr(refresh, "CHUNK", 16)
    monkeypatch.setattr(file_module, "MARKED_FROM", 30)
    return Corpus(tmp_path)


@pytest.fixture
def read(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Receives a number whenever the rows of an index are read."""
    reads: list[int] = []
    rows = Store.rows

    def counted(store: Store) -> Iterator[tuple[Any, ...]]:
        reads.append(len(reads))
        return rows(store)

    monkeypatch.setattr(Store, "rows", counted)
    return reads


def facts(catalogue: Catalogue) -> tuple[str, list[tuple[str, int]]]:
    with closing(catalogue):
        return catalogue.digest, [(video.id, video.frames) for video in catalogue.videos]


def test_a_second_start_reads_the_copy_and_finds_the_same(corpus: Corpus, read: list[int]) -> None:
    first = facts(corpus.open())
    assert len(read) == 1
    assert facts(corpus.open()) == first
    assert len(read) == 1
    assert len(first[1]) == 40


def test_who_writes_the_index_makes_the_copy_worthless(corpus: Corpus, read: list[int]) -> None:
    corpus.open().close()
    corpus.know("007.mp4", frames=301)
    digest, videos = facts(corpus.open())
    assert dict(videos)["007.mp4"] == 301
    assert len(read) == 2
    assert facts(corpus.open()) == (digest, videos)
    assert len(read) == 2


def test_what_a_start_finds_changed_is_in_the_copy_that_it_leaves(corpus: Corpus, read: list[int]) -> None:
    corpus.open().close()
    (corpus.folder / "003.mp4").unlink()
    (corpus.folder / "004.mp4").write_bytes(b"no video")
    (corpus.folder / "0035.mp4").write_bytes(b"none either")
    changed = facts(corpus.open())
    assert [name for name, _ in changed[1]] == [f"{number:03d}.mp4" for number in range(40) if number not in (3, 4)]
    before = len(read)
    assert facts(corpus.open()) == changed
    assert len(read) == before


@pytest.mark.parametrize("where", [0.0, 0.3, 0.6, 0.999])
@pytest.mark.parametrize("how", ["flipped", "cut off"])
def test_a_damaged_copy_is_as_good_as_none(corpus: Corpus, read: list[int], where: float, how: str) -> None:
    first = facts(corpus.open())
    path = copy_path(corpus.index)
    data = bytearray(path.read_bytes())
    at = int(where * len(data))
    if how == "flipped":
        data[at] ^= 0x10
    else:
        del data[at:]
    path.write_bytes(data)
    assert facts(corpus.open()) == first
    assert len(read) == 2
    assert facts(corpus.open()) == first
    assert len(read) == 2, "a sound one took its place"


@pytest.mark.parametrize("allowed", [0, 1, 3])
def test_a_full_disk_costs_the_copy_and_nothing_else(
    corpus: Corpus, read: list[int], monkeypatch: pytest.MonkeyPatch, allowed: int
) -> None:
    put, written = copy_module._put, list[int]()

    def full(file: Any, data: bytes) -> bool:
        written.append(len(data))
        return len(written) <= allowed and put(file, data)

    with monkeypatch.context() as patch:
        patch.setattr(copy_module, "_put", full)
        catalogue = corpus.open()
    assert catalogue.notes == ()
    first = facts(catalogue)
    assert sorted(os.listdir(corpus.cache)) == [corpus.index.name]
    assert facts(corpus.open()) == first
    assert len(read) == 2


def test_a_folder_that_takes_no_copy_is_no_fault(corpus: Corpus, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(path: Path, flags: int) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS), path)

    monkeypatch.setattr(copy_module, "open_private", refused)
    assert len(facts(corpus.open())[1]) == 40
    assert sorted(os.listdir(corpus.cache)) == [corpus.index.name]


def test_the_parts_come_back_under_their_mark_only(tmp_path: Path) -> None:
    index = tmp_path / "index.sqlite3"
    assert list(copied(index, "mark", PARTS)) == PARTS
    assert list(read_copy(index, "mark")) == PARTS
    for mark in ("", "mark 2", "mar"):
        with pytest.raises(NoCopy):
            list(read_copy(index, mark))
    with pytest.raises(NoCopy):
        list(read_copy(None, "mark"))


def test_who_stops_in_the_middle_leaves_no_copy(tmp_path: Path) -> None:
    begun = copied(tmp_path / "index.sqlite3", "mark", PARTS)
    next(begun)
    begun.close()
    assert list(tmp_path.iterdir()) == []


def with_scenes(corpus: Corpus, *names: str, cut: int = 200) -> None:
    """Notes down a look at each video: one cut, at a frame of its own."""
    values = np.full((19, COLUMNS), 2.0)
    with closing(Store(corpus.index)) as store:
        store.not_looked_at("")  # makes the table
        looks = [(name, f"0-{name}", Scene.of(300, (cut + int(name[:3]),), values).to_bytes()) for name in names]
        store.put_scenes((id, mark, Looking(Rows(), None).key, data) for id, mark, data in looks)


def seen(corpus: Corpus) -> tuple[str | None, list[tuple[str, object]]]:
    with closing(open_catalogue(corpus.folder, cache_dir=corpus.cache, processes=0, scene=True)) as catalogue:
        return catalogue.scene_digest, [(video.id, video.runs) for video in catalogue.videos]


def test_what_is_known_of_scenes_is_kept_until_the_index_changes(
    corpus: Corpus, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = [path.name for path in corpus.folder.iterdir()]
    with_scenes(corpus, *names)
    first = seen(corpus)
    assert dict(first[1])["007.mp4"] == ((0, 207), (207, 300))
    asked: list[str] = []
    scene = Store.scene
    monkeypatch.setattr(Store, "scene", lambda store, id, *more: asked.append(id) or scene(store, id, *more))
    assert seen(corpus) == first
    assert asked == []
    with_scenes(corpus, "007.mp4", cut=100)
    digest, runs = seen(corpus)
    assert len(asked) == 40
    assert digest != first[0]
    assert dict(runs)["007.mp4"] == ((0, 107), (107, 300))
    path = copy_path(corpus.index, "scenes")
    path.write_bytes(path.read_bytes()[:-9])
    assert seen(corpus) == (digest, runs)
    assert len(asked) == 80
    (corpus.folder / "003.mp4").unlink()  # another catalogue, with another digest
    fewer = seen(corpus)
    assert fewer[0] not in (digest, first[0])
    assert fewer[1] == [each for each in runs if each[0] != "003.mp4"]


def test_a_small_index_has_no_copy(corpus: Corpus, tmp_path: Path) -> None:
    (tmp_path / "small").mkdir()
    small = Corpus(tmp_path / "small", count=29)
    small.open().close()
    assert sorted(os.listdir(small.cache)) == [small.index.name]


_WHOLE = ["size_bytes", "mtime_ns", "ctime_ns", "frames", "width_px", "height_px", "interlaced"]


@pytest.mark.parametrize(
    ("column", "value"),
    [
        *((column, value) for column in _WHOLE for value in ("x", b"x", 0.5, "", math.inf)),
        *((column, value) for column in ("id", "fingerprint", "codec", "problem") for value in (b"x", 0.5)),
        *((column, value) for column in ("frames", "width_px", "height_px") for value in (-5, 0, 2**40)),
        *(("frames_per_second", value) for value in ("x", b"x", math.inf, -1.0)),
        *(("frame_index", value) for value in (5, 0.5, "x")),
    ],
)
def test_a_damaged_record_is_as_good_as_none(tmp_path: Path, column: str, value: object) -> None:
    """SQLite takes any type in any column."""
    row = IndexRow("a", 1, 2, 3, "f", 30, 64, 48, 25.0, "h264", frame_index=b"i")
    with closing(Store(tmp_path / "index")) as store:
        store.put([row, replace(row, id="b")])
        (kept,) = [each for each in store.rows() if each[0] == "b"]
        store._database.execute(f"UPDATE video SET {column} = ? WHERE id = 'a'", (value,))
        if column in ("id", "fingerprint", "codec", "problem") and isinstance(value, float):
            assert len(list(store.rows())) == 2  # it has become text
        else:
            assert list(store.rows()) == [kept]


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.tuples(st.floats(0, 1, exclude_max=True), st.integers(0, 255)), min_size=1, max_size=50))
def test_damage_costs_a_note_or_nothing(tmp_path: Path, damage: list[tuple[float, int]]) -> None:
    path = tmp_path / "index"
    path.unlink(missing_ok=True)
    with closing(Store(path)) as store:
        store.put(IndexRow(name, 1, 2, 3, name * 40, 30, 64, 48, 25.0, "h264", frame_index=b"i") for name in "abcd")
    content = bytearray(path.read_bytes())
    for place, byte in damage:
        content[int(place * len(content))] = byte
    path.write_bytes(content)
    with suppress(sqlite3.Error, UnicodeDecodeError), closing(Store(path)) as store:
        records = Records()
        records.extend(list(store.rows()))
        for name in "abcd":
            store.frame_index(name, name * 40)


def test_other_users_cannot_lock_an_index_or_its_copy(corpus: Corpus) -> None:
    corpus.index.chmod(0o644)
    corpus.open().close()
    assert copy_path(corpus.index, "columns").exists()
    assert {stat.S_IMODE(path.stat().st_mode) for path in corpus.cache.iterdir()} == {0o600}


def test_a_mark_names_a_state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(file_module, "MARKED_FROM", 1)

    def mark(store: Store) -> str:
        with store.reading() as found:
            return found

    with closing(Store(tmp_path / "one")) as one, closing(Store(tmp_path / "one")) as other:
        assert mark(one) == mark(other) == ""  # it is empty
        other.put([IndexRow("a", 1)])
        first = mark(one)
        assert mark(other) == first != ""
        other.mark_stale("a")
        assert mark(one) != first
        assert mark(other) == mark(one)
    with closing(Store(None)) as memory:
        assert mark(memory) == ""
    with closing(Store(tmp_path / "two")) as two:
        two.put([IndexRow("a", 1)])
        assert mark(two) not in ("", first)
        two._database.execute("PRAGMA journal_mode = WAL").fetchone()
        two.put([IndexRow("a", 1)])
        assert mark(two) == ""
