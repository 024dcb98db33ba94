"""What users kept with an earlier release continues to the same bytes, or is refused with the remedy.

Each folder ``numerics-N`` was written by ``make.py`` with the release that first had ``NUMERICS_VERSION`` N. The
present version must give the bytes of the fixture. A state or checkpoint of an earlier version is refused by number;
stores, caches, indexes and recipes of earlier versions go on. Folders ``planes-N-A`` are of videos with colour, deep
light, motion, scenes and labels; a release with another ``ANALYSIS_VERSION`` analyses the scenes again, and its streams
with scenes begin again. Folders ``recordings-M-N`` are of prepared recordings, in form M of their file.
"""

from __future__ import annotations

import json
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.compatibility.make import (
    CUT,
    RECORDINGS,
    ROWS,
    STREAM_FLAGS,
    labelled,
    plane_digests,
    recording_digests,
    sample_digests,
    stream,
    tensors_digest,
    train,
)
from tests.digests.rows import ROWS as PLANE_ROWS
from tests.digests.rows import digest
from trainer.run.checkpoint import load_checkpoint
from v2v_client.local_server import LocalServer
from v2v_protocol import NUMERICS_VERSION
from v2v_protocol.errors import StateMismatch
from v2v_protocol.recipe import Recipe
from v2v_protocol.spec import StreamSpec
from v2v_server.corpus import catalogue as refresh
from v2v_server.corpus.catalogue import open_catalogue
from v2v_server.corpus.index import SCHEMA_VERSION
from v2v_server.corpus.scenes.analysis import SceneAnalysis
from v2v_server.corpus.scenes.scene import ANALYSIS_VERSION
from v2v_server.store.cache import Cache
from v2v_server.video.rows import Rows

FIXTURES = sorted(Path(__file__).parent.glob("numerics-*"))
PLANES = sorted(Path(__file__).parent.glob("planes-*"))


