"""The index: what its file keeps, damage to it, tables of earlier releases, and what a catalogue reads from it."""

from __future__ import annotations

import gc
import hashlib
import math
import sqlite3
import stat
import tracemalloc
from collections.abc import Iterable
from contextlib import closing, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.pieces import pieces, shots
from v2v_protocol.errors import IndexUnreadable
from v2v_server.corpus import catalogue as refresh
from v2v_server.corpus import probe
from v2v_server.corpus import videos as columns
from v2v_server.corpus import videos as videos_module
from v2v_server.corpus.catalogue import Catalogue, index_path, open_catalogue
from v2v_server.corpus.index import FigureKind, Figures, Store
from v2v_server.corpus.probe import SceneCollection, figures
from v2v_server.corpus.scenes.scene import ANALYSIS_VERSION, COLUMNS, Flag, Scene
from v2v_server.corpus.sources.folder import Folder
from v2v_server.corpus.sources.listing import silent
from v2v_server.corpus.videos import NO_THRESHOLDS, IndexRow, SplitVideos, Thresholds, Videos, VideoTable, joined
from v2v_server.video.rows import Rows

KIND = SceneCollection(Rows()).kind


class Corpus:
    """Files that are never opened, because the index knows them."""

    def __init__(self, place: Path, count: int = 40) -> None:
        self.folder, self.cache = place / "videos", place / "cache"
        self.folder.mkdir()
        for number in range(count):
            (self.folder / f"{number:03d}.mp4").touch()
        self.index = index_path(self.folder.resolve(), self.cache)
        self.know(*self.names)

    @property
    def names(self) -> list[str]:
        return sorted(path.name for path in self.folder.iterdir())

    def know(self, *names: str, frames: int = 300) -> None:
        """Put files into the index."""
        with closing(Store(self.index)) as store:
            store.put(self.row(name, frames) for name in names)

    def row(self, name: str, frames: int = 300) -> IndexRow:
        status = (self.folder / name).stat()
        times = status.st_mtime_ns, status.st_ctime_ns
        return IndexRow(name, status.st_size, *times, f"0-{name}", frames, 596, 336, 25.0, "h264")

    def open(self, scene: bool = False) -> Catalogue:
        return open_catalogue(self.folder, cache_dir=self.cache, processes=0, scene=scene)


@pytest.fixture
def corpus(tmp_path: Path) -> Corpus:
    return Corpus(tmp_path)


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.tuples(st.floats(0, 1, exclude_max=True), st.integers(0, 255)), min_size=1, max_size=50))
def test_damage_is_an_error_of_sqlite_or_costs_a_probe(tmp_path: Path, damage: list[tuple[float, int]]) -> None:
    path = tmp_path / "index"
    path.unlink(missing_ok=True)
    with closing(Store(path)) as store:
        store.put(IndexRow(name, 1, 2, 3, name * 40, 30, 64, 48, 25.0, "h264", frame_index=b"i") for name in "abcd")
        store.make_figures()
        store.put_figures(KIND, [Figures(name, name * 40, b"s", b"data") for name in "abcd"])
    content = bytearray(path.read_bytes())
    for place, byte in damage:
        content[int(place * len(content))] = byte
    path.write_bytes(content)
    with suppress(sqlite3.Error, UnicodeDecodeError), closing(Store(path)) as store:
        VideoTable.read(joined(list("abcd"), store.rows(KIND), []), 4)
        for name in "abcd":
            store.frame_index(name, name * 40)
        list(store.all_figures(KIND))


def test_other_users_cannot_lock_an_index(corpus: Corpus) -> None:
    corpus.index.chmod(0o644)
    corpus.open().close()
    assert {stat.S_IMODE(path.stat().st_mode) for path in corpus.cache.iterdir()} == {0o600}


