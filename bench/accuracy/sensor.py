"""Compare simulators with event cameras, on the frames that the cameras recorded beside their events.

    python -m bench sensor RECORDINGS --json sensor.json
    python -m bench sensor RECORDINGS --recipe my_camera.yaml --peer v2e=FOLDER --peer openeb=FOLDER --peer eventcv=

All simulators get the same pixels, frames and times, once for each light (``--light``). Times of frames are corrected
where the recording tells their offset. Pixels at or near white are left out: frames do not show what a lamp does.
"equations" and "esim" are those of the paper and of ESIM, event by event in float64. A peer is the folder of its
source, which is imported; "eventcv=" is the installed package. "v2e-noisy" is v2e with its noisy parameters, "v2v" the
code that the paper's authors released. ``NAME, quiet`` is a recipe without its noise.

"at" is the threshold: the camera's own, the one of five with the best correlation, and the one that gives the sensor's
number of events. What is chosen is chosen on the even of eight stripes of the sensor (:data:`CHOOSES`); all figures are
those of the odd ones. A row has the means over draws and over the steps between frames: correlation of signed events a
pixel, and of each polarity; |log ratio| of the number of events, whose mean sign is the ratio; distance of the
distributions of intervals between events (half the sum of the differences); share of the sensor's active pixels that
are missed, and of the simulator's that are invented; "mirrored", the correlation with the sensor's events mirrored,
which no simulator earns. "ceiling" is the correlation of the frames' own change. Rows of "all" are over all steps in
the light that the recordings state. Their ranks are by correlation and by |log ratio|. An interval (90 %) is that of
blocks of the sensor and steps, drawn again with replacement.

``--json`` is written after each row, so a run that ends early leaves the rows before.

Bar: at its own thresholds and in the light that the recordings state, ``davis346-running`` is ahead of ``paper``,
``sensor`` and ``davis346`` in correlation and in |log ratio|, over all steps of at least two recordings.
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
import numpy.typing as npt

from bench.frame import Column, Record, Report, add_whole, progress
from tests.oracles.simulators import (
    FIGURES,
    PEERS,
    RECORDED,
    ROWS,
    SIMULATED,
    Simulator,
    correlation,
    counts_of,
    equations,
    esim,
    figures,
    frame_offset,
    of_recipe,
    part_of,
    tallied,
    within,
)
from v2v_protocol.command import Parser
from v2v_protocol.errors import UsageError
from v2v_protocol.write_aside import write_json
from v2v_recordings.items import ConvertOptions, Light
from v2v_tools.fit.increments import BRIGHTEST_GREY
from v2v_tools.fit.interval import DRAWS as RESAMPLED
from v2v_tools.fit.interval import LEVEL, SIDE, Doubles
from v2v_tools.fit.recording import Recorded, read_recording

BEATEN, NEW = ("paper", "sensor", "davis346"), "davis346-running"
RECIPES = (*BEATEN, "noise-free", "clean", NEW)
THRESHOLDS = np.array([0.1, 0.18, 0.3, 0.5, 0.85])
NEAR_WHITE_PX, DARK = 17, 0.03
CHOOSES = np.arange(SIDE**2) % SIDE % 2 == 0
"""Blocks of the sensor on which thresholds are chosen: its even stripes. The odd ones are reported."""


def _columns(*keys: str) -> tuple[Column, ...]:
    """Return columns: numbers with two decimals, but for those that count and that are texts."""
    whole = ("recording", "light", "simulator", "at", "steps", "correlation_rank", "log_ratio_rank")
    return tuple((key, key.replace("_", " "), "{}" if key in whole else "{:.2f}", 1) for key in keys)


_COLUMNS = _columns(
    "recording", "light", "simulator", "at", "steps", "threshold", "correlation", "ceiling", "brighter", "darker",
    "log_ratio", "ratio", "intervals", "missed", "invented", "mirrored",
)  # fmt: skip
_RANKED = _columns(
    "simulator", "at", "steps", "correlation", "correlation_low", "correlation_high", "correlation_rank", "log_ratio",
    "log_ratio_low", "log_ratio_high", "log_ratio_rank", "ratio", "intervals", "missed", "invented",
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


@dataclasses.dataclass(frozen=True, eq=False)
class Judged:
    """Figures over some steps, in the order of FIGURES.

    Attributes:
        value: [FIGURES] means over the steps.
        drawn: [RESAMPLED, FIGURES] the same of blocks and steps drawn again.
        steps: number of steps.
    """

    value: Doubles
    drawn: Doubles
    steps: int

    def record(self) -> dict[str, float]:
        """Return the figures and their intervals, by name; ``ratio`` is that of the numbers of events."""
        ends = np.quantile(self.drawn, [(1 - LEVEL) / 2, (1 + LEVEL) / 2], axis=0)
        made = {
            f"{name}{end}": float(column[place])
            for end, column in (("", self.value), ("_low", ends[0]), ("_high", ends[1]))
            for place, name in enumerate(FIGURES)
        }
        return made | {name: math.exp(made[name]) for name in ("ratio", "ratio_low", "ratio_high")}


def of_pieces(sums: Doubles) -> Judged:
    """Return the figures of [draws, blocks, steps, SUMS] of ``tallied``: means over the draws and over the steps."""
    _, blocks, steps, _ = sums.shape

    def of_steps(weights: npt.NDArray[Any]) -> Doubles:
        return np.asarray(figures(np.einsum("b,dbsk->dsk", weights, sums)).mean(axis=0))

    rng = np.random.default_rng(0)  # the same pieces for every simulator
    drawn = [
        rng.multinomial(steps, np.full(steps, 1 / steps))
        @ of_steps(rng.multinomial(blocks, np.full(blocks, 1 / blocks)))
        for _ in range(RESAMPLED)
    ]
    return Judged(of_steps(np.ones(blocks)).mean(axis=0), np.stack(drawn) / steps, steps)


def pooled(parts: list[Judged]) -> Judged:
    """Return the figures over all steps of several recordings."""
    steps = sum(part.steps for part in parts)
    value, drawn = (sum(part.steps * getattr(part, name) for part in parts) / steps for name in ("value", "drawn"))
    return Judged(value, drawn, steps)


def judged(given: Recorded, true: Doubles, simulator: Simulator, draws: int) -> Iterator[tuple[str, float, Judged]]:
    """Yield threshold's kind, threshold (0: the own) and figures: own, the best of five, the sensor's number of events.

    The last two thresholds are chosen on one half of the sensor. The figures are those of the other.
    """

    def sums_at(threshold: float, count: int) -> Doubles:
        return np.stack([tallied(given, true, simulator(given, threshold, seed)) for seed in range(count)])

    yield "own", 0.0, of_pieces(sums_at(0.0, draws)[:, ~CHOOSES])
    few = max(1, draws // 5)
    each = [sums_at(threshold, few) for threshold in THRESHOLDS]
    mine = [figures(sums[:, CHOOSES].sum(axis=1)).mean(axis=(0, 1)) for sums in each]
    best = int(np.argmax([found[0] for found in mine]))
    yield "best", float(THRESHOLDS[best]), of_pieces(each[best][:, ~CHOOSES])
    made, wanted = (
        [math.log(sums[:, CHOOSES][..., which].sum() + 0.5) for sums in each[::-1]] for which in (SIMULATED, RECORDED)
    )
    level = float(np.exp(np.interp(wanted[0], np.maximum.accumulate(made), np.log(THRESHOLDS[::-1]))))
    yield "number", level, of_pieces(sums_at(level, few)[:, ~CHOOSES])


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
    simulators, records, lines, failed = _simulators(asked), list[Record](), list[str](), dict[str, str]()
    parts: dict[tuple[str, str], list[Judged]] = {}
    names = []
    for path in sorted(asked.recordings.iterdir()) if asked.recordings.is_dir() else [asked.recordings]:
        try:
            given, text = seen(path)
        except UsageError as error:
            lines.append(f"left out: {error}")
            continue
        lines.append(text)
        names.append(path.stem)
        for light in map(Light.parse, asked.light or ("linear", "2.2")):
            lit = dataclasses.replace(given, light=light)
            true, level = counts_of(lit), np.log(DARK + light.of(lit.frames))
            reported = ~CHOOSES[lit.blocks()]
            ceiling = float(np.mean(list(map(
                correlation, np.diff(level, axis=0)[:, reported], (true[1] - true[0])[:, reported]
            ))))  # fmt: skip
            lines.append(f"  {light.name}: the frames' own change correlates by {ceiling:.2f} with the events")
            for number, (name, simulator) in enumerate(simulators.items(), 1):
                progress(f"{path.name}, light {light.name}: {name}, {number} of {len(simulators)}")
                try:
                    for at, threshold, found in judged(lit, true, simulator, asked.draws):
                        is_stated = given.light == light
                        records.append({
                            "recording": path.stem, "light": light.name, "stated": is_stated, "simulator": name,
                            "at": at, "steps": found.steps, "threshold": threshold or None, "ceiling": ceiling,
                            **found.record(),
                        })  # fmt: skip
                        if is_stated:
                            parts.setdefault((name, at), []).append(found)
                        if asked.json is not None:
                            write_json(asked.json, records)
                except Exception as error:  # a peer's; the others go on
                    if name not in asked_peers(asked):
                        raise
                    failed[name] = f"peer {name} failed: {type(error).__name__}: {error}"
                    progress(failed[name])
    whole = list(over_all({key: found for key, found in parts.items() if key[0] not in failed}))
    if len(names) < 2:
        lines.append(f"The bar needs at least 2 recordings and was not judged: {', '.join(names) or 'none'} was read")
    return Report(
        [*records, *whole], [(records, _COLUMNS), (whole, _RANKED)],
        [*lines, "The light of a recording cannot be told from these figures: it has to be known."],
        [*failed.values(), *(missed(whole) if len(names) > 1 else [])],
    )  # fmt: skip


def asked_peers(asked: argparse.Namespace) -> dict[str, str]:
    """Return the folders of the peers that the command line names.

    Raises:
        UsageError: an unknown peer.
    """
    found = {}
    for entry in asked.peer:
        name, _, folder = entry.partition("=")
        if name not in PEERS:
            raise UsageError(f"--peer {entry}: give one of {', '.join(PEERS)} as NAME=DIR")
        found[name] = folder
    return found


def _simulators(asked: argparse.Namespace) -> dict[str, Simulator]:
    """Return the simulators by name; make the peers' sources importable."""
    recipes = dict.fromkeys((*RECIPES, *asked.recipe))
    quiet = {f"{name}, quiet": of_recipe(name, noisy=False) for name in dict.fromkeys((NEW, *asked.recipe))}
    found = {name: of_recipe(name) for name in recipes} | quiet | {"equations": equations, "esim": esim}
    for name, folder in asked_peers(asked).items():
        sys.path[:0] = [folder] if folder else []
        found[name] = PEERS[name]
    return found


