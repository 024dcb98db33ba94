"""Measure what bit depth, transfer and dithering change in slow scenes.

    python -m bench light --json light.json

Photographs that move by 0.24 px a frame (those of the physics bench), c = 0.1, against their exact events. The frames
are stored in every signal. Those of 8 bits are also dithered, or smoothed within half a grey level.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from itertools import product
from typing import Any

import numpy as np
from scipy import ndimage  # type: ignore[import-untyped]

from bench.accuracy.physics import (
    BIN_FRAMES,
    BINS,
    GAMMA,
    LOG_EPS,
    PHOTOGRAPHS,
    SEED,
    SPEEDS_PX,
    Reals,
    errors,
    log_intensity,
    true_bins,
)
from bench.frame import Report
from tests.oracles import transfers
from tests.oracles.analytic_scenes import moved_photograph
from v2v_protocol.command import Parser
from v2v_server.simulation import simulate, simulate_log
from v2v_server.video.luma import Signal

THRESHOLD = 0.1
_COLUMNS = (("frames", "frames", "{}", 1), ("voxel_error", "voxel error", "{:.1%}", 1),
            ("count_error", "count error", "{:.1%}", 1))  # fmt: skip


def add_flags(parser: Parser) -> None:
    """Add the bench's flags: there are none."""


def measure(asked: argparse.Namespace) -> Report:
    """Run the bench."""
    found: dict[str, list[dict[str, float]]] = {}
    for name in PHOTOGRAPHS:
        grey = moved_photograph(name, BIN_FRAMES * BINS + 1, 96, 128, SPEEDS_PX[0])
        true, events = true_bins(log_intensity(grey).reshape(len(grey), -1), BIN_FRAMES, THRESHOLD)
        for kind, steps in _simulated(grey[::BIN_FRAMES]):
            found.setdefault(kind, []).append(errors(steps, true, events, BINS))
    records = [
        {"frames": kind} | {key: float(np.mean([each[key] for each in cells])) for key in cells[0]}
        for kind, cells in found.items()
    ]
    return Report(records, [(records, _COLUMNS)])


def _simulated(grey: Reals) -> Iterator[tuple[str, Reals]]:
    """Yield what the frames are, and the signed events [steps, pixels] of each step."""
    camera: dict[str, Any] = {"threshold_pos": THRESHOLD, "bins": len(grey) - 1, "seed": SEED, "dtype": "int16"}

    def of_levels(levels: Reals) -> Reals:
        log = log_intensity(np.clip(levels / 255.0, 0.0, 1.0))
        return np.asarray(simulate_log(log, **camera).voxels.reshape(len(grey) - 1, -1))

    yield "not rounded", of_levels(255.0 * grey)
    for transfer, bits in product(("", "pq", "hlg"), (8, 10, 12)):
        signal = Signal(bits, transfer)
        stored = np.rint(signal.white * transfers.encode(grey**GAMMA, transfer, GAMMA)).astype(signal.dtype)
        made = simulate(stored, gamma=GAMMA, log_eps=LOG_EPS, bits=bits, transfer=transfer, **camera).voxels
        yield str(signal), made.reshape(len(grey) - 1, -1)
    rounded, random = np.rint(255.0 * grey), np.random.default_rng(SEED)
    for name, shape in (("fixed", grey.shape[1:]), ("fresh", grey.shape)):
        for width in (0.5, 1.0):
            noise = width * random.uniform(-0.5, 0.5, shape)
            yield f"8 bits, {name} dither of {width:g} levels", of_levels(rounded + noise)
    for sigma in (0.7, 1.5):
        smooth = ndimage.gaussian_filter(rounded, (0.0, sigma, sigma))
        yield f"8 bits, smoothed by {sigma:g} px", of_levels(np.clip(smooth, rounded - 0.5, rounded + 0.5))