@pytest.fixture(params=FIXTURES, ids=lambda path: path.name)
def fixture(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """Return a copy of a fixture that a test may write to."""
    return Path(shutil.copytree(request.param, tmp_path / "fixture"))


@pytest.fixture(params=PLANES, ids=lambda path: path.name)
def planes(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """Return a copy of a fixture of planes that a test may write to."""
    return Path(shutil.copytree(request.param, tmp_path / "fixture"))


def expected(fixture: Path) -> dict[str, Any]:
    values: dict[str, Any] = json.loads((fixture / "expected.json").read_text())
    return values


def is_present(fixture: Path) -> bool:
    return bool(expected(fixture)["numerics_version"] == NUMERICS_VERSION)


def has_same_analysis(planes: Path) -> bool:
    return expected(planes)["analysis_version"] == ANALYSIS_VERSION


def digests(videos: Path, *flags: str, fixture: Path, state: Any = None) -> list[str]:
    batches = stream(videos, *flags, recipe=fixture / "recipe.yaml", state=state)
    return [digest for batch in batches for digest in sample_digests(batch)]


def test_there_are_fixtures_of_the_present_version() -> None:
    assert f"numerics-{NUMERICS_VERSION}" in [path.name for path in FIXTURES]
    assert f"planes-{NUMERICS_VERSION}-{ANALYSIS_VERSION}" in [path.name for path in PLANES]
    assert RECORDINGS.is_dir()


def test_a_recipe_keeps_its_digest(fixture: Path) -> None:
    state = json.loads((fixture / "state.json").read_text())
    assert StreamSpec.from_dict(state["spec"]).digest == expected(fixture)["spec_digest"] == state["spec_digest"]
    fields = yaml.safe_load((fixture / "recipe.yaml").read_text())
    assert Recipe.from_dict(fields) == StreamSpec.from_dict(state["spec"]).recipe


@pytest.mark.slow
@pytest.mark.parametrize("source", ["videos", "store", "cache"])
def test_every_source_gives_the_bytes_of_the_release_that_wrote_it(fixture: Path, source: str) -> None:
    cache = ["--cache", str(fixture / "cache")] if source == "cache" else []
    rows = [] if source == "store" else ["--rows", ROWS]
    videos = fixture / ("store" if source == "store" else "videos")
    pieces = {path: path.stat().st_mtime_ns for path in fixture.glob("cache/??/*")}
    assert pieces
    assert digests(videos, *cache, *rows, fixture=fixture) == expected(fixture)["samples"]
    assert {path: path.stat().st_mtime_ns for path in fixture.glob("cache/??/*")} == pieces, "made again"


@pytest.mark.slow
def test_a_saved_state_continues_or_is_refused_with_both_numbers(fixture: Path) -> None:
    state = json.loads((fixture / "state.json").read_text())
    if is_present(fixture):
        after = digests(fixture / "videos", "--rows", ROWS, fixture=fixture, state=state)
        assert after == expected(fixture)["samples"][2 * CUT :]
        return
    with pytest.raises(StateMismatch) as refused:
        digests(fixture / "videos", "--rows", ROWS, fixture=fixture, state=state)
    assert f"has {expected(fixture)['numerics_version']}" in str(refused.value)
    assert f"has {NUMERICS_VERSION}; serve with the release that the state was saved with" in str(refused.value)


def test_a_checkpoint_keeps_its_weights(fixture: Path) -> None:
    assert tensors_digest(load_checkpoint(fixture / "last.pt").model) == expected(fixture)["model"]


@pytest.mark.slow
def test_a_checkpoint_is_resumed_or_refused_with_both_numbers(fixture: Path, tmp_path: Path) -> None:
    done = train(fixture / "videos", tmp_path / "run", steps=5, resume=fixture / "last.pt")
    if is_present(fixture):
        assert done.returncode == 0, done.stderr
        assert load_checkpoint(tmp_path / "run" / "last.pt").step == 5
        return
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    assert f"has {expected(fixture)['numerics_version']}" in done.stderr
    assert f"has {NUMERICS_VERSION}; serve with the release that the state was saved with" in done.stderr


def taken_over(fixture: Path) -> tuple[Path, int]:
    """Put the fixture's index where a start looks for it; return the folder of indexes, and the index's version."""
    cache, videos = fixture / "user-cache", fixture / "videos"
    index = refresh.index_path(videos.resolve(), cache)
    cache.mkdir()
    shutil.copy(fixture / "index.sqlite3", index)
    with closing(sqlite3.connect(index)) as database, database:
        (version,) = database.execute("PRAGMA user_version").fetchone()
        # The copies have other times of modification than the files that were probed.
        for path in videos.iterdir():
            state = path.stat()
            database.execute(
                "UPDATE video SET size_bytes = ?, mtime_ns = ?, ctime_ns = ? WHERE id = ?",
                (state.st_size, state.st_mtime_ns, state.st_ctime_ns, path.name),
            )
    return cache, version


def test_an_index_is_taken_over_or_replaced_with_a_note(fixture: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cache, version = taken_over(fixture)
    probed: list[str] = []
    probe = refresh.probe_files
    monkeypatch.setattr(refresh, "probe_files", lambda root, ids, *rest: probed.extend(ids) or probe(root, ids, *rest))
    with closing(open_catalogue(fixture / "videos", rows=Rows.parse(ROWS), cache_dir=cache, processes=0)) as catalogue:
        assert [video.id for video in catalogue.videos] == ["a.mp4", "b.webm"]
        if version == SCHEMA_VERSION:
            assert probed == []
        else:
            assert f"(version {version}, this one has {SCHEMA_VERSION})" in catalogue.notes[0]
        if is_present(fixture):
            assert catalogue.digest == expected(fixture)["catalogue_digest"]


def test_planes_give_the_bytes_of_the_release_that_wrote_them(planes: Path) -> None:
    """From the store, from the cache, which is not written again, and from the videos."""
    was = expected(planes)
    shutil.copy(planes / "videos" / "a.boxes.json", planes / "store")
    pieces = {path: path.stat().st_mtime_ns for path in planes.glob("cache/??/*")}
    cache = Cache(planes / "cache", 1 << 30, least_free_bytes=0)
    for folder, kept in (("store", None), ("videos", cache), ("videos", None)):
        rows = PLANE_ROWS if folder == "videos" else None
        with closing(open_catalogue(planes / folder, rows=rows, cache_dir=planes, scene=True, processes=0)) as opened:
            assert plane_digests(opened, kept) == was["streams"], (folder, kept)
            assert opened.digest == was["catalogue_digest"]
            assert (opened.scene_digest == was["scene_digest"]) == has_same_analysis(planes)
    assert pieces
    assert {path: path.stat().st_mtime_ns for path in planes.glob("cache/??/*")} == pieces


def test_scenes_in_an_index_are_taken_over_or_analysed_again(planes: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cache, version = taken_over(planes)
    is_present = version == SCHEMA_VERSION and has_same_analysis(planes)
    if is_present:
        monkeypatch.setattr(SceneAnalysis, "add", None)
    with closing(
        open_catalogue(planes / "videos", rows=PLANE_ROWS, cache_dir=cache, scene=True, processes=0)
    ) as catalogue:
        assert (catalogue.scene_digest == expected(planes)["scene_digest"]) == has_same_analysis(planes)
        assert plane_digests(catalogue, None) == expected(planes)["streams"]


@pytest.mark.slow
def test_a_state_with_labels_and_scenes_continues_or_is_refused(planes: Path) -> None:
    was, state = expected(planes)["labelled"], json.loads((planes / "state.json").read_text())
    with LocalServer(planes / "videos", workers=1, flags=STREAM_FLAGS) as server:
        if not has_same_analysis(planes):
            with pytest.raises(StateMismatch, match="so does a release that analyses scenes in another way"):
                labelled(server.address, state)
            return
        batches = labelled(server.address, state)
    found = [digest(batch.arrays[name].numpy()) for batch in batches for name in batch.arrays]
    assert found == was[len(batches[0].arrays) :]


@pytest.mark.parametrize("recordings", sorted(Path(__file__).parent.glob("recordings-*")), ids=lambda path: path.name)
def test_prepared_recordings_give_the_bytes_of_the_release_that_wrote_them(recordings: Path, tmp_path: Path) -> None:
    was = expected(recordings)
    found = recording_digests(recordings / "recordings", tmp_path)
    # Rows that came later are not in the fixture.
    found["streams"] = {name: found["streams"][name] for name in was["streams"]}
    assert found == {name: was[name] for name in found}
