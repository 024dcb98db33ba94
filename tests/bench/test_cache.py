"""The benchmarks of the cache and of the store, on a clip or two."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from bench import cache
from bench.tradeoff import store
from tests.clips import panned_luma, write_clip


@pytest.fixture(scope="module")
def clips(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("cache-clips")
    for number in range(2):
        write_clip(folder / f"{number}.mp4", panned_luma(210, 136, 160, step=(1, 1 + number)), gop=12)
    return folder


def test_the_cache_is_filled_once_and_then_read(clips: Path, tmp_path: Path) -> None:
    out = tmp_path / "cache.json"
    assert cache.main(["--videos", str(clips), "--rows", "full", "--turns", "1", "--json", str(out)]) in (0, 1)
    source, fill, hits = json.loads(out.read_text(encoding="utf-8"))
    assert [record["way"] for record in (source, fill, hits)] == list(cache.WAYS)
    assert source["samples"] == 2
    assert source["of_source"] == 1.0
    assert source["cache_mib"] == 0.0
    assert fill["cache_mib"] > 0.1
    assert hits["ms_per_sample"] > 0
    assert hits["read"] + hits["view"] + hits["kernel"] == pytest.approx(1.0)


def test_the_bar_is_on_filling() -> None:
    records = [{"way": way, "of_source": ratio} for way, ratio in zip(cache.WAYS, (1.0, 1.2, 9.0), strict=True)]
    assert not cache.missed(records)
    records[1]["of_source"] = 1.21
    assert cache.missed(records) == ["fill: 1.21 of source, at most 1.2 was asked"]


def test_a_corpus_without_a_sequence_is_status_2(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cache.main(["--videos", str(tmp_path)]) == 2
    assert capsys.readouterr().err.startswith("cache: ")


def test_every_form_of_store_gives_back_its_crops(clips: Path, tmp_path: Path) -> None:
    """A form that gave other pixels would end the command."""
    out = tmp_path / "store.json"
    flags = ["--rows", "full", "--clips", "1", "--places", "1", "--seconds", "0.01", "--json", str(out)]
    assert store.main(["--videos", str(clips), *flags]) == 0
    records = json.loads(out.read_text(encoding="utf-8"))
    assert {"FFV1"} < {record["form"] for record in records}
    assert all(record["read_seconds"] > 0 for record in records)
