"""Call the kernel that a clip needs, the paper's or the general one; its result, and its display in a notebook."""

from __future__ import annotations

import base64
import math
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import UsageError
from v2v_protocol.events import EventList, check_duration, whole_edges
from v2v_protocol.recipe import Worst, worst_of
from v2v_protocol.sample import ARRAYS, EventShape, SampleParams, html_table
from v2v_protocol.spec import VOXEL_DTYPES
from v2v_server.simulation import effects
from v2v_server.simulation.effects import noise_band
from v2v_server.simulation.effects.kernel import FIXED, ROWS, TRIANGULAR, UNIFORM, Segments, simulate_general
from v2v_server.simulation.intensity import Intensity, fine_table, log_table, log_table_float64
from v2v_server.simulation.pixel import hot_pixels, simulate_pixels
from v2v_server.simulation.precision import Real
from v2v_server.simulation.representations import NAMES, REPRESENTATIONS, fill_array, new_memory
from v2v_server.simulation.representations.listing import Listing, columns_in_order
from v2v_server.simulation.voxel import (
    LARGEST_COUNT,
    Doubles,
    Levels,
    Longs,
    Moments,
    Timeline,
    frame_times,
    new_array,
    rounding_tolerance,
    time_of,
    timeline,
)

_NO_LIST = Listing(np.empty((0, 2), np.int64), *np.empty((2, 0)), *np.empty((2, 0), np.int64))