def test_figures_count_for_their_kind_version_and_fingerprint_only(corpus: Corpus) -> None:
    kinds = [FigureKind(name, version) for name in ("scene", "noise") for version in ("1", "2")]
    with closing(Store(corpus.index)) as store:
        store.make_figures()
        for number, kind in enumerate(kinds):
            store.put_figures(kind, [Figures("001.mp4", "0-001.mp4", b"%d" % number, b"data %d" % number)])
        store.put_figures(
            kinds[0], [Figures("000.mp4", "0-000.mp4", b"s", b"d"), Figures("002.mp4", "old", b"s", b"d")]
        )
        summaries = {row[0]: row[-1] for row in store.rows(kinds[0])}
        assert summaries == dict.fromkeys(corpus.names) | {"000.mp4": b"s", "001.mp4": b"0"}
        assert {row[-1] for row in store.rows(None)} == {None}
        assert list(store.all_figures(kinds[3])) == [("001.mp4", b"3", b"data 3")]
        assert store.figures("001.mp4", "0-001.mp4", kinds[2]) == b"data 2"
        assert store.figures("001.mp4", "other", kinds[2]) is None
        assert store.figures("003.mp4", "0-003.mp4", kinds[2]) is None


# --- scenes -----------------------------------------------------------------------------------------------------------


def scene_of(name: str) -> Scene:
    """Return a scene with one shot boundary, at a frame of its own for each video."""
    return Scene.of(shots(300, 200 + int(name[:3])), np.full((19, COLUMNS), 2.0))


def scenes(corpus: Corpus) -> list[tuple[str, object]]:
    with closing(corpus.open(scene=True)) as catalogue:
        return [(video.id, video.pieces) for video in catalogue.videos]


def put_scenes(corpus: Corpus) -> None:
    with closing(Store(corpus.index)) as store:
        store.make_figures()
        store.put_figures(KIND, [figures(corpus.row(name), scene_of(name)) for name in corpus.names])


def test_figures_of_other_versions_are_known(corpus: Corpus) -> None:
    put_scenes(corpus)
    with closing(Store(corpus.index)) as store:
        assert not store.has_other_versions("scene", f", look {ANALYSIS_VERSION}")
        assert store.has_other_versions("scene", ", look 1")
        assert not store.has_other_versions("other", ", look 1")


@pytest.mark.parametrize("damaged", ["x'010203'", "'text'"])
def test_damaged_runs_count_as_unknown_and_refuse_no_video(corpus: Corpus, damaged: str) -> None:
    put_scenes(corpus)
    with closing(sqlite3.connect(corpus.index)) as database, database:
        database.execute(f"UPDATE figures SET summary = {damaged} WHERE id = '005.mp4'")
    assert scenes(corpus) == [
        (name, b"" if name == "005.mp4" else shots(300, 200 + int(name[:3])).tobytes()) for name in corpus.names
    ]


def test_an_index_that_fails_after_the_probes_blames_no_video(corpus: Corpus, monkeypatch: pytest.MonkeyPatch) -> None:
    def locked(store: Store, kind: FigureKind) -> None:
        raise sqlite3.OperationalError("database is locked")

    put_scenes(corpus)
    monkeypatch.setattr(Store, "all_figures", locked)
    with pytest.raises(IndexUnreadable, match="cannot be read: database is locked; start again"):
        corpus.open(scene=True)


# --- the table of videos ----------------------------------------------------------------------------------------------

NAMES = sorted(f"{name}-{number}.mp4" for name in ("plain", "Größe", "日本", "𝄞", "a b") for number in range(40))


def row(name: str, number: int) -> IndexRow:
    problem = "is damaged" if number % 7 == 3 else None
    rate = None if number % 5 == 0 else 20.0 + number
    codec = ("h264", "vp9", "av1")[number % 3]
    return IndexRow(
        name,
        -1,
        0,
        0,
        f"{number}-{number:032x}",
        9 + number,
        64,
        48 + number % 2,
        rate,
        codec,
        number % 4 == 0,
        problem,
    )


ROWS = [row(name, number) for number, name in enumerate(NAMES)]


def read(rows: Iterable[tuple[Any, ...]]) -> VideoTable:
    rows = [(*row, None) for row in rows]
    table, _ = VideoTable.read(rows, len(rows))
    return table


def rows_of(table: VideoTable) -> list[IndexRow]:
    return [table.row(at) for at in range(len(table))]


