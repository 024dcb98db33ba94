"""The index file: what it keeps, damage to it, and tables of earlier releases."""

from __future__ import annotations

import sqlite3
import stat
from contextlib import closing, suppress
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.pieces import shots
from v2v_protocol.errors import IndexUnreadable
from v2v_server.corpus.catalogue import Catalogue, index_path, open_catalogue
from v2v_server.corpus.index import FigureKind, Figures, IndexRow, Store
from v2v_server.corpus.probe import SceneCollection, figures
from v2v_server.corpus.scenes.scene import ANALYSIS_VERSION, COLUMNS, Scene
from v2v_server.corpus.videos import VideoTable, joined
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


def facts(catalogue: Catalogue) -> tuple[str, list[tuple[str, int]]]:
    with closing(catalogue):
        return catalogue.digest, [(video.id, video.frames) for video in catalogue.videos]


def test_known_videos_come_from_the_index_and_changes_are_probed(corpus: Corpus) -> None:
    first = facts(corpus.open())
    assert first[1] == [(name, 300) for name in corpus.names]
    corpus.know("007.mp4", frames=301)
    assert dict(facts(corpus.open())[1])["007.mp4"] == 301
    (corpus.folder / "003.mp4").unlink()
    (corpus.folder / "004.mp4").write_bytes(b"no video")
    (corpus.folder / "0035.mp4").write_bytes(b"none either")
    changed = facts(corpus.open())
    assert [name for name, _ in changed[1]] == [name for name in corpus.names if name not in ("004.mp4", "0035.mp4")]
    assert facts(corpus.open()) == changed


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


def scene_of(name: str, boundary: int = 200) -> Scene:
    """Return a scene with one shot boundary, at a frame of its own for each video."""
    return Scene.of(shots(300, boundary + int(name[:3])), np.full((19, COLUMNS), 2.0))


def scenes(corpus: Corpus) -> tuple[str | None, list[tuple[str, object]]]:
    with closing(corpus.open(scene=True)) as catalogue:
        return catalogue.scene_digest, [(video.id, video.pieces) for video in catalogue.videos]


def put_scenes(corpus: Corpus, *names: str, boundary: int = 200) -> None:
    with closing(Store(corpus.index)) as store:
        store.make_figures()
        store.put_figures(KIND, [figures(corpus.row(name), scene_of(name, boundary)) for name in names])


def test_scenes_come_from_the_index(corpus: Corpus) -> None:
    put_scenes(corpus, *corpus.names)
    first = scenes(corpus)
    assert dict(first[1])["007.mp4"] == shots(300, 207).tobytes()
    assert scenes(corpus) == first
    put_scenes(corpus, "007.mp4", boundary=100)
    digest, runs = scenes(corpus)
    assert digest != first[0]
    assert dict(runs)["007.mp4"] == shots(300, 107).tobytes()
    (corpus.folder / "003.mp4").unlink()
    fewer = scenes(corpus)
    assert fewer[0] not in (digest, first[0])
    assert fewer[1] == [each for each in runs if each[0] != "003.mp4"]


def test_figures_of_other_versions_are_known(corpus: Corpus) -> None:
    put_scenes(corpus, *corpus.names)
    with closing(Store(corpus.index)) as store:
        assert not store.has_other_versions("scene", f", look {ANALYSIS_VERSION}")
        assert store.has_other_versions("scene", ", look 1")
        assert not store.has_other_versions("other", ", look 1")


def test_damaged_runs_count_as_unknown(corpus: Corpus) -> None:
    put_scenes(corpus, *corpus.names)
    with closing(sqlite3.connect(corpus.index)) as database, database:
        database.execute("UPDATE figures SET summary = x'010203' WHERE id = '005.mp4'")
    assert dict(scenes(corpus)[1])["005.mp4"] == b""


def test_a_summary_of_another_type_is_missing_and_refuses_no_video(corpus: Corpus) -> None:
    put_scenes(corpus, *corpus.names)
    with closing(sqlite3.connect(corpus.index)) as database, database:
        database.execute("UPDATE figures SET summary = 'text' WHERE id = '005.mp4'")
    with closing(Store(corpus.index)) as store:
        table, _ = VideoTable.read(store.rows(KIND), len(corpus.names))
    assert table.row(5).problem is None
    assert table.summaries.lengths[4:7].tolist() == [table.summaries.lengths[4], 0, table.summaries.lengths[4]]


def test_an_index_that_fails_after_the_probes_blames_no_video(corpus: Corpus, monkeypatch: pytest.MonkeyPatch) -> None:
    def locked(store: Store, kind: FigureKind) -> None:
        raise sqlite3.OperationalError("database is locked")

    put_scenes(corpus, *corpus.names)
    monkeypatch.setattr(Store, "all_figures", locked)
    with pytest.raises(IndexUnreadable, match="cannot be read: database is locked; start again"):
        corpus.open(scene=True)


def test_the_digest_of_scenes_is_computed_once(corpus: Corpus, monkeypatch: pytest.MonkeyPatch) -> None:
    put_scenes(corpus, *corpus.names)
    first, reads, all_figures = scenes(corpus), list[FigureKind](), Store.all_figures
    monkeypatch.setattr(Store, "all_figures", lambda store, kind: reads.append(kind) or all_figures(store, kind))
    assert scenes(corpus) == first
    assert KIND not in reads
    put_scenes(corpus, "007.mp4", boundary=100)
    assert scenes(corpus)[0] != first[0]
    assert KIND in reads
