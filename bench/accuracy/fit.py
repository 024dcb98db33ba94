"""Fit cameras with known parameters, and count what is told and what holds the truth.

Cameras of random parameters record rendered scenes, and films of a high rate (``--film``), event by event
(``tests/oracles/cameras.py``), with frames at 30 a second: two seconds that move, three that stand still. Each
recording is fitted. "told" counts the cameras whose recording can tell a parameter, "held" those of them whose 90 %
interval holds the truth; "width" is the median half width of the intervals, as a share.

Bars: 85 % of all intervals told hold the truth; both thresholds are told in two of three cameras, with a median half
width of at most 15 %; every other parameter in one of three.

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
    SCENES,
    Film,
    TrueCamera,
    drawn_camera,
    film_of_video,
    record,
    rendered_film,
)
from tests.oracles.other_cameras import OTHERS, record_other
from tests.oracles.simulators import drawn
from v2v_protocol.command import Parser
from v2v_protocol.recipe import PRESETS
from v2v_recordings.items import Light
from v2v_tools.fit.fit import fit
from v2v_tools.fit.interval import Doubles
from v2v_tools.fit.recording import Recorded, recorded
from v2v_tools.fit.statistics import panels_of, simulate_recording

HEIGHT_PX, WIDTH_PX = 96, 128
FIRST_SEED = 100
LEAST_HELD, WIDEST_THRESHOLD = 0.85, 0.15
FILM_HZ = 240
DRAWS = 8
HALVES = slice(0, 8), slice(8, 16)
"""Columns of darker and of brighter events."""
_ALWAYS_THERE = ("threshold_pos", "threshold_neg")
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
    add_whole(parser, "--cameras", 24, "number of cameras")
    parser.add_argument("--film", type=Path, metavar="VIDEO", help=f"every sixth camera sees this, {FILM_HZ} frames/s")
    add_whole(parser, "--first-seed", FIRST_SEED, "seed of the first camera")
    parser.add_argument("--outside", action="store_true", help="cameras outside the family that is fitted")


def measure(asked: argparse.Namespace) -> Report:
    """Fit all cameras."""
    if asked.outside:
        return _outside()
    records = list(fits(asked.cameras, asked.first_seed, asked.film))
    rows: list[dict[str, Any]] = []
    missed: list[str] = []
    for name in dict.fromkeys(entry["parameter"] for entry in records):
        mine = [entry for entry in records if entry["parameter"] == name]
        some = [entry for entry in mine if entry["told"]]
        present = [entry for entry in some if entry["true"] > 0]
        row = {
            "parameter": name, "cameras": len(mine), "told": len(some), "held": sum(entry["held"] for entry in some),
            "width": float(np.median([r["half_width"] for r in present])) if present else None,
            "error": float(np.median([abs(r["value"] / r["true"] - 1) for r in present])) if present else None,
            "told_share": len(some) / len(mine),
        }  # fmt: skip
        rows.append(row)
        least, most = (2 / 3, {"width": WIDEST_THRESHOLD}) if name in _ALWAYS_THERE else (1 / 3, {})
        missed += beyond(name, row, least={"told_share": least}, most=most)
    told, held = (sum(row[key] for row in rows) for key in ("told", "held"))
    missed += beyond("intervals", {"held_share": held / max(told, 1)}, least={"held_share": LEAST_HELD})
    return Report(records, [(rows, _COLUMNS)], [f"{held} of {told} intervals told hold the truth"], missed)


def fits(cameras: int, first_seed: int, film_path: Path | None) -> Iterator[dict[str, Any]]:
    """Yield one record for each camera and parameter."""
    for number in range(cameras):
        seed = first_seed + number
        camera, rng = drawn_camera(seed), np.random.default_rng(10_000 + seed)
        speed = float(np.exp(rng.uniform(np.log(30), np.log(160))))
        scene = SCENES[number % len(SCENES)]
        if film_path is not None and number % 6 == 5:
            scene, film = film_path.name, film_of_video(film_path, HEIGHT_PX, WIDTH_PX, FILM_HZ)
        else:
            film = rendered_film(scene, HEIGHT_PX, WIDTH_PX, speed)
        progress(f"camera {number}: {scene}, {speed:.0f} px a second")
        yield from one(camera, film, seed, scene)


def _outside() -> Report:
    records: list[dict[str, Any]] = []
    missed = []
    for number, (name, camera) in enumerate(OTHERS.items()):
        film = rendered_film(SCENES[number], HEIGHT_PX, WIDTH_PX, 70.0)
        given = _recorded(record_other(film, camera, number))
        is_even = given.blocks() % 2 == 0  # stripes of the sensor
        fitted = fit(given.part(is_even))
        progress(f"{name}: told {', '.join(fitted.camera)}")
        other = given.part(~is_even)
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
    begin, end = int(recording.frame_us[0]), int(recording.frame_us[-1])
    both = [
        panels_of(each, each.known_light.of(np.arange(256.0)), begin, end)
        for each in (recording, simulate_recording(recording, camera))
    ]
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


def one(camera: TrueCamera, film: Film, seed: int, scene: str) -> Iterator[dict[str, Any]]:
    """Record and fit one camera."""
    made = record(film, camera, seed)
    fitted = fit(_recorded(made))
    for name, estimate in fitted.estimates.items():
        true = float(getattr(camera, name))
        if name == "photoreceptor_hz":  # estimated as 1 / Hz
            true = 1.0 / true if true else 0.0
        if name == "hot_pixel_sigma" and not camera.hot_pixel_share:
            continue  # this camera has no such effect
        yield {
            "seed": seed, "scene": scene, "parameter": name, "true": true, "value": float(estimate.value),
            "low": float(estimate.low), "high": float(estimate.high), "told": estimate.told,
            "held": bool(estimate.told and estimate.low <= true <= estimate.high),
            "half_width": float((estimate.high - estimate.low) / 2 / max(estimate.value, 1e-12)),
            "left_out": fitted.left_out.get(name, ""), "events": len(made["t"]),
        }  # fmt: skip
