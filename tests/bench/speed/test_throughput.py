"""The throughput benchmark: its arithmetic, and one small turn for real."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import pytest

from bench.speed import throughput
from bench.speed.contenders import Contender, Corpus, Measured, Setting, line_up
from tests.clips import panned_luma, write_clip

SOURCE, MADE = Corpus("source", Path("a"), "full"), Corpus("h264", Path("b"), "full")


def test_every_corpus_has_its_limit_and_the_baseline_comes_first() -> None:
    labels = [contender.label for contender in line_up(SOURCE, [MADE], ["fast", "exact"])]
    assert labels == [
        "released, source", "decode, source", "exact, source", "fast, source",
        "decode, h264", "exact, h264", "fast, h264",
    ]  # fmt: skip


@dataclass(frozen=True)
class Told(Contender):
    """A contender whose turns are known."""

    turns: tuple[tuple[int, float], ...] = ()

    def measure(self, setting: Setting) -> Measured:
        batches, cpu = self.turns[TURN[self.label]]
        TURN[self.label] += 1
        return Measured(batches, 10.0, cpu)


TURN: dict[str, int] = {}


def test_ratios_are_medians_of_the_ratios_within_a_turn() -> None:
    contenders = [
        Told("released", SOURCE, turns=((10, 20.0), (5, 20.0), (10, 20.0))),
        Told("decode", SOURCE, turns=((50, 20.0), (25, 20.0), (40, 20.0))),
        Told("exact", SOURCE, turns=((40, 20.0), (20, 20.0), (30, 20.0))),
    ]
    TURN.update({contender.label: 0 for contender in contenders})
    baseline, _, exact = throughput.compare(contenders, Setting(2, 12, 10.0, 0), 3)
    assert baseline["ratio_to_baseline"] == 1.0
    assert (exact["ratio_to_baseline"], exact["batches_per_second"]) == (4.0, 3.0)
    assert (exact["ratio_to_baseline_lowest"], exact["ratio_to_baseline_highest"]) == (3.0, 4.0)
    assert exact["ratio_to_decode_limit"] == pytest.approx(0.8)
    assert exact["cpu_ratio_to_baseline"] == pytest.approx(4.0)
    said = throughput.missed([baseline, exact])
    assert said == ["exact, source: ratio_to_decode_limit 0.80, at least 0.9 was asked"]


def test_a_form_of_a_codec_has_the_bar_of_the_codec() -> None:
    record = {"label": "exact, dense-tmpfs", "ratio_to_baseline": 24.0, "cpu_ratio_to_baseline": 26.0}
    said = throughput.missed([record | {"ratio_to_decode_limit": 0.7}])
    assert said == ["exact, dense-tmpfs: ratio_to_baseline 24.00, at least 25 was asked"]


def test_clips_with_many_keyframes_have_a_bar_of_their_own() -> None:
    record = {"label": "exact, dense-12", "ratio_to_baseline": 20.0, "cpu_ratio_to_baseline": 19.0}
    said = throughput.missed([record | {"ratio_to_decode_limit": 0.7}])
    assert said == ["exact, dense-12: cpu_ratio_to_baseline 19.00, at least 20 was asked"]


def test_a_prepared_corpus_needs_a_name_and_a_preset_must_exist(capsys: pytest.CaptureFixture[str]) -> None:
    assert throughput.main(["--videos", "x", "--prepared", "folder"]) == 2
    assert throughput.main(["--videos", "x", "--presets", "faster"]) == 2
    text = capsys.readouterr().err
    assert "--prepared folder: write NAME=DIR" in text
    assert "--presets faster: choose of exact, balanced, fast" in text


@pytest.mark.slow
def test_one_turn(tmp_path: Path) -> None:
    folder = tmp_path / "clips"
    folder.mkdir()
    for number in range(2):
        write_clip(folder / f"{number}.mp4", panned_luma(601, 128, 160, step=(1, 1)), gop=50)
    file, picture = tmp_path / "out.json", tmp_path / "out.png"
    throughput.main([
        "--videos", str(folder), "--rows", "full", "--presets", "exact,fast", "--seconds", "0.5", "--turns", "1",
        "--workers", "1", "--batch-size", "1", "--warmup-batches", "1", "--json", str(file), "--plot", str(picture),
    ])  # fmt: skip
    records = json.loads(file.read_text())
    assert [record["name"] for record in records] == ["released", "decode", "exact", "fast"]
    keys = {
        "name", "preset", "corpus", "samples_per_decode", "workers", "batches_per_second", "cpu_seconds_per_batch",
        "ratio_to_baseline", "ratio_to_decode_limit",
    }  # fmt: skip
    assert all(keys <= record.keys() for record in records)
    assert records[-1]["samples_per_decode"] > 2
    assert picture.stat().st_size > 1000