class Carried(NamedTuple):
    """What pixels remember from one piece of a clip to the next: the pieces have the events of the clip.

    Attributes:
        before, after: [1 + effects.kernel.ROWS, pixels], without effects [1, pixels], of the arithmetic of all pieces:
            the state at the start, and at the end, which is written.
        steps, segments: number of those before the piece.
        resumes: whether the pixels start from ``before``; else as a clip of its own does.
    """

    before: npt.NDArray[Any]
    after: npt.NDArray[Any]
    steps: int = 0
    segments: int = 0
    resumes: bool = False


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
        start: how it is drawn, "uniform" or "triangular", as "frames" is without ``carried``; "zero" starts at 0.
        levels: intermediate levels, or None.
        grids_have_durations: whether a grid's time is that of ``step_seconds``; else all its steps count as equal.
        carried: what a piece of a longer clip starts from and leaves; None: a clip of its own.
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
    carried: Carried | None = None

    def __post_init__(self) -> None:
        if self.dtype not in LARGEST_COUNT:
            raise UsageError(f"voxel dtype {self.dtype!r}: choose one of {', '.join(VOXEL_DTYPES)}")

    @property
    def law(self) -> tuple[int, float]:
        """How residuals start: a constant of ``effects/kernel.py``, and the value of FIXED."""
        if self.start_residual is None and self.start != "zero":
            return (UNIFORM if self.start == "uniform" else TRIANGULAR), 0.0
        return FIXED, self.start_residual or 0.0

    @property
    def needs_general(self) -> bool:
        """Return whether the voxels alone need the general kernel."""
        is_divided = self.grids_have_durations or bool(self.edges.share.any())
        return bool(self.params.effects) or self.levels is not None or is_divided or self.carried is not None

    @property
    def segments(self) -> int:
        """The number of segments, or an upper bound of it where no effect divides them."""
        if self.params.effects.get(noise_band.FIELD):
            return len(self.timeline().step)
        return (
            len(self.noise_durations) + int(np.count_nonzero(self.edges.share))
            + (0 if self.levels is None else len(self.levels.at.step))
        )  # fmt: skip

    @property
    def worst(self) -> Worst:
        """The most that the effects do."""
        drawn = self.params.effects.items()
        return worst_of({name: (value,) for name, value in drawn}, self.segments, math.fsum(self.step_seconds))

    def timeline(self) -> Timeline:
        """Divide the clip into segments."""
        durations = self.step_seconds if self.grids_have_durations else np.ones(len(self.step_seconds))
        given = self.edges, self.bins, durations, None if self.levels is None else self.levels.at
        whole, (share, corner) = timeline(*given), map(self.params.effects.get, (noise_band.FIELD, "noise_band_hz"))
        return timeline(*given, noise_band.moments(whole, self.step_seconds, corner)) if share and corner else whole

    def form(self, name: str) -> tuple[str, tuple[int, ...]]:
        """Return dtype and shape of a representation."""
        height, width = self.frames.shape[1:]
        shape = cast(EventShape, ARRAYS[name].of_events)
        return shape(self.dtype, (len(self.edges.step) - 1) // self.bins, self.bins, height, width)


def fill(
    given: KernelInput, real: Real, out: Mapping[str, npt.NDArray[Any] | None]
) -> tuple[dict[str, Any], dict[str, int]]:
    """Make arrays of a clip.

    Args:
        given: the clip.
        real: arithmetic of the pixels, float32 or float64.
        out: by name (``representations.NAMES``), C-contiguous arrays to write, or None to allocate one.

    Returns:
        the arrays; the number of clipped bins of each.

    Raises:
        UsageError: an array has another form.
    """
    arrays = {name: new_array(*given.form(name), array) for name, array in out.items()}
    if out.keys() == {"voxels"} and not given.needs_general:
        return arrays, {"voxels": _paper(given, real, arrays["voxels"])}
    clipped = _General(given, real).run(arrays) if arrays else {}
    return arrays, {name: clipped[name] for name in arrays}


def new_state(given: KernelInput, real: Real) -> npt.NDArray[Any]:
    """Return memory for the state of one side of :class:`Carried`, [1 + ROWS, pixels], or [1, pixels]."""
    return np.empty((1 + ROWS if given.params.effects else 1, given.frames[0].size), real)


def following(given: KernelInput, before: KernelInput, real: Real) -> KernelInput:
    """Return a clip whose pixels start from what another one, whose last frame is its first, leaves."""
    left = new_state(given, real)
    _General(replace(before, carried=Carried(left[:0], left)), real).run({})
    return replace(given, carried=Carried(left, left[:0], len(before.step_seconds), before.segments, True))


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
    since_us = frame_times(step_us)
    count, _ = list_piece(given, real, step_us, since_us, np.empty((1, 2), np.int64))
    return list_piece(given, real, step_us, since_us, np.empty((count, 2), np.int64))[1]


def list_piece(
    given: KernelInput, real: Real, step_us: Doubles, since_us: Doubles, rows: Longs
) -> tuple[int, EventList]:
    """List the events of a piece of a clip, see :func:`list_events`.

    Args:
        given, real, step_us: see :func:`list_events`.
        since_us: [steps + 1] time of each frame, microseconds, at least 0.
        rows: [capacity, 2] int64, memory for the events.

    Returns:
        the number of events, and the events; not all of them if there are more than ``rows`` can hold.
    """
    general = _General(given, real)
    part, first_us = general.timeline, whole_edges(time_of(given.edges, step_us, since_us))
    listing = Listing(
        rows, time_of(Moments(part.step, part.start), step_us, since_us), part.share * step_us[part.step],
        first_us[part.bin], first_us[part.bin + 1] - 1,
    )  # fmt: skip
    count = general.run({}, listing)["listing"]
    _, height, width = given.frames.shape
    return count, EventList(*columns_in_order(rows[:count], width), width, height)


@dataclass(frozen=True, slots=True, repr=False, eq=False)
class Voxels:
    """Result of a simulation; ``voxels, saturated_bins = simulate(...)`` unpacks it.

    Attributes:
        voxels: [T, bins, H, W] signed event counts.
        saturated_bins: number of bins that were clipped to the range of the dtype.
        saturated: the same for every array that was made, by name.
        given: the inputs, and ``real``, the arithmetic: the other arrays and events are simulated from them on demand.
    """

    voxels: npt.NDArray[Any]
    saturated_bins: int
    saturated: Mapping[str, int]
    given: KernelInput
    real: Real

    @classmethod
    def of(cls, given: KernelInput, real: Real, out: Mapping[str, npt.NDArray[Any]] | None = None) -> Voxels:
        """Simulate a clip: fill the arrays of ``out``, or make the voxels.

        Raises:
            UsageError: an array of ``out`` has another form than ``KernelInput.form`` states.
        """
        arrays, saturated = fill(given, real, {"voxels": None} if out is None else out)
        return cls(arrays.get("voxels", np.empty(0)), saturated.get("voxels", 0), saturated, given, real)

    def __iter__(self) -> Iterator[Any]:
        return iter((self.voxels, self.saturated_bins))

    def array(self, name: str) -> npt.NDArray[Any]:
        """Simulate another array of the same clip.

        Args:
            name: "event_counts", [T, 2, bins, H, W]: negative (0) and positive (1) counts; "voxels_bilinear",
                [T, bins, H, W]: each event is shared between the two bins next to its time; or "time_surface",
                [T, 2, bins, H, W]: age of the last event of each polarity, s (in frames without
                ``frames_per_second``), infinity before the first.

        Raises:
            UsageError: there is no such array.
        """
        if name not in NAMES:
            raise UsageError(f"array {name!r}: choose one of {', '.join(NAMES)}")
        return cast("npt.NDArray[Any]", fill(self.given, self.real, {name: None})[0][name])

    def to_events(self, bin_us: float) -> EventList:
        """List the events (x, y, t, p) that the voxels count, with their times, for bins of ``bin_us`` microseconds.

        Raises:
            UsageError: the duration is out of range.
        """
        steps = len(self.given.step_seconds)
        return list_events(self.given, self.real, np.full(steps, bin_us * (len(self.given.edges.step) - 1) / steps))

    def show(self, path: str | os.PathLike[str] | None = None) -> Any:
        """Draw up to four voxel grids, bin by bin, as a picture that a notebook displays.

        Args:
            path: also write the picture to this PNG file; None writes no file.

        Returns:
            A PIL image.

        Raises:
            UsageError: the file cannot be written.
        """
        from PIL import Image

        from v2v_pictures.files import write_png

        image = self._picture()
        if path is not None:
            write_png(Path(path), image)
        return Image.fromarray(image)

    def __repr__(self) -> str:
        return f"Voxels({self.voxels.dtype}{list(self.voxels.shape)}, {self.saturated_bins} bins saturated)"

    def _picture(self) -> Any:
        from v2v_pictures.grids import draw_grids  # drawing is for people: a worker never loads it

        return draw_grids(self.voxels)

    def _repr_png_(self) -> bytes:
        from v2v_pictures.files import png_bytes

        return png_bytes(self._picture())

    def _repr_html_(self) -> str:
        shape = f"{self.voxels.dtype} {list(self.voxels.shape)}"
        table = html_table("Voxels", {"voxels": shape, "saturated_bins": self.saturated_bins})
        return f'{table}<img src="data:image/png;base64,{base64.b64encode(self._repr_png_()).decode()}">'


def _paper(given: KernelInput, real: Real, voxels: npt.NDArray[Any]) -> int:
    params, durations = given.params, given.noise_durations
    threshold_pos, threshold_neg = real(params.threshold_pos), real(params.threshold_neg)
    law, fixed = given.law
    start_low, start_span = (real(fixed), real(0)) if law == FIXED else (-threshold_neg, threshold_pos + threshold_neg)
    tolerance = real(rounding_tolerance(params.threshold_pos, params.threshold_neg))
    pixels, steps_per_bin = voxels[0, 0].size, int(given.edges.step[1])
    position, drift = _hot(params, pixels, real)
    return int(
        simulate_pixels(
            np.ascontiguousarray(given.frames).reshape(-1, pixels), _table(given.intensity, real), given.source_index,
            np.array(params.noise_key, np.uint32), _noise_scale(params, durations).astype(real), position, drift,
            durations.astype(real), threshold_pos, threshold_neg, tolerance, start_low, start_span,
            law == TRIANGULAR, steps_per_bin, real(LARGEST_COUNT[given.dtype]), voxels.reshape(-1, pixels),
        )
    )  # fmt: skip


class _General:
    """The general kernel for one clip."""

    def __init__(self, given: KernelInput, real: Real) -> None:
        self._given, self._real, self.timeline = given, real, given.timeline()
        part, params = self.timeline, given.params
        self._pixels = given.frames[0].size
        nothing = np.empty((0, self._pixels), real)
        self._carried = carried = given.carried or Carried(nothing, nothing)
        whole_noise = _noise_scale(params, given.noise_durations)
        rows = np.where(part.level < 0, part.level, given.source_index[np.maximum(part.level, 0)])
        self._segments = Segments(
            part.step + carried.steps, rows, given.source_index[part.step + 1], part.reached.astype(real), part.bin,
            (whole_noise[part.step] * part.share if len(whole_noise) else whole_noise).astype(real),
            (given.noise_durations[part.step] * part.share).astype(real),
            np.int64(carried.segments), carried.resumes,
        )  # fmt: skip
        self._tables = effects.prepare(
            params.effects, params.noise_key, given.intensity or Intensity(1.0, 1.0),
            given.step_seconds[part.step] * part.share, self._pixels, real,
            (params.threshold_pos, params.threshold_neg), carried.segments,
        )  # fmt: skip

    def run(self, arrays: Mapping[str, npt.NDArray[Any]], listing: Listing = _NO_LIST) -> dict[str, int]:
        """Fill arrays, by name, and the listing if it has rows; return how many values of each did not fit its dtype,
        and the number of events that were to be listed.
        """
        given, real, pixels, params = self._given, self._real, self._pixels, self._given.params
        none = {name: np.empty((0, *shape[1:]), dtype) for name in NAMES for dtype, shape in (given.form(name),)}
        memory = {name: new_memory(name, array) for name, array in (none | dict(arrays)).items()}
        made = tuple(
            each.prepare(own, given, self.timeline, real) if hasattr(each, "prepare") else own
            for each, own in zip(REPRESENTATIONS.values(), (*memory.values(), listing), strict=True)
        )
        clipped = np.zeros(len(made), np.int64)
        smallest = min(params.threshold_pos, params.threshold_neg) * given.worst.smallest
        between = np.empty((0, pixels), np.uint16) if given.levels is None else given.levels.grey
        table = _table(given.intensity, real)
        law, fixed = given.law
        simulate_general(
            np.ascontiguousarray(given.frames).reshape(-1, pixels), between.reshape(-1, pixels),
            table, fine_table(table), np.array(params.noise_key, np.uint32), self._segments,
            *_hot(params, pixels, real), real(params.threshold_pos), real(params.threshold_neg),
            real(rounding_tolerance(smallest, smallest)), law, real(fixed), not params.effects,
            len(listing.rows) > 0 or any(hasattr(REPRESENTATIONS[name], "events") for name in arrays),
            not params.effects and arrays.keys() == {"voxels"}, given.bins, real(LARGEST_COUNT[given.dtype]), made,
            clipped, self._tables, self._carried.before, self._carried.after,
        )  # fmt: skip
        counts: dict[str, int] = dict(zip(REPRESENTATIONS, clipped.tolist(), strict=True))
        return counts | {name: counts[name] + fill_array(array, memory[name]) for name, array in arrays.items()}


def _noise_scale(params: SampleParams, durations: Doubles) -> Doubles:
    # Noise of independent increments: its variance, not its deviation, grows with time.
    return params.noise_sigma * np.sqrt(durations) if params.noise_sigma > 0.0 else np.empty(0)


def _hot(params: SampleParams, pixels: int, real: Real) -> tuple[Longs, npt.NDArray[Any]]:
    count = params.hot_pixel_count if params.hot_pixel_sigma > 0.0 else 0
    position, normal = hot_pixels(params.noise_key, count, pixels)
    return position, normal.astype(real) * real(params.hot_pixel_sigma)


def _table(intensity: Intensity | None, real: Real) -> npt.NDArray[Any]:
    if intensity is None:
        return np.empty(0, real)
    return log_table(*intensity) if real is np.float32 else log_table_float64(*intensity)
