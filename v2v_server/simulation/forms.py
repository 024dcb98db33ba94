"""Load the compiled forms of the kernels (:class:`v2v_server.simulation.precision.Variant`)."""

from __future__ import annotations

import numpy as np

from v2v_server.simulation.clip import simulate
from v2v_server.simulation.precision import USUAL, Variant
from v2v_server.video.picture import Signal


def load(variant: Variant) -> None:
    """Load a variant from numba's cache, or compile it."""
    simulate(
        np.zeros((2, 1, 1), Signal(variant.bits).dtype),
        threshold_pos=0.2,
        bins=1,
        dtype=variant.voxel_dtype,
        precision=variant.precision,
        frames_per_second=1.0,
        bits=variant.bits,
        shot_noise_hz=1.0 if variant.is_general else 0.0,
    )


def warm_up() -> None:
    """Load, or compile, the variants that a server worker usually needs."""
    for variant in sorted(USUAL):
        load(variant)