def over_all(parts: dict[tuple[str, str], list[Judged]]) -> Iterator[Record]:
    """Yield a row of each simulator and kind of threshold over all recordings, with its ranks and their intervals."""
    for at in dict.fromkeys(kind for _, kind in parts):
        found = {name: pooled(each) for (name, kind), each in parts.items() if kind == at}
        ranks = dict[str, list[str]]()
        for key, sign in (("correlation", -1), ("log_ratio", 1)):
            place = FIGURES.index(key)
            values = np.array([[each.value[place], *each.drawn[:, place]] for each in found.values()])
            order = 1 + np.argsort(np.argsort(sign * values, axis=0, kind="stable"), axis=0)
            ends = np.quantile(order[:, 1:], [(1 - LEVEL) / 2, (1 + LEVEL) / 2], axis=1, method="nearest").T
            ranks[key] = [f"{own[0]} ({low}-{high})" for own, (low, high) in zip(order, ends, strict=True)]
        for number, (name, each) in enumerate(found.items()):
            yield {
                "recording": "all", "light": "stated", "stated": True, "simulator": name, "at": at,
                "steps": each.steps, **each.record(), **{f"{key}_rank": ranks[key][number] for key in ranks},
            }  # fmt: skip


def missed(whole: list[Record]) -> list[str]:
    """Return the bars that the new preset misses, from the rows over all recordings."""
    own = {record["simulator"]: record for record in whole if record["at"] == "own"}
    return [
        f"{key.replace('_', ' ')}: {NEW} {own[NEW][key]:.3f}, {name} {own[name][key]:.3f}"
        for name in BEATEN if own for key, sign in (("correlation", 1), ("log_ratio", -1))
        if sign * own[NEW][key] <= sign * own[name][key]
    ]  # fmt: skip
