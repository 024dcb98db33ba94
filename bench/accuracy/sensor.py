"""Compare simulators with event cameras, on the frames that the cameras recorded beside their events.

    python -m bench sensor RECORDINGS --json sensor.json
    python -m bench sensor RECORDINGS --recipe my_camera.yaml --peer v2e=FOLDER --peer openeb=FOLDER --peer eventcv=

All simulators get the same pixels, frames and times, once for each light (``--light``). Times of frames are corrected
where the recording tells their offset. Pixels at or near white are left out: frames do not show what a lamp does.
"equations" are those of the paper, event by event in float64. A peer is the folder of its source, which is imported;
"eventcv=" is the installed package.

A row has the means over draws and over the steps between frames: correlation of signed events a pixel, and of each
polarity; |log ratio| of the number of events, whose mean sign is the ratio; distance of the distributions of intervals
between events (half the sum of the differences); share of the sensor's active pixels that are missed, and of the
simulator's that are invented; "mirrored", the correlation with the sensor's events mirrored, which no simulator earns.
"ceiling" is the correlation of the frames' own change. "at" is the threshold: the camera's own, the one of five with
the best correlation, and the one that gives the sensor's number of events.

Bar: at its own thresholds and in the light that the recordings state, ``davis346-running`` is ahead of ``paper``,
``sensor`` and ``davis346`` in correlation and in |log ratio|, over all steps.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from bench.frame import Column, Record, Report, add_whole, progress
from tests.oracles.simulators import (
    PEERS,
    ROWS,
    Simulator,
    compared,
    correlation,
    counts_of,
    equations,
    frame_offset,
    of_recipe,
    part_of,
    within,
)
from v2v_protocol.command import Parser
from v2v_protocol.errors import UsageError
from v2v_recordings.items import ConvertOptions, Light
from v2v_tools.fit.increments import BRIGHTEST_GREY
from v2v_tools.fit.interval import Doubles
from v2v_tools.fit.recording import Recorded, read_recording

RECIPES, NEW = ("paper", "sensor", "davis346"), "davis346-running"
THRESHOLDS = np.array([0.1, 0.18, 0.3, 0.5, 0.85])
NEAR_WHITE_PX, DARK = 17, 0.03
_COLUMNS: tuple[Column, ...] = tuple(
    (key, key.replace("_", " "), "{}" if number < 5 else "{:.2f}", 1)
    for number, key in enumerate((
        "recording", "light", "simulator", "at", "steps", "threshold", "correlation", "ceiling", "brighter", "darker",
        "log_ratio", "ratio", "intervals", "missed", "invented", "mirrored",
    ))
)  # fmt: skip


def seen(path: Path) -> tuple[Recorded, str]:
    """Read a recording; return its events between frames, of the pixels that tell, and what it cannot tell."""
    given = read_recording(path, ConvertOptions())
    if len(given.frames) < 2:
        raise UsageError(f"{path}: fewer than 2 frames during its events: give a recording with frames")
    lit = np.zeros((given.height_px, given.width_px), np.uint8)
    lit.flat[given.pixels] = given.frames.max(axis=0) > BRIGHTEST_GREY
    usable = cv2.dilate(lit, np.ones((NEAR_WHITE_PX, NEAR_WHITE_PX), np.uint8)).flat[given.pixels] == 0
    usable[np.flatnonzero(usable)[usable.sum() // ROWS * ROWS :]] = False
    offset = frame_offset(dataclasses.replace(given, light=given.light or Light.parse("linear")))
    moved = 0 if math.isnan(offset.value) else round(1e6 * offset.value)
    text = (
        f"{path.name}: {len(given.frames) - 1} steps, {usable.sum()} pixels, {(~usable).sum()} left out near white; "
        + (f"frames taken {moved / 1000:.1f} ms later" if moved else f"offset of the frames not told: {offset.note}")
        + f"; light: {given.light.name if given.light else 'not stated'}"
    )
    return within(dataclasses.replace(part_of(given, usable), frame_us=given.frame_us + moved)), text


def judged(given: Recorded, true: Doubles, simulator: Simulator, draws: int) -> Iterator[dict[str, Any]]:
    """Yield the rows of a simulator: at its own threshold, the best of five, the sensor's number of events."""

    def means(threshold: float, count: int) -> dict[str, float]:
        rows = [compared(given, true, simulator(given, threshold, seed)) for seed in range(count)]
        mean = {key: float(np.mean([row[key] for row in rows])) for key in rows[0]}
        return mean | {"threshold": threshold, "ratio": math.exp(mean["ratio"])}

    yield {"at": "own", **means(0.0, draws), "threshold": None}
    rows = [means(threshold, max(1, draws // 5)) for threshold in THRESHOLDS]
    yield {"at": "best", **max(rows, key=lambda row: row["correlation"])}
    numbers = np.maximum.accumulate([row["events"] for row in rows[::-1]])
    level = np.exp(np.interp(np.log(true.sum() + 0.5), np.log(numbers), np.log(THRESHOLDS[::-1])))
    yield {"at": "number", **means(float(level), max(1, draws // 5))}


def add_flags(parser: Parser) -> None:
    """Add the bench's flags."""
    parser.add_argument("recordings", type=Path, metavar="DIR", help="folder of recordings with frames, or one of them")
    parser.add_argument("--recipe", action="append", default=[], metavar="NAME", help="also judge this recipe or file")
    parser.add_argument(
        "--peer",
        action="append",
        default=[],
        metavar="NAME=DIR",
        help=f"also judge {', '.join(PEERS)}; DIR: its source",
    )
    parser.add_argument("--light", action="append", default=[], metavar="CURVE", help="default: linear and 2.2")
    add_whole(parser, "--draws", 20, "cameras drawn at their own thresholds; a fifth of them at others")


def measure(asked: argparse.Namespace) -> Report:
    """Judge all simulators on all recordings."""
    simulators = {name: of_recipe(name) for name in (*RECIPES, NEW, *asked.recipe)} | {"equations": equations}
    for entry in asked.peer:
        name, _, folder = entry.partition("=")
        if name not in PEERS:
            raise UsageError(f"--peer {entry}: give one of {', '.join(PEERS)} as NAME=DIR")
        sys.path[:0] = [folder] if folder else []
        simulators[name] = PEERS[name]
    records, lines = list[Record](), list[str]()
    for path in sorted(asked.recordings.iterdir()) if asked.recordings.is_dir() else [asked.recordings]:
        try:
            given, text = seen(path)
        except UsageError as error:
            lines.append(f"left out: {error}")
            continue
        lines.append(text)
        for light in map(Light.parse, asked.light or ("linear", "2.2")):
            lit = dataclasses.replace(given, light=light)
            true, level = counts_of(lit), np.log(DARK + light.of(lit.frames))
            ceiling = float(np.mean(list(map(correlation, np.diff(level, axis=0), true[1] - true[0]))))
            lines.append(f"  {light.name}: the frames' own change correlates by {ceiling:.2f} with the events")
            for name, simulator in simulators.items():
                progress(f"{path.name}, {light.name}, {name}")
                records += [
                    {"recording": path.stem, "light": light.name, "stated": given.light == light, "simulator": name,
                     "steps": true.shape[1], "ceiling": ceiling, **row}
                    for row in judged(lit, true, simulator, asked.draws)
                ]  # fmt: skip
    return Report(
        records, [(records, _COLUMNS)],
        [*lines, "The light of a recording cannot be told from these figures: it has to be known."],
        missed(records),
    )  # fmt: skip


def missed(records: list[Record]) -> list[str]:
    """Return the bars that the new preset misses, over all steps in the stated light."""
    own = [record for record in records if record["at"] == "own" and record["stated"]]

    def mean(name: str, key: str) -> float:
        mine = [record for record in own if record["simulator"] == name]
        return float(np.average([each[key] for each in mine], weights=[each["steps"] for each in mine]))

    return [
        f"{key.replace('_', ' ')}: {NEW} {mean(NEW, key):.3f}, {name} {mean(name, key):.3f}"
        for name in RECIPES if own for key, sign in (("correlation", 1), ("log_ratio", -1))
        if sign * mean(NEW, key) <= sign * mean(name, key)
    ]  # fmt: skip
