"""The throughput bench: its arithmetic."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import pytest

from bench.speed import throughput
from bench.speed.throughput import Contender, Corpus, Measured, line_up

SOURCE, MADE = Corpus("source", Path("a"), "full"), Corpus("fast store", Path("b"), "full")


def test_every_corpus_has_its_limit_and_the_baseline_comes_first() -> None:
    labels = [contender.label for contender in line_up(SOURCE, [MADE], ["fast", "exact"])]
    assert labels == [
        "released, source", "decode, source", "exact, source", "fast, source",
        "decode, fast store", "exact, fast store", "fast, fast store",
    ]  # fmt: skip


@dataclass(frozen=True)
class Told(Contender):
    """A contender whose turns are known."""

    turns: tuple[tuple[int, float], ...] = ()

    def measure(self, asked: argparse.Namespace) -> Measured:
        batches, cpu = self.turns[TURN[self.label]]
        TURN[self.label] += 1
        return Measured(batches / 10.0, cpu / batches)


TURN: dict[str, int] = {}


def test_ratios_are_medians_of_the_ratios_within_a_turn() -> None:
    contenders = [
        Told("released", SOURCE, turns=((10, 20.0), (5, 20.0), (10, 20.0))),
        Told("decode", SOURCE, turns=((50, 20.0), (25, 20.0), (40, 20.0))),
        Told("exact", SOURCE, turns=((40, 20.0), (20, 20.0), (30, 20.0))),
    ]
    TURN.update({contender.label: 0 for contender in contenders})
    baseline, _, exact = throughput.compare(
        contenders, argparse.Namespace(workers=2, batch_size=12, seconds=10.0, warmup_batches=0, turns=3)
    )
    assert baseline["ratio_to_baseline"] == 1.0
    assert (exact["ratio_to_baseline"], exact["batches_per_second"]) == (4.0, 3.0)
    assert (exact["ratio_to_baseline_lowest"], exact["ratio_to_baseline_highest"]) == (3.0, 4.0)
    assert exact["ratio_to_decode_limit"] == pytest.approx(0.8)
    assert exact["cpu_ratio_to_baseline"] == pytest.approx(4.0)
    said = throughput.missed([baseline, exact])
    assert said == ["exact, source: ratio_to_decode_limit 0.8; the bar is at least 0.9"]


@pytest.mark.parametrize(
    ("label", "ratio", "cpu_ratio", "said"),
    [
        ("exact, dense-tmpfs", 24.0, 26.0, "ratio_to_baseline 24; the bar is at least 25"),  # that of its codec
        ("exact, dense-12", 20.0, 19.0, "cpu_ratio_to_baseline 19; the bar is at least 20"),  # many keyframes
    ],
)
def test_a_form_of_clips_has_a_bar_of_its_own(label: str, ratio: float, cpu_ratio: float, said: str) -> None:
    record = {"label": label, "ratio_to_baseline": ratio, "cpu_ratio_to_baseline": cpu_ratio}
    assert throughput.missed([record | {"ratio_to_decode_limit": 0.7}]) == [f"{label}: {said}"]
