"""Error of the events of photographs that move, beside the exact crossings of their light.

    python -m bench worlds --json worlds.json

A scene is some photographs that pass at 0.1 to 8 px a frame of 60 Hz, each in directions of its own. Its light is
computed apart, in float64, at 24 moments of a pixel or more (``tests/oracles/worlds.py``). Events of both start with
equal residuals. "signed" is the error of the signed bins of frame steps, "count" that of the number of events, as
shares of the truth; ``choosing`` uses other scenes, on which the share of
``worlds-fine`` was chosen; ``--share`` and ``--bits`` try other values than its own.

Bars of ``worlds-fine``, signed / count: photographs and thin lines 3 % / 3 %, low contrast 6 %, waves 1.5 %.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from bench.frame import Column, Report, beyond, progress
from tests.oracles.known_motion import photograph
from tests.oracles.rendered import Counts, errors
from tests.oracles.worlds import event_counts, waves
from v2v_protocol.command import Parser
from v2v_protocol.recipe import preset
from v2v_protocol.spec import StreamSpec

Grey = npt.NDArray[np.unsignedinteger[Any]]
SPEEDS_PX, THRESHOLDS, DIRECTIONS = (0.1, 0.5, 2.0, 8.0), (0.1, 0.3), 3
SIDE_PX, STEPS, MOMENTS_PER_PX = 40, 6, 24
LEAST_EVENTS = 200
"""With fewer true events, an error in percent says nothing."""
BARS = {
    "photographs": {"signed": 0.03, "count": 0.03}, "thin lines": {"signed": 0.03, "count": 0.03},
    "low contrast": {"signed": 0.06}, "waves": {"signed": 0.015},
}  # fmt: skip


def lines(seed: int, size: int = 240) -> Grey:
    """Return a photograph of lines 2 px wide, bright and dark, before a shaded ground."""
    random, (y, x) = np.random.default_rng(seed), np.mgrid[:size, :size] - size / 2
    light = 0.5 + 0.15 * np.tanh(2 * y / size)
    for number in range(24):
        angle, place = random.uniform(0, np.pi), random.uniform(-size / 2, size / 2)
        distance = y * np.cos(angle) + x * np.sin(angle) - place
        light += (-0.4 if number % 2 else 0.3) * np.exp(-0.5 * (distance / 0.8) ** 2)
    levels: Grey = np.rint(np.clip(light, 0.0, 1.0) * 65535).astype(np.uint16)
    return levels


def pale(name: str) -> Grey:
    """Return a photograph with a twelfth of its contrast."""
    levels: Grey = np.rint((128 + (photograph(name) - 128.0) / 12) * 257).astype(np.uint16)
    return levels


def scenes(choosing: bool) -> dict[str, Callable[[], list[Grey]]]:
    """Return the photographs of each scene; those that a share is chosen on are none of those that are reported."""
    names: tuple[str, ...] = ("coins", "gravel")
    seeds, periods = (5, 6), (12.0, 20.0)
    if not choosing:
        names, seeds, periods = ("coffee", "astronaut", "camera"), (1, 2), (8.0, 32.0)
    return {
        "photographs": lambda: [photograph(name) for name in names],
        "thin lines": lambda: [lines(seed) for seed in seeds],
        "low contrast": lambda: [pale(name) for name in names],
        "waves": lambda: [waves((40.0, 250.0), period) for period in periods],
    }


def compared(photographs: list[Grey], spec: StreamSpec, px: float, threshold: float) -> dict[str, float]:
    """Return the errors over some photographs and directions."""
    moments = max(64, round(MOMENTS_PER_PX * px))
    found = [
        event_counts(grey, spec, px, threshold, index, SIDE_PX, STEPS, moments)
        for grey in photographs
        for index in range(DIRECTIONS)
    ]
    made, true = (Counts(*(np.concatenate(parts, axis=1) for parts in zip(*each, strict=True)))
                  for each in zip(*found, strict=True))  # fmt: skip
    wrong = errors(made, true)
    return {"events": float(sum(each.sum() for each in true)), "signed": wrong.signed, "count": wrong.count}


def measured(specs: dict[str, StreamSpec], choosing: bool) -> Iterator[dict[str, Any]]:
    """Yield one record for each scene, speed and threshold."""
    for name, photographs in scenes(choosing).items():
        for px in SPEEDS_PX:
            progress(f"{name}, {px:g} px a frame")
            for threshold in THRESHOLDS:
                record: dict[str, Any] = {"scene": name, "px_per_frame": px, "threshold": threshold}
                for way, spec in specs.items():
                    found = compared(photographs(), spec, px, threshold)
                    record |= {"events": found["events"]}
                    record |= {f"{key}_{way}": found[key] for key in ("signed", "count")}
                yield record


def missed(records: list[dict[str, Any]]) -> list[str]:
    """Return the bars that ``worlds-fine`` misses."""
    texts: list[str] = []
    for record in records:
        if record["events"] >= LEAST_EVENTS:
            found = {key: abs(record[f"{key}_fine"]) for key in BARS[record["scene"]]}
            at = f"{record['scene']} at {record['px_per_frame']:g} px, threshold {record['threshold']}"
            texts += beyond(at, found, most=BARS[record["scene"]])
    return texts


def add_flags(parser: Parser) -> None:
    """Add the bench's flags."""
    fine = preset("worlds-fine")
    parser.add_argument("--choosing", action="store_true", help="the scenes that the share was chosen on")
    parser.add_argument("--share", type=float, default=fine.world_change_share, metavar="N", help="world_change_share")
    parser.add_argument("--bits", type=int, default=fine.world_bits, metavar="N", help="world_bits")


def measure(asked: argparse.Namespace) -> Report:
    """Run the bench."""
    fine = preset("worlds-fine").replace(world_change_share=asked.share, world_bits=asked.bits)
    plain = StreamSpec(preset("worlds"))
    specs = {"plain": plain, "substep": dataclasses.replace(plain, substep_px=1.0), "fine": StreamSpec(fine)}
    records = list(measured(specs, asked.choosing))
    columns: list[Column] = [("scene", "scene", "{}", 1), ("px_per_frame", "px a frame", "{:g}", 1)]
    columns += [("threshold", "threshold", "{:g}", 1), ("events", "events", "{:.0f}", 1)]
    for way, title in (("plain", "worlds"), ("substep", "substep_px 1"), ("fine", "worlds-fine")):
        columns += [(f"signed_{way}", f"{title}: signed", "{:.1%}", 1), (f"count_{way}", "count", "{:+.1%}", 1)]
    return Report(records, [(records, columns)], missed=missed(records))
