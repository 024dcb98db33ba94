"""Fit cameras with known parameters, and count what is told and what holds the truth.

Cameras of a fixed list record photographs that move, rendered scenes and clips, event by event, with frames at about 30
a second (``tests/oracles/cameras.py``): two seconds that move, one or two that stand still. In one of two cameras the
noise ignores the refractory period. Each recording is fitted. "told" counts the cameras whose recording can tell a
parameter, "held" those of them whose 90 % interval holds the truth; "width" is the median half width of the intervals,
as a share. With ``--tuning``, the cameras and scenes are those on which the fit was tuned.

Bars, for each parameter: 85 % of the intervals told hold the truth; at most a third of the cameras cannot be told.

With ``--alternating``, the noise is one before the comparator, whose events alternate. No parameter explains it: the
second bar does not hold, and one more does: neither shot noise nor leak is told.

With ``--outside``, cameras with the noise models of v2e and IEBCS (``tests/oracles/other_cameras.py``) record instead.
Each is fitted on one half of the sensor; on the other half, the fitted camera and eight draws of every preset (median)
simulate the frames. Shown are their distances from the recording: logarithms of the ratios of rates, and of brighter to
darker events; the statistics of ``v2v_tools/fit/statistics.py`` for pixels and intervals. Bar: none is nearer than the
fitted camera.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from bench.frame import Column, Report, add_whole, beyond, progress
from tests.oracles.cameras import (
    ALTERNATING,
    HEIGHT_PX,
    REPORT,
    TUNING,
    WIDTH_PX,
    Case,
    record,
    rendered_film,
)
from tests.oracles.other_cameras import OTHERS, record_other
from tests.oracles.simulators import drawn, part_of
from v2v_protocol.command import Parser
from v2v_protocol.recipe import PRESETS
from v2v_recordings.items import Light
from v2v_tools.fit.fit import fit
from v2v_tools.fit.interval import Doubles
from v2v_tools.fit.recording import Recorded, recorded
from v2v_tools.fit.statistics import panels_of, simulate_recording

LEAST_HELD, LEAST_TOLD = 0.85, 2 / 3
DRAWS = 8
HALVES = slice(0, 8), slice(8, 16)
"""Columns of darker and of brighter events."""
_OUTSIDE = ("camera", "coffee", "coins", "parallax")
_COLUMNS: tuple[Column, ...] = (
    ("parameter", "parameter", "{}", 1),
    ("cameras", "cameras", "{}", 1),
    ("told", "told", "{}", 1),
    ("held", "held", "{}", 1),
    ("width", "width", "{:.0%}", 1),
    ("error", "median error", "{:.1%}", 1),
)


def add_flags(parser: Parser) -> None:
    """Declare the flags."""
    add_whole(parser, "--cameras", max(len(REPORT), len(TUNING)), "number of cameras")
    clips = Path(".demo/videos")
    parser.add_argument(
        "--clips", type=Path, default=clips, metavar="DIR", help=f"clips that make demo fetches (default {clips})"
    )
    parser.add_argument("--tuning", action="store_true", help="the cameras and scenes on which the fit was tuned")
    parser.add_argument("--alternating", action="store_true", help="cameras whose events of noise alternate")
    parser.add_argument("--outside", action="store_true", help="cameras outside the family that is fitted")


def measure(asked: argparse.Namespace) -> Report:
    """Fit all cameras."""
    if asked.outside:
        return _outside()
    cases = (ALTERNATING if asked.alternating else TUNING if asked.tuning else REPORT)[: asked.cameras]
    records = [entry for case in cases for entry in _one(case, asked.clips)]
    rows: list[dict[str, Any]] = []
    missed: list[str] = []
    for name in dict.fromkeys(entry["parameter"] for entry in records):
        mine = [entry for entry in records if entry["parameter"] == name]
        some = [entry for entry in mine if entry["told"]]
        present = [entry for entry in some if entry["true"] > 0]
        held = sum(entry["held"] for entry in some)
        row = {
            "parameter": name, "cameras": len(mine), "told": len(some), "held": held,
            "width": float(np.median([r["half_width"] for r in present])) if present else None,
            "error": float(np.median([abs(r["value"] / r["true"] - 1) for r in present])) if present else None,
            "told_share": len(some) / len(mine), "held_share": held / max(len(some), 1),
        }  # fmt: skip
        rows.append(row)
        if not asked.alternating:
            missed += beyond(name, row, least={"told_share": LEAST_TOLD})
        elif some and name in ("shot_noise_hz", "leak_hz"):
            missed.append(f"{name}: told in {len(some)} of {len(mine)} cameras from noise that alternates")
        missed += beyond(name, row, least={"held_share": LEAST_HELD} if some else {})
    told, held = (sum(row[key] for row in rows) for key in ("told", "held"))
    return Report(records, [(rows, _COLUMNS)], [f"{held} of {told} intervals told hold the truth"], missed)


def _outside() -> Report:
    records: list[dict[str, Any]] = []
    missed = []
    for number, (name, camera) in enumerate(OTHERS.items()):
        film = rendered_film(_OUTSIDE[number], HEIGHT_PX, WIDTH_PX, 70.0)
        given = _recorded(record_other(film, camera, number))
        is_even = given.blocks() % 2 == 0  # stripes of the sensor
        fitted = fit(part_of(given, is_even))
        progress(f"{name}: told {', '.join(fitted.camera)}")
        other = part_of(given, ~is_even)
        cameras = {"fitted": [{"threshold_pos": 0.2, "threshold_neg": 0.2, **fitted.camera}]}
        cameras |= {preset: [drawn(recipe, seed) for seed in range(DRAWS)] for preset, recipe in PRESETS.items()}
        found = {who: np.median([_apart(other, each) for each in some], axis=0) for who, some in cameras.items()}
        for place, statistic in enumerate(("rate", "on/off", "pixels", "intervals")):
            values = {who: float(distances[place]) for who, distances in found.items()}
            records.append({"camera": name, "statistic": statistic, **values})
            if nearer := [who for who in values if values[who] < values["fitted"]]:
                missed.append(f"{name}, {statistic}: {', '.join(nearer)} nearer than the fitted camera")
    columns: list[Column] = [("camera", "camera", "{}", 1), ("statistic", "statistic", "{}", 1)]
    columns += [(who, who, "{:.3f}", 1) for who in ("fitted", *PRESETS)]
    return Report(records, [(records, columns)], [], missed)


def _apart(recording: Recorded, camera: Mapping[str, float]) -> tuple[float, ...]:
    both = [panels_of(each) for each in (recording, simulate_recording(recording, camera))]
    off, on = (np.array([panels["rates"][part].sum() for panels in both]) for part in HALVES)
    rates, ratios = np.log(on + off + 1.0), np.log((on + 1.0) / (off + 1.0))
    return (
        abs(rates[1] - rates[0]), abs(ratios[1] - ratios[0]),
        *(_distance(both[0][name], both[1][name]) for name in ("pixels", "intervals")),
    )  # fmt: skip


def _distance(mine: Doubles, other: Doubles) -> float:
    """Return the squared distance of the square roots of two statistics, scaled alike."""
    scale = max((mine.sum() + other.sum()) / 2, 1e-12)
    return float(((np.sqrt(mine / scale) - np.sqrt(other / scale)) ** 2).sum())


def _recorded(made: Mapping[str, Any]) -> Recorded:
    place = made["y"].astype(np.int64) * WIDTH_PX + made["x"]
    return recorded(
        HEIGHT_PX, WIDTH_PX, made["t"], place, made["p"], made["frames"], made["frame_us"], light=Light.parse("2.2")
    )


def _one(case: Case, clips: Path) -> Iterator[dict[str, Any]]:
    """Record and fit one camera; yield one record for each parameter."""
    camera, made = case.camera, record(case.film(clips), case.camera, case.seed)
    progress(f"camera {case.seed}: {case.scene}, {len(made['t'])} events")
    fitted = fit(_recorded(made))
    for name, estimate in fitted.estimates.items():
        true = float(getattr(camera, name))
        if name == "photoreceptor_hz":  # estimated as 1 / Hz
            true = 1.0 / true if true else 0.0
        if name == "hot_pixel_sigma" and not camera.hot_pixel_share:
            continue  # this camera has no such effect
        yield {
            "seed": case.seed, "scene": case.scene, "parameter": name, "true": true, "value": float(estimate.value),
            "low": float(estimate.low), "high": float(estimate.high), "told": estimate.told,
            "held": bool(estimate.told and estimate.low <= true <= estimate.high),
            "half_width": float((estimate.high - estimate.low) / 2 / max(estimate.value, 1e-12)),
            "left_out": fitted.left_out.get(name, ""), "events": len(made["t"]),
        }  # fmt: skip
