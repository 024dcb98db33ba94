"""Measure what bit depth and transfer change in slow scenes.

    python -m bench light --json light.json

Photographs that move by 0.24 px a frame (those of the physics bench), c = 0.1, against their exact events. The frames
are stored in every signal.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from itertools import product
from typing import Any

import numpy as np

from bench.accuracy.physics import (
    BIN_FRAMES,
    BINS,
    PHOTOGRAPHS,
    SEED,
    SPEEDS_PX,
    errors,
    true_bins,
)
from bench.frame import Report
from tests.oracles import transfers
from tests.oracles.analytic_scenes import moved_photograph
from tests.oracles.rendered import GAMMA, LOG_EPS, Reals, log_levels
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
        true, events = true_bins(log_levels(grey).reshape(len(grey), -1), BIN_FRAMES, THRESHOLD)
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

    yield "not rounded", simulate_log(log_levels(grey), **camera).voxels.reshape(len(grey) - 1, -1)
    for transfer, bits in product(("", "pq", "hlg"), (8, 10, 12)):
        signal = Signal(bits, transfer)
        stored = np.rint(signal.white * transfers.encode(grey**GAMMA, transfer, GAMMA)).astype(signal.dtype)
        made = simulate(stored, gamma=GAMMA, log_eps=LOG_EPS, bits=bits, transfer=transfer, **camera).voxels
        yield str(signal), made.reshape(len(grey) - 1, -1)
