"""What a catalogue of many videos costs, by what each of them costs."""

from __future__ import annotations

import gc
import tracemalloc
from pathlib import Path

import pytest

from v2v_server.corpus import probe
from v2v_server.corpus import videos as columns
from v2v_server.corpus.catalogue import index_path, open_catalogue
from v2v_server.corpus.index import IndexRow, Store
from v2v_server.corpus.sources.source import silent

VIDEOS = 2000
MOST_BYTES = 820
"""At the most at a time, for each video."""
MOST_THAT_STAY = 200


@pytest.fixture
def corpus(tmp_path: Path) -> Path:
    """Make a folder of files that are never opened, because the index knows them."""
    folder = tmp_path / "videos"
    folder.mkdir()
    rows = []
    for number in range(VIDEOS):
        file = folder / f"{1_000_000_000 + number}.mp4"
        file.touch()
        status = file.stat()
        rows.append(
            IndexRow(
                file.name,
                0,
                status.st_mtime_ns,
                status.st_ctime_ns,
                f"{number:032x}",
                300 + number,
                596,
                336,
                29.97,
                "h264",
                False,
                None,
                "",
                b"index",
            )
        )
    store = Store(index_path(folder.resolve(), tmp_path / "cache"))
    store.put(rows)
    store.close()
    return folder


def test_a_video_takes_little_memory(corpus: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(columns, "CHUNK", 64)  # as little beside this corpus as 4096 are beside a million
    open_catalogue(corpus, cache_dir=tmp_path / "cache").close()  # the modules that it imports do not count
    tracemalloc.start()
    try:
        catalogue = open_catalogue(corpus, cache_dir=tmp_path / "cache")
        stays, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert len(catalogue.videos) == VIDEOS
    assert catalogue.frame_index_bytes(catalogue.videos[7].id, 0, 1) == b"index"
    catalogue.close()
    assert peak / VIDEOS < MOST_BYTES, f"{peak / VIDEOS:.0f} bytes for each video"
    assert stays / VIDEOS < MOST_THAT_STAY, f"{stays / VIDEOS:.0f} bytes for each video"


def test_what_stays_is_not_looked_through_again_and_again(corpus: Path, tmp_path: Path) -> None:
    collections = [0]

    def count(phase: str, info: dict[str, int]) -> None:
        collections[0] += phase == "start"

    before = gc.get_threshold()
    gc.set_threshold(100)
    gc.callbacks.append(count)
    try:
        open_catalogue(corpus, cache_dir=tmp_path / "cache").close()
    finally:
        gc.callbacks.remove(count)
        gc.set_threshold(*before)
    assert gc.isenabled()
    assert collections[0] < 2 * VIDEOS / 100, "as often as the objects that are made ask for"


def test_what_was_probed_is_written_down_after_a_while_even_if_it_is_little() -> None:
    """A kill may not cost the hours that a few long videos took."""
    seconds = iter(range(0, 1000, 4))
    batches = probe.batches(range(10), 10, silent, lambda: next(seconds))
    assert [len(batch) for batch in batches] == [3, 3, 3, 1]
