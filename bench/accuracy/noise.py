"""Compare band-limited noise with the continuous process: rates, signs and counts of still pixels, bins of moving ones.

    python -m bench noise --json noise.json

The kernel simulates steps of 1, 8 and 33 ms. The other side is an Ornstein-Uhlenbeck process of its own random numbers
in steps of at most a thirtieth of its time constant, with the crossings between them (``tests/oracles/noise_band.py``).
Thresholds 0.2, mismatch 0.14, triangular start. A distance is half the sum of the differences of two distributions:
of the signed events of a pixel in a step, and of the events of a pixel in a second.

Bars: opposite signs within .03, rates within 10 %, distances of signed bins of moving light below .04, of counts below
.1. Where fewer than 400 events were counted, only the counts are judged. The kernel divides
a step whose h = 2 pi f T lies from 1.2 to 2.4 or above 8 (``v2v_server/simulation/effects/noise_band.py``).
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from bench.frame import Column, Record, Report, add_whole, beyond
from tests.oracles.noise_band import Counted, continuous, triangular_starts
from v2v_protocol.command import Parser
from v2v_server.simulation import simulate
from v2v_server.simulation.intensity import log_table_float64

THRESHOLD, MISMATCH, GAMMA, LOG_EPS = 0.2, 0.14, 2.2, 1e-3
SHARES, CORNERS_HZ, STEPS_MS = (0.1, 0.2, 0.3), (10.0, 35.0, 100.0), (1, 8, 33)
SCENES = ("still", "sine", "ramp")
_SECONDS, _FEWEST = 2.0, 400
_COLUMNS: tuple[Column, ...] = (
    ("scene", "", "{}", 1),
    ("share", "sigma", "{:.1f}", 1),
    ("corner_hz", "corner Hz", "{:.0f}", 1),
    ("step_ms", "step ms", "{}", 1),
    ("h", "h", "{:.2f}", 1),
    ("true_rate_hz", "true Hz", "{:.3g}", 1),
    ("rate_hz", "Hz", "{:.3g}", 1),
    ("true_opposite", "true opposite", "{:.3f}", 1),
    ("opposite", "opposite", "{:.3f}", 1),
    ("bins", "distance of bins", "{:.3f}", 1),
    ("counts", "of counts", "{:.3f}", 1),
    ("true_variance", "true variance of a step", "{:.3g}", 1),
    ("variance", "variance", "{:.3g}", 1),
)


@dataclass(frozen=True, slots=True)
class Setup:
    """A camera, a scene and its steps."""

    scene: str
    share: float
    corner_hz: float
    step_ms: int
    side_px: int = 64

    @property
    def steps(self) -> int:
        """Return the number of steps."""
        return max(round(_SECONDS * 1e3 / self.step_ms), 1)


def scene_of(setup: Setup) -> npt.NDArray[np.uint8]:
    """Return the frames of a scene, [steps + 1, H, W]: still, a sine of 4 thresholds at 5 Hz of any phase, or ramps up
    and down of 2 thresholds a second.
    """
    seconds = np.arange(setup.steps + 1)[:, None] * setup.step_ms * 1e-3
    phase = np.random.default_rng(5).random(setup.side_px**2)
    table = log_table_float64(GAMMA, LOG_EPS)
    middle = table[110]
    level = {
        "still": middle + 0.0 * (seconds + phase),
        "sine": middle + 4 * THRESHOLD * np.sin(2 * np.pi * (5.0 * seconds + phase)),
        "ramp": middle + 2 * THRESHOLD * (seconds - _SECONDS / 2) * np.where(phase < 0.5, 1.0, -1.0),
    }[setup.scene]
    grey: npt.NDArray[np.uint8] = np.searchsorted((table[1:] + table[:-1]) / 2, level).astype(np.uint8)
    return grey.reshape(-1, setup.side_px, setup.side_px)


def simulated(setup: Setup, frames: npt.NDArray[np.uint8], seed: int = 1) -> Counted:
    """Count the events of the kernel."""
    made = simulate(
        frames, threshold_pos=THRESHOLD, bins=1, frames_per_second=1e3 / setup.step_ms, dtype="int16", seed=seed,
        start="triangular", noise_band_share=setup.share, noise_band_hz=setup.corner_hz,
        threshold_mismatch_sigma=MISMATCH,
    )  # fmt: skip
    counts = made.array("event_counts")[:, :, 0].reshape(setup.steps, 2, -1).astype(np.int64)
    events = made.to_events(setup.step_ms * 1e3)
    pixel = events.y.astype(np.int64) * events.width_px + events.x
    order = np.argsort(pixel, kind="stable")
    pixel, sign = pixel[order], events.p[order]
    follows = pixel[1:] == pixel[:-1]
    return Counted(counts[:, 1], counts[:, 0], int(follows.sum()), int((follows & (sign[1:] != sign[:-1])).sum()))


def true(setup: Setup, frames: npt.NDArray[np.uint8], seed: int = 1) -> Counted:
    """Count the events of the continuous process."""
    rng = np.random.default_rng(seed)
    levels = log_table_float64(GAMMA, LOG_EPS)[frames.reshape(len(frames), -1)]
    normals = rng.standard_normal((2, levels.shape[1]))
    thresholds = THRESHOLD * np.maximum(1.0 + MISMATCH * normals, 0.25)
    starts = triangular_starts(thresholds, rng)
    sigma = setup.share * THRESHOLD
    return continuous(levels, setup.step_ms * 1e-3, thresholds, starts, sigma, setup.corner_hz, seed)


def distance(one: npt.NDArray[np.int64], other: npt.NDArray[np.int64]) -> float:
    """Return half the sum of the differences of two distributions of whole numbers."""
    least, most = min(one.min(), other.min()), max(one.max(), other.max())
    edges = np.arange(least, most + 2) - 0.5
    shares = [np.histogram(each, edges)[0] / each.size for each in (one, other)]
    return float(np.abs(shares[0] - shares[1]).sum() / 2)


def compared(setup: Setup) -> Record:
    """Simulate a setup both ways."""
    frames = scene_of(setup)
    found, expected = simulated(setup, frames), true(setup, frames)
    record: dict[str, Any] = {
        "scene": setup.scene, "share": setup.share, "corner_hz": setup.corner_hz, "step_ms": setup.step_ms,
        "h": 2e-3 * np.pi * setup.corner_hz * setup.step_ms,
    }  # fmt: skip
    per_second = max(round(1e3 / setup.step_ms), 1)
    for name, each in (("", found), ("true_", expected)):
        total = each.on + each.off
        record[f"{name}events"] = int(total.sum())
        record[f"{name}rate_hz"] = float(total.sum()) / total.size * 1e3 / setup.step_ms
        record[f"{name}opposite"] = each.opposite / max(each.pairs, 1)
        record[f"{name}pairs"] = each.pairs
        record[f"{name}variance"] = float((each.on - each.off).var())
    record["bins"] = distance(found.on - found.off, expected.on - expected.off)
    record["counts"] = distance(*((each.on + each.off)[:per_second].sum(axis=0) for each in (found, expected)))
    return record


def missed(records: Sequence[Record]) -> list[str]:
    """Return the bars that these records miss."""
    lines: list[str] = []
    for record in records:
        of_step = f"{record['corner_hz']:g} Hz, {record['step_ms']} ms, h {record['h']:.2f}"
        name = f"{record['scene']}, sigma {record['share']}, {of_step}"
        found = {"counts": record["counts"]}
        if record["scene"] != "still":
            found["bins"] = record["bins"]
        if record["true_events"] >= _FEWEST:
            found["rate"] = abs(record["rate_hz"] / record["true_rate_hz"] - 1.0)
        if record["true_pairs"] >= _FEWEST:
            found["opposite"] = abs(record["opposite"] - record["true_opposite"])
        bars = {"counts": 0.1, "bins": 0.04, "rate": 0.1, "opposite": 0.03}
        lines += beyond(name, found, most={key: bars[key] for key in found})
    return lines


def add_flags(parser: Parser) -> None:
    """Add the bench's flags."""
    add_whole(parser, "--side", 64, "side of the picture, px")


def measure(asked: argparse.Namespace) -> Report:
    """Run the bench."""
    records = [
        compared(Setup(scene, share, corner, step, asked.side))
        for scene in SCENES
        for share in SHARES
        for corner in CORNERS_HZ
        for step in STEPS_MS
    ]
    return Report(records, [(records, _COLUMNS)], missed=missed(records))
