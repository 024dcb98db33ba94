"""List the compiled forms of the kernels that a stream may need, and load them.

Each takes seconds to compile, and there are a dozen. A worker loads the usual ones at its start. The others are
compiled when a stream needs them, before the work on its first sample begins.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import NamedTuple

import numpy as np

from v2v_protocol.recipe import Recipe
from v2v_protocol.spec import VOXEL_DTYPES
from v2v_server.simulation.clip import simulate
from v2v_server.simulation.precision import EFFECTS_MARGIN, LIMITS
from v2v_server.video.luma import MOST_BITS, Signal


class Variant(NamedTuple):
    """One compiled form of a kernel."""

    voxel_dtype: str
    is_general: bool
    precision: str
    is_divided: bool = False
    """Whether steps have sub-steps, whose levels the kernels of ``v2v_server.motion`` make."""
    bits: int = 8
    """More than 8: for frames of uint16."""

    def __str__(self) -> str:
        kind = f"{' by the general kernel' if self.is_general else ''}{' with sub-steps' if self.is_divided else ''}"
        kind += " of more than 8 bits" if self.bits > 8 else ""
        return f"{self.voxel_dtype} voxels{kind} in {self.precision}"


USUAL = frozenset({*(Variant(dtype, False, "float32") for dtype in VOXEL_DTYPES), Variant("int8", True, "float32")})
"""Variants that :func:`warm_up` loads: every dtype of the paper's kernel, int8 of the general one."""


def variants(
    recipe: Recipe,
    voxel_dtype: str,
    step_seconds: float = 1.0,
    thresholds: tuple[float, float] | None = None,
    arrays: Collection[str] = ("voxels",),
    levels_per_step: int = 0,
) -> frozenset[Variant]:
    """Return the variants that the draws of a recipe may need, as far as the recipe determines them.

    It does not if something is stated per second and time stamps are irregular: such a clip may turn out to need
    float64, and then waits for the compiler.

    Args:
        recipe: the recipe.
        voxel_dtype: "int8", "int16" or "float32".
        step_seconds: time from one frame to the next; used only if something is stated per second.
        thresholds: thresholds that a list file states for the video; None if it states none.
        arrays: those that the kernel makes (``kernels.ARRAYS``), at least one.
        levels_per_step: largest number of levels between two frames.
    """
    events = recipe.worst_events(step_seconds, thresholds, levels_per_step) * (
        EFFECTS_MARGIN if recipe.has_effects else 1.0
    )
    depths = [8] if recipe.light == "sdr" or levels_per_step else [8, MOST_BITS]
    precisions = ["float32"] if events <= LIMITS["float32"][1] else list(LIMITS)
    has_times = recipe.grids_per_frame > 0 or recipe.is_timed
    is_general = recipe.has_effects or has_times or levels_per_step > 0 or {"voxels"} != set(arrays)
    return frozenset(
        Variant(voxel_dtype, is_general, precision, levels_per_step > 0, bits)
        for precision in precisions
        for bits in depths
    )


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