@pytest.fixture
def table(monkeypatch: pytest.MonkeyPatch) -> VideoTable:
    monkeypatch.setattr(columns, "CHUNK", 16)
    return read(record.columns for record in ROWS)


def test_a_table_holds_its_rows(table: VideoTable) -> None:
    assert rows_of(table) == ROWS
    assert list(table.ids) == NAMES
    assert table.ids[11:60] == NAMES[11:60]
    assert table.ids[60:11:-7] == NAMES[60:11:-7]
    assert [table.ids.find(name) for name in NAMES] == list(range(len(NAMES)))
    assert [table.ids.find(name) for name in ("", "b", "plain-7", "￿")] == [None] * 4
    with pytest.raises(IndexError, match="string 200 of 200"):
        table.ids[200]


@settings(max_examples=25)
@given(st.lists(st.booleans(), min_size=len(NAMES), max_size=len(NAMES)))
def test_a_mask_selects_rows(mask: list[bool]) -> None:
    table = read(record.columns for record in ROWS)
    expected = [record for record, is_in in zip(ROWS, mask, strict=True) if is_in]
    assert rows_of(table.where(np.array(mask))) == expected


@given(st.sets(st.sampled_from(NAMES)), st.sets(st.sampled_from(NAMES)))
def test_rows_are_joined_with_the_ids_that_are_asked(asked: set[str], known: set[str]) -> None:
    ids, unasked = sorted(asked), list[str]()
    found = list(joined(ids, ((name, 5) for name in sorted(known)), unasked, (-1,)))
    assert found == [(id, 5 if id in known else -1) for id in ids]
    assert unasked == sorted(known - asked)


def test_an_id_without_a_row_has_to_be_probed() -> None:
    table, states = VideoTable.read(joined(["a"], [], []), 1)
    assert states.tolist() == [[-1, 0, 0]]
    assert table.problem[0] == "the index lost its record; start again to probe it"


_INTEGERS = ["size_bytes", "mtime_ns", "ctime_ns", "frames", "width_px", "height_px", "interlaced"]


@pytest.mark.parametrize(
    ("column", "value"),
    [
        *((column, value) for column in _INTEGERS for value in ("x", b"x", 0.5, "", math.inf, None, 2**70)),
        *((column, value) for column in ("fingerprint", "codec") for value in (b"x", 0.5, None)),
        *(("problem", value) for value in (b"x", 0.5)),
        *((column, value) for column in ("frames", "width_px", "height_px") for value in (-5, 0, 2**40)),
        *(("frames_per_second", value) for value in ("x", b"x", math.inf, -1.0)),
        ("interlaced", 2),
    ],
)
def test_a_damaged_row_has_to_be_probed_and_harms_no_other(
    monkeypatch: pytest.MonkeyPatch, column: str, value: object
) -> None:
    """SQLite accepts any type in any column."""
    monkeypatch.setattr(columns, "CHUNK", 16)
    states = [[number, 10**18 + number, -number] for number in range(len(ROWS))]
    records = [
        replace(record, size_bytes=a, mtime_ns=b, ctime_ns=c) for record, (a, b, c) in zip(ROWS, states, strict=True)
    ]
    records[20] = replace(records[20], **{column: value})  # type: ignore[arg-type]
    states[20] = [-1, 0, 0]
    table, known = VideoTable.read(((*record.columns, None) for record in records), len(records))
    assert known.tolist() == states
    found = rows_of(table)
    assert found[20].id == NAMES[20]
    assert found[20].problem is not None
    assert found[:20] + found[21:] == ROWS[:20] + ROWS[21:]


