"""Fit cameras with known parameters, and count what is told and what holds the truth.

Cameras of random parameters record rendered scenes, and films of a high rate (``--film``), event by event
(``tests/oracles/cameras.py``), with frames at 30 a second: two seconds that move, three that stand still. Each
recording is fitted. "told" counts the cameras whose recording can tell a parameter, "held" those of them whose 90 %
interval holds the truth; "width" is the median half width of the intervals, as a share.

Bars: 85 % of all intervals told hold the truth; both thresholds are told in two of three cameras, with a median half
width of at most 15 %; every other parameter in one of three.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from bench.frame import Column, Report, add_whole, progress
from tests.oracles.cameras import SCENES, Film, TrueCamera, drawn_camera, film_of_video, record, rendered_film
from v2v_protocol.command import Parser
from v2v_server.fit.fit import fit
from v2v_server.fit.recording import recorded

HEIGHT_PX, WIDTH_PX = 96, 128
FIRST_SEED = 100
LEAST_HELD, WIDEST_THRESHOLD = 0.85, 0.15
FILM_HZ = 240
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


def measure(asked: argparse.Namespace) -> Report:
    """Fit all cameras."""
    records = list(fits(asked.cameras, asked.first_seed, asked.film))
    rows, missed, told, held = [], [], 0, 0
    for name in dict.fromkeys(entry["parameter"] for entry in records):
        mine = [entry for entry in records if entry["parameter"] == name]
        some = [entry for entry in mine if entry["told"]]
        inside = sum(entry["held"] for entry in some)
        present = [entry for entry in some if entry["true"] > 0]
        rows.append(
            {
                "parameter": name, "cameras": len(mine), "told": len(some), "held": inside,
                "width": float(np.median([r["half_width"] for r in present])) if present else None,
                "error": float(np.median([abs(r["value"] / r["true"] - 1) for r in present])) if present else None,
            }
        )  # fmt: skip
        told, held = told + len(some), held + inside
        is_threshold = name in _ALWAYS_THERE
        if len(some) < len(mine) * (2 if is_threshold else 1) / 3:
            missed.append(f"{name} is told in {len(some)} of {len(mine)} cameras")
        if is_threshold and not (rows[-1]["width"] or 1.0) <= WIDEST_THRESHOLD:
            missed.append(f"the median interval of {name} is wider than {WIDEST_THRESHOLD:.0%}")
    if held < LEAST_HELD * told:
        missed.append(f"{held} of {told} intervals hold the truth; at least {LEAST_HELD:.0%} should")
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


def one(camera: TrueCamera, film: Film, seed: int, scene: str) -> Iterator[dict[str, Any]]:
    """Record and fit one camera."""
    made = record(film, camera, seed)
    place = made["y"].astype(np.int64) * WIDTH_PX + made["x"]
    given = recorded(HEIGHT_PX, WIDTH_PX, made["t"], place, made["p"], made["frames"], made["frame_us"])
    begin = time.perf_counter()
    fitted = fit(given)
    seconds = time.perf_counter() - begin
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
            "left_out": fitted.left_out.get(name, ""), "events": len(made["t"]), "fit_seconds": seconds,
        }  # fmt: skip
