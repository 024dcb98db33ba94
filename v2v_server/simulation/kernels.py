"""Call the kernel that a clip needs: the paper's, or the general one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import UsageError
from v2v_protocol.events import EventList, check_duration, whole_edges
from v2v_protocol.recipe import pixel_thresholds
from v2v_protocol.sample import SampleParams
from v2v_protocol.spec import VOXEL_DTYPES
from v2v_server.simulation import noise
from v2v_server.simulation.effects import prepare
from v2v_server.simulation.effects.kernel import FIXED, TRIANGULAR, UNIFORM, Outputs, Segments, simulate_general
from v2v_server.simulation.intensity import Intensity, fine_table, log_table, log_table_float64
from v2v_server.simulation.pixel import simulate_pixels, words
from v2v_server.simulation.precision import Real
from v2v_server.simulation.voxel import (
    LARGEST_COUNT,
    Doubles,
    Levels,
    Longs,
    Moments,
    Timeline,
    new_array,
    rounding_tolerance,
    timeline,
)

ARRAYS = ("voxels", "event_counts", "voxels_bilinear")
"""Arrays that a kernel makes."""
LARGEST_FLOAT16 = 65504.0


@dataclass(frozen=True, slots=True)
class KernelInput:
    """Inputs of a kernel.

    Attributes:
        frames: [n, H, W] grey levels, uint8, or uint16 if the signal has more than 8 bits; or floating-point log
            intensities.
        intensity: of grey levels; None: the frames are log intensities, and there are no effects.
        source_index: [steps + 1] int64, the frame that each position shows; starts at 0.
        params: the draw.
        noise_durations: [steps] duration of each step in the unit of noise and drift.
        step_seconds: [steps].
        bins: bins of a voxel grid.
        edges: the ends of the bins.
        dtype: "int8", "int16" or "float32".
        start_residual: log units; None draws it.
        start: how it is drawn, "uniform" or "triangular"; "zero" starts at 0.
        levels: intermediate levels, or None; only with frames of 8 bits.
        grids_have_durations: whether a grid's time is that of ``step_seconds``; else all its steps count as equal.
    """

    frames: npt.NDArray[Any]
    intensity: Intensity | None
    source_index: Longs
    params: SampleParams
    noise_durations: Doubles
    step_seconds: Doubles
    bins: int
    edges: Moments
    dtype: str
    start_residual: float | None = None
    levels: Levels | None = None
    grids_have_durations: bool = False
    start: str = "uniform"

    def __post_init__(self) -> None:
        if self.dtype not in LARGEST_COUNT:
            raise UsageError(f"voxel dtype {self.dtype!r}: choose one of {', '.join(VOXEL_DTYPES)}")

    @property
    def law(self) -> tuple[int, float]:
        """How residuals start: a constant of ``effects/kernel.py``, and the value of FIXED."""
        if self.start_residual is None and self.start != "zero":
            return (TRIANGULAR if self.start == "triangular" else UNIFORM), 0.0
        return FIXED, self.start_residual or 0.0

    @property
    def needs_general(self) -> bool:
        """Return whether the voxels alone need the general kernel."""
        is_divided = self.grids_have_durations or bool(self.edges.share.any())
        return bool(self.params.effects) or self.levels is not None or is_divided

    @property
    def segments(self) -> int:
        """An upper bound of the number of segments."""
        divided = int(np.count_nonzero(self.edges.share))
        return len(self.noise_durations) + divided + (0 if self.levels is None else len(self.levels.at.step))

    def timeline(self) -> Timeline:
        """Divide the clip into segments."""
        durations = self.step_seconds if self.grids_have_durations else np.ones(len(self.step_seconds))
        return timeline(self.edges, self.bins, durations, None if self.levels is None else self.levels.at)

    def form(self, name: str) -> tuple[str, tuple[int, ...]]:
        """Return dtype and shape of one of :data:`ARRAYS`."""
        grids, picture = (len(self.edges.step) - 1) // self.bins, self.frames.shape[1:]
        if name == "event_counts":
            return self.dtype, (grids, 2, self.bins, *picture)
        is_bilinear = name == "voxels_bilinear" and self.dtype != "float32"
        return "float16" if is_bilinear else self.dtype, (grids, self.bins, *picture)


def fill(
    given: KernelInput, real: Real, out: Mapping[str, npt.NDArray[Any] | None]
) -> tuple[dict[str, Any], dict[str, int]]:
    """Make arrays of a clip.

    Args:
        given: the clip.
        real: arithmetic of the pixels, float32 or float64.
        out: by name (:data:`ARRAYS`), C-contiguous arrays to write, or None to allocate one.

    Returns:
        the arrays; the number of clipped bins of each.

    Raises:
        UsageError: an array has another form.
    """
    arrays = {name: new_array(*given.form(name), array) for name, array in out.items()}
    if out.keys() == {"voxels"} and not given.needs_general:
        return arrays, {"voxels": _paper(given, real, arrays["voxels"])}
    if not out:
        return {}, {}
    general = _General(given, real)
    bilinear = None
    if "voxels_bilinear" in arrays:
        bilinear = np.zeros(arrays["voxels_bilinear"].shape, np.float32)
    tally = general.run(arrays.get("voxels"), arrays.get("event_counts"), bilinear)
    clipped = dict(zip(ARRAYS, map(int, tally), strict=False))
    if bilinear is not None:
        within = bilinear
        clipped["voxels_bilinear"] = 0
        if arrays["voxels_bilinear"].dtype == np.float16:
            within = np.clip(bilinear, -LARGEST_FLOAT16, LARGEST_FLOAT16)
            clipped["voxels_bilinear"] = int(np.count_nonzero(within != bilinear))
        arrays["voxels_bilinear"][...] = within
    return arrays, {name: clipped[name] for name in arrays}


def list_events(given: KernelInput, real: Real, step_us: Doubles) -> EventList:
    """List the events of a clip with their times.

    A time is rounded down to a microsecond, or up to the first of its bin, so that bins of a microsecond or more hold
    the events that the arrays count.

    Args:
        given, real: see :func:`fill`.
        step_us: [steps] duration of each step, microseconds.

    Raises:
        UsageError: the clip lasts less than a microsecond or more than 2**62.
    """
    check_duration(float(step_us.sum()))
    general = _General(given, real)
    count = int(general.run(listing=_listing(0))[2])
    event, passed = _listing(count)
    general.run(listing=(event, passed))
    pixel, segment, sign = event
    part, since = general.timeline, np.r_[0.0, np.cumsum(step_us)]
    steps = np.append(step_us, 0.0)
    starts = since[part.step] + part.start * step_us[part.step]
    first_us = whole_edges(since[given.edges.step] + given.edges.share * steps[given.edges.step])
    bin_of = part.bin[segment]
    t = np.floor(starts[segment] + passed * (part.share * step_us[part.step])[segment]).astype(np.int64)
    t = np.maximum(np.minimum(t, first_us[bin_of + 1] - 1), first_us[bin_of])
    order = np.lexsort((pixel, t))
    _, height, width = given.frames.shape
    y, x = np.divmod(pixel[order], width)
    return EventList(x.astype(np.uint16), y.astype(np.uint16), t[order], sign[order] > 0, width, height)


def _listing(capacity: int) -> tuple[Longs, Doubles]:
    return np.empty((3, capacity), np.int64), np.empty(capacity)


def _paper(given: KernelInput, real: Real, voxels: npt.NDArray[Any]) -> int:
    params, durations = given.params, given.noise_durations
    threshold_pos, threshold_neg = real(params.threshold_pos), real(params.threshold_neg)
    law, fixed = given.law
    start_low, start_span = (real(fixed), real(0)) if law == FIXED else (-threshold_neg, threshold_pos + threshold_neg)
    pixels = voxels[0, 0].size
    steps_per_bin = int(given.edges.step[1])
    position, drift = _hot(params, pixels, real)
    return int(
        simulate_pixels(
            np.ascontiguousarray(given.frames).reshape(-1, pixels), _table(given.intensity, real), given.source_index,
            np.array(params.noise_key, np.uint32), _noise_scale(params, durations).astype(real), position, drift,
            durations.astype(real), threshold_pos, threshold_neg,
            real(rounding_tolerance(params.threshold_pos, params.threshold_neg)), start_low, start_span,
            law == TRIANGULAR, steps_per_bin, real(LARGEST_COUNT[given.dtype]), voxels.reshape(-1, pixels),
        )
    )  # fmt: skip


class _General:
    """The general kernel for one clip."""

    def __init__(self, given: KernelInput, real: Real) -> None:
        self._given, self._real, self.timeline = given, real, given.timeline()
        part, params = self.timeline, given.params
        self._pixels = given.frames[0].size
        whole_noise = _noise_scale(params, given.noise_durations)
        rows = np.where(part.level < 0, part.level, given.source_index[np.maximum(part.level, 0)])
        scale = (given.bins - 1) / given.bins
        self._segments = Segments(
            part.step, rows, given.source_index[part.step + 1], part.reached.astype(real), part.bin,
            (whole_noise[part.step] * part.share if len(whole_noise) else whole_noise).astype(real),
            (given.noise_durations[part.step] * part.share).astype(real),
            (part.place[0] * scale).astype(real), (part.place[1] * scale).astype(real),
        )  # fmt: skip
        self._tables = prepare(
            params.effects, params.noise_key, given.intensity or Intensity(1.0, 1.0),
            given.step_seconds[part.step] * part.share, self._pixels, real, _compiled_words,
        )  # fmt: skip

    def run(
        self,
        voxels: npt.NDArray[Any] | None = None,
        counts: npt.NDArray[Any] | None = None,
        bilinear: npt.NDArray[np.float32] | None = None,
        listing: tuple[Longs, Doubles] | None = None,
    ) -> Longs:
        """Write the arrays that are given; return ``Outputs.tally``."""
        given, real, pixels, params = self._given, self._real, self._pixels, self._given.params
        tally = np.zeros(3, np.int64)
        out = Outputs(
            np.empty((0, pixels), given.dtype) if voxels is None else voxels.reshape(-1, pixels),
            np.empty((0, 2, given.bins, pixels), given.dtype)
            if counts is None
            else counts.reshape(-1, 2, given.bins, pixels),
            np.empty((0, pixels), np.float32) if bilinear is None else bilinear.reshape(-1, pixels),
            *(listing or _listing(0)),
            tally,
            listing is not None,
        )
        sigma = params.effects.get("threshold_mismatch_sigma", 0.0)
        smallest, _ = pixel_thresholds(min(params.threshold_pos, params.threshold_neg), 1.0, sigma)
        between = np.empty((0, pixels), np.uint16) if given.levels is None else given.levels.grey
        table = _table(given.intensity, real)
        law, fixed = given.law
        simulate_general(
            np.ascontiguousarray(given.frames).reshape(-1, pixels), between.reshape(-1, pixels),
            table, fine_table(table), np.array(params.noise_key, np.uint32), self._segments,
            *_hot(params, pixels, real), real(params.threshold_pos), real(params.threshold_neg),
            real(rounding_tolerance(smallest, smallest)), law, real(fixed), not params.effects, given.bins,
            real(LARGEST_COUNT[given.dtype]), out, self._tables,
        )  # fmt: skip
        return tally


def _noise_scale(params: SampleParams, durations: Doubles) -> Doubles:
    # Noise of independent increments: its variance, not its deviation, grows with time.
    return params.noise_sigma * np.sqrt(durations) if params.noise_sigma > 0.0 else np.empty(0)


def _hot(params: SampleParams, pixels: int, real: Real) -> tuple[Longs, npt.NDArray[Any]]:
    count = params.hot_pixel_count if params.hot_pixel_sigma > 0.0 else 0
    position, normal = noise.hot_pixels(params.noise_key, count, pixels, _compiled_words)
    return position, normal.astype(real) * real(params.hot_pixel_sigma)


def _table(intensity: Intensity | None, real: Real) -> npt.NDArray[Any]:
    if intensity is None:
        return np.empty(0, real)
    return log_table(*intensity) if real is np.float32 else log_table_float64(*intensity)


def _compiled_words(key: noise.NoiseKey, purpose: int, counters: npt.NDArray[np.int64]) -> npt.NDArray[np.uint32]:
    return words(np.array(key, np.uint32), np.uint32(purpose), counters.astype(np.uint32))  # type: ignore[no-any-return]