@pytest.mark.parametrize("all_usable", [False, True])
def test_videos_are_the_usable_ones_and_have_the_digest_of_all_that_shapes_samples(
    table: VideoTable, monkeypatch: pytest.MonkeyPatch, all_usable: bool
) -> None:
    monkeypatch.setattr(videos_module, "CHUNK", 16)
    used = [at for at, record in enumerate(ROWS) if all_usable or record.problem is None]
    thresholds: dict[int, Thresholds] = {3: (0.2, 0.3), 50: (0.25, None)}
    divided = {4: pieces((9, Flag.BLACK)).tobytes(), 5: shots(9, 4).tobytes()}
    table = table.where(np.isin(np.arange(len(ROWS)), used))
    each = [divided.get(number, b"") for number in range(len(table.frames))]
    videos = Videos(table, thresholds, SplitVideos.of(each))
    assert len(videos) == len(used) == (200 if all_usable else 171)
    assert [video.id for video in videos] == [NAMES[at] for at in used]
    assert [videos.fingerprints[number] for number in range(len(used))] == [ROWS[at].fingerprint for at in used]
    assert [videos.find(NAMES[at]) for at in used] == list(range(len(used)))
    assert videos.find("none") is None
    assert videos[-1] == videos[len(used) - 1]
    assert repr(videos[:2]) == repr((videos[0], videos[1]))  # an unknown rate is NaN, which equals nothing
    with pytest.raises(IndexError):
        videos[len(used)]
    assert [video.pieces for video in videos] == each
    sha = hashlib.sha256(f"v2v catalogue 2\n{Rows()}\n".encode())
    for number, at in enumerate(used):
        is_ = ROWS[at]
        rate = math.nan if is_.frames_per_second is None else is_.frames_per_second
        limits = thresholds.get(number, NO_THRESHOLDS)
        fields = is_.id, is_.fingerprint, is_.frames, is_.width_px, is_.height_px, rate, *limits
        sha.update("\0".join(map(str, fields)).encode() + b"\n")
    assert videos.digest(Rows()) == sha.hexdigest()[:32]


# --- what changed -----------------------------------------------------------------------------------------------------

COUNT = 700


def test_a_changed_a_missing_and_an_unknown_file_are_found(tmp_path: Path) -> None:
    ids = [f"{number:04d}.mp4" for number in range(COUNT)]
    for id in ids:
        (tmp_path / id).touch()

    def states(*unknown: int) -> npt.NDArray[np.int64]:
        rows = []
        for number, id in enumerate(ids):
            status = (tmp_path / id).stat()
            size = -1 if number in unknown else status.st_size
            rows.append((size, status.st_mtime_ns, status.st_ctime_ns))
        return np.array(rows)

    notices: list[str] = []
    known = states(300, 301)
    (tmp_path / ids[5]).write_bytes(b"x")
    (tmp_path / ids[130]).chmod(0o600)  # changes only the ctime
    (tmp_path / ids[301]).unlink()
    (tmp_path / ids[699]).unlink()
    assert refresh._changed(Folder(tmp_path), ids, known, notices.append) == [5, 130, 300, 301, 699]
    assert notices[-1] == f"looking at files in {tmp_path}: {COUNT} of {COUNT}, 5 of them new or changed"
    assert refresh._gone(Folder(tmp_path), ids, notices.append) == [ids[301], ids[699]]
    assert notices[-1] == f"looking for files that are gone from {tmp_path}: {COUNT} of {COUNT} that are not listed"


# --- many videos ------------------------------------------------------------------------------------------------------

VIDEOS = 2000
MOST_BYTES = 820
"""At the most at a time, for each video."""
MOST_THAT_STAY = 200


def test_a_video_takes_little_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    corpus = Corpus(tmp_path, VIDEOS)
    monkeypatch.setattr(columns, "CHUNK", 64)  # as little beside this corpus as 4096 are beside a million
    corpus.open().close()  # the modules that it imports do not count
    tracemalloc.start()
    try:
        catalogue = corpus.open()
        stays, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert len(catalogue.videos) == VIDEOS
    catalogue.close()
    assert gc.isenabled(), "it is off while the table is read"
    assert peak / VIDEOS < MOST_BYTES, f"{peak / VIDEOS:.0f} bytes for each video"
    assert stays / VIDEOS < MOST_THAT_STAY, f"{stays / VIDEOS:.0f} bytes for each video"


def test_what_was_probed_is_written_down_after_a_while_even_if_it_is_little() -> None:
    """A kill may not cost the hours that a few long videos took."""
    seconds = iter(range(0, 1000, 4))
    batches = probe.batches(range(10), 10, silent, lambda: next(seconds))
    assert [len(batch) for batch in batches] == [3, 3, 3, 1]
