"""Which arithmetic a clip needs, float32 where that is exact enough, float64 beyond, a refusal beyond that; and which
compiled form of the kernels.

Error of the kernel. Let u be the unit roundoff (2**-24 in float32, 2**-53 in float64) and D the largest |dL| that a
step can make: the larger threshold (residual) + the range of the log intensity + the largest noise + the largest drift
of a hot pixel. One step of ``pixel.py`` rounds, to first order, by at most

    change of level, + noise              u (range) + u (range + noise)
    scale of the noise, its product       2 u noise
    drift, its scale, product, + residual u (residual + 5 drift)
    potential                             u D
    threshold * count                     u D             (subtracting it is exact, by Sterbenz' lemma)

together no more than 7 u D. The start of the residual, one more such step, and the log intensities, rounded to u |L| at
either end, come once (those of the frames between cancel). So after n steps residual and events together are off by

    8 u ((n + 1) D + |L|)  =  8 u * threshold * most_events        (``v2v_protocol.recipe.most_events``)

at most, where the 8 has room for the terms of second order. Float32 is used up to 2**20 events, float64 up to 2**49:
then the error stays below half the smaller threshold in either, over the whole clip and not only over a step, and the
count of a bin is exact, being below 2**24 or 2**53.

Where a step is divided (``voxel.Timeline``), n counts its segments. Levels between two known ones are rounded too, but
each ends one change and begins the next, so that these errors cancel as those of the frames do.

Effects (``effects/``) round more: 4 u (range) for the low-pass, whose own error a step can only pass on, 3 u D for
the leak, and up to 12 u D for a refractory period in place of the 2 u D of potential and product: no more than 24 u D
in all. The most events of such a clip are counted EFFECTS_MARGIN times, which has room for that.

Everything here is sums, products and correctly rounded roots: every host comes to the same decision.

Each compiled form takes seconds to compile, and there are a dozen. A worker loads the usual ones at its start
(``forms.py``). The others are compiled when a stream needs them, before the work on its first sample begins.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import UsageError
from v2v_protocol.recipe import FRAMES, LARGEST_EVENTS, Recipe
from v2v_protocol.spec import VOXEL_DTYPES
from v2v_server.video.picture import MOST_BITS

AUTO = "auto"
Real = type[np.floating[Any]]
LIMITS: dict[str, tuple[Real, float]] = {"float32": (np.float32, 2.0**20), "float64": (np.float64, LARGEST_EVENTS)}
"""Largest number of events of a pixel in a clip, by arithmetic; narrowest first."""
THRESHOLD_ENDS = (2.0**-100, 2.0**100)
"""Limits of a threshold, between which neither arithmetic overflows or loses digits to underflow."""

EFFECTS_MARGIN = 4.0
"""Bound of the error with effects, as a multiple of the plain model's error."""


def choose(asked: str, events: float) -> Real:
    """Choose the arithmetic for a clip.

    Args:
        asked: "auto" for the narrowest that is exact enough, or a name.
        events: ``most_events`` of the clip.

    Raises:
        UsageError: there is no such arithmetic, or the clip exceeds the limit of the requested one, or of all with
            "auto".
    """
    if asked != AUTO and asked not in LIMITS:
        raise UsageError(f"precision {asked!r}: choose one of {AUTO}, {', '.join(LIMITS)}")
    for name, (real, limit) in LIMITS.items():
        if asked in (AUTO, name) and events <= limit:
            return real
    name = "float64" if asked == AUTO else asked
    raise UsageError(
        f"a pixel of this clip may fire {events:.4g} events; {name} counts at most {LIMITS[name][1]:.4g} exactly: "
        "raise the thresholds, lower noise or hot pixels, or use fewer frames"
        + (", or precision='auto'" if name == "float32" else "")
    )


def check_thresholds(threshold_pos: float, threshold_neg: float) -> None:
    """Refuse thresholds that float32 arithmetic cannot handle.

    Raises:
        UsageError: one is outside THRESHOLD_ENDS.
    """
    low, high = THRESHOLD_ENDS
    for name, value in (("threshold_pos", threshold_pos), ("threshold_neg", threshold_neg)):
        if not low <= value <= high:
            raise UsageError(f"{name} = {value!r}: give a number from {low:.3g} to {high:.3g}")


def noise_sum(noise_sigma: float, hot_pixel_sigma: float, step_seconds: npt.NDArray[np.float64]) -> float:
    """Return the standard deviations of noise and hot drift, summed over the steps, log units.

    Args:
        noise_sigma, hot_pixel_sigma: log units, of a second.
        step_seconds: [steps].
    """
    first = float(step_seconds[0])
    if (step_seconds == first).all():
        return len(step_seconds) * (noise_sigma * math.sqrt(first) + hot_pixel_sigma * first)
    return noise_sigma * math.fsum(np.sqrt(step_seconds)) + hot_pixel_sigma * math.fsum(step_seconds)


class Variant(NamedTuple):
    """One compiled form of a kernel."""

    voxel_dtype: str
    is_general: bool
    precision: str
    is_divided: bool = False
    """Whether steps have sub-steps, whose levels the kernels of ``v2v_server.motion`` make."""
    bits: int = 8
    """More than 8: for frames of uint16."""
    is_rendered: bool = False
    """Whether its frames are rendered by the kernels of ``v2v_server.worlds``."""

    def __str__(self) -> str:
        kind = f"{' by the general kernel' if self.is_general else ''}{' with sub-steps' if self.is_divided else ''}"
        kind += " of more than 8 bits" if self.bits > 8 else ""
        return f"{self.voxel_dtype} voxels{kind} in {self.precision}"


USUAL = frozenset({*(Variant(dtype, False, "float32") for dtype in VOXEL_DTYPES), Variant("int8", True, "float32")})
"""Variants that ``forms.warm_up`` loads: every dtype of the paper's kernel, int8 of the general one."""


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
        arrays: those that the kernel makes (``representations.NAMES``), at least one.
        levels_per_step: largest number of levels between two frames.
    """
    events = recipe.worst_events(step_seconds, thresholds, levels_per_step) * (
        EFFECTS_MARGIN if recipe.has_effects else 1.0
    )
    depths = [8] if recipe.light == "sdr" or levels_per_step else [8, MOST_BITS]
    precisions = ["float32"] if events <= LIMITS["float32"][1] else list(LIMITS)
    has_times = recipe.grids_per_frame > 0 or recipe.is_timed
    is_plain = not (recipe.has_effects or has_times) and recipe.start != FRAMES
    is_general = not is_plain or levels_per_step > 0 or {"voxels"} != set(arrays)
    return frozenset(
        Variant(voxel_dtype, is_general, precision, levels_per_step > 0, bits)
        for precision in precisions
        for bits in depths
    )
