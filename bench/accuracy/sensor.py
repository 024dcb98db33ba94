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
which no simulator earns; "still_hz", events a second of a pixel around which frames do not change, and the sensor's.
"ceiling" is the correlation of the frames' own change. Rows of "all" are over all steps in the light that the
recordings state. Their ranks are by correlation and by |log ratio|. An interval (90 %) is that of blocks of the sensor
and steps, drawn again with replacement.

Each row is printed to stderr, and ``--json`` is written, as soon as it is known, so a run that ends early leaves the
rows before.

Bars, in the light that the recordings state: over all steps of at least two recordings, ``davis346-measured`` is ahead
of ``paper`` in correlation and in |log ratio|, and its correlation is within .03 of its own without noise; its rate
where frames are still is within a factor of 3 of the sensor's, over the recordings whose still pixels follow no lamp,
which frames do not show. No recording that is judged here chose its numbers.
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
    is_unchanged,
    of_recipe,
    part_of,
    tallied,
    within,
)
from v2v_protocol.command import Parser
from v2v_protocol.errors import UsageError
from v2v_protocol.write_aside import write_json
from v2v_recordings.items import ConvertOptions, Light
from v2v_tools.fit.increments import BRIGHTEST_GREY, events_of_steps
from v2v_tools.fit.interval import DRAWS as RESAMPLED
from v2v_tools.fit.interval import LEVEL, SIDE, Doubles
from v2v_tools.fit.recording import Recorded, read_recording

BEATEN, NEW = ("paper",), "davis346-measured"
RECIPES = (*BEATEN, "noise-free", "clean", "davis346-running", NEW)
MOST_LOST, MOST_TIMES = 0.03, 3.0
"""Bars: correlation that noise may cost, and factor between the rates of still pixels."""
LAMPS_HZ, LEAST_STRENGTH = (100.0, 120.0), 0.8
THRESHOLDS = np.array([0.1, 0.18, 0.3, 0.5, 0.85])
NEAR_WHITE_PX, DARK = 17, 0.03
CHOOSES = np.arange(SIDE**2) % SIDE % 2 == 0
"""Blocks of the sensor on which thresholds are chosen: its even stripes. The odd ones are reported."""


RANKED_BY = {"correlation": -1, "log_ratio": 1}
"""What ranks simulators, and the sign that makes the best the smallest."""


def _columns(texts: tuple[str, ...], numbers: tuple[str, ...]) -> tuple[Column, ...]:
    forms = dict.fromkeys(texts, "{}") | dict.fromkeys(numbers, "{:.2f}")
    return tuple((key, key.replace("_", " "), form, 1) for key, form in forms.items())


_COLUMNS = _columns(
    ("recording", "light", "simulator", "at"),
    ("threshold", "correlation", "ceiling", "log_ratio", "ratio", "intervals", "missed", "invented", "mirrored",
     "still_hz", "sensor_still_hz"),
)  # fmt: skip
_RANKED = _columns(
    ("simulator", "at", "correlation", "correlation_rank", "log_ratio", "log_ratio_rank"),
    ("ratio", "intervals", "missed", "invented"),
)


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


def lamp_strength(given: Recorded) -> float:
    """Return how much brighter events of still pixels follow a lamp, 0 .. 1: the vector strength at its frequency."""
    step, owner, is_brighter = events_of_steps(given)
    t = within(given).t_us[is_unchanged(given)[step, owner] & is_brighter]
    turns = np.exp(2e-6j * np.pi * np.outer(LAMPS_HZ, t))
    return float(np.abs(turns.mean(axis=1)).max()) if len(t) else 0.0


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
        strength = lamp_strength(given)
        lines.append(f"  where frames are still, its events follow a lamp of 100 or 120 Hz by {strength:.2f} of 1")
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
                        is_stated, row = given.light == light, found.record()
                        progress(f"  {at}: correlation {row['correlation']:.2f}, {row['ratio']:.2f} times the events")
                        records.append({
                            "recording": path.stem, "light": light.name, "stated": is_stated, "simulator": name,
                            "at": at, "steps": found.steps, "threshold": threshold or None, "ceiling": ceiling,
                            "lamp": strength, **row,
                        })  # fmt: skip
                        if is_stated:
                            parts.setdefault((name, at), []).append(found)
                        if asked.json is not None:
                            write_json(asked.json, records)
                except (Exception, SystemExit) as error:  # a peer's; the others go on
                    if name not in asked_peers(asked):
                        raise
                    failed[name] = f"peer {name} failed: {type(error).__name__}: {error}"
                    progress(failed[name])
    whole = list(over_all({key: found for key, found in parts.items() if key[0] not in failed}))
    if len(names) < 2:
        lines.append(f"The bar needs at least 2 recordings and was not judged: {', '.join(names) or 'none'} was read")
    shown: list[Record] = [
        {**row, **{key: f"{row[key]:.2f} ({row[f'{key}_low']:.2f}-{row[f'{key}_high']:.2f})" for key in RANKED_BY}}
        for row in whole
    ]
    return Report(
        [*records, *whole], [(records, _COLUMNS), (shown, _RANKED)],
        [*lines, "The light of a recording cannot be told from these figures: it has to be known."],
        [*failed.values(), *(missed([*records, *whole]) if len(names) > 1 else [])],
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
        found = dict(sorted(found.items(), key=lambda item: -item[1].value[FIGURES.index("correlation")]))
        ranks = dict[str, list[str]]()
        for key, sign in RANKED_BY.items():
            place = FIGURES.index(key)
            values = np.array([[each.value[place], *each.drawn[:, place]] for each in found.values()])
            order = 1 + np.argsort(np.argsort(sign * values, axis=0, kind="stable"), axis=0)
            ends = np.quantile(order[:, 1:], [(1 - LEVEL) / 2, (1 + LEVEL) / 2], axis=1, method="nearest").T
            ranks[key] = [
                f"{own[0]} ({low}-{high})" if low < high else f"{own[0]}"
                for own, (low, high) in zip(order, ends, strict=True)
            ]
        for number, (name, each) in enumerate(found.items()):
            yield {
                "recording": "all", "light": "stated", "stated": True, "simulator": name, "at": at,
                "steps": each.steps, **each.record(), **{f"{key}_rank": ranks[key][number] for key in ranks},
            }  # fmt: skip


def missed(records: list[Record]) -> list[str]:
    """Return the bars that the new preset misses, from the rows of recordings and those over all of them."""
    own = {(row["recording"], row["simulator"]): row for row in records if row["at"] == "own" and row["stated"]}
    if not own:  # no recording states a light that was asked for
        return []
    mine, quiet = (own["all", name] for name in (NEW, f"{NEW}, quiet"))
    found = [
        f"{key.replace('_', ' ')}: {NEW} {mine[key]:.3f}, {name} {own['all', name][key]:.3f}"
        for name in BEATEN for key, sign in RANKED_BY.items()
        if sign * mine[key] >= sign * own["all", name][key]
    ]  # fmt: skip
    if (lost := quiet["correlation"] - mine["correlation"]) > MOST_LOST:
        found.append(f"noise costs {lost:.3f} of the correlation; the bar is at {MOST_LOST:g}")
    lit = [row for (_, name), row in own.items() if name == NEW and row.get("lamp", 1.0) < LEAST_STRENGTH]
    made, seen = (sum(row["steps"] * row[key] for row in lit) for key in ("still_hz", "sensor_still_hz"))
    if max(made, seen) > MOST_TIMES * min(made, seen):
        found.append(f"where frames are still, {NEW} fires {made / max(seen, 1e-9):.2f} times the sensor's events")
    return found
