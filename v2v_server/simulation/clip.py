"""Simulate a clip: check arguments, turn frames of any usual kind to grey levels, call the kernel."""

from __future__ import annotations

import dataclasses
import inspect
import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import UsageError
from v2v_protocol.recipe import FRAMES, STARTS, TIME_UNITS, Recipe, effect_settings, most_events, warn_unusual
from v2v_protocol.sample import SampleParams, needs_of
from v2v_protocol.settings import nearest, plain, require_known
from v2v_server.simulation.draw import noise_key_of_seed
from v2v_server.simulation.intensity import Intensity, log_table_float64
from v2v_server.simulation.kernels import KernelInput, Voxels, following
from v2v_server.simulation.precision import AUTO, EFFECTS_MARGIN, check_thresholds, choose, noise_sum
from v2v_server.simulation.voxel import Levels, bin_edges, timed_edges
from v2v_server.video.picture import SDR, TRANSFERS, Signal


class RunIn(NamedTuple):
    """Frames before a clip, which are simulated and thrown away.

    Attributes:
        frames: [n + 1, H, W], they and the first of the clip, as those of the clip.
        step_seconds: [n] duration of each step; None where the clip has none.
    """

    frames: npt.NDArray[Any]
    step_seconds: npt.NDArray[np.float64] | None


_WEIGHTS = (299, 587, 114)
"""Weights of red, green and blue in grey (ITU-R BT.601), thousandths."""


def simulate(
    frames: Any,
    *,
    threshold_pos: float,
    threshold_neg: float | None = None,
    noise_sigma: float = 0.0,
    hot_pixel_count: int = 0,
    hot_pixel_sigma: float = 0.0,
    start_residual: float | None = None,
    bins: int = 5,
    frames_per_bin: int = 1,
    grids_per_frame: int = 0,
    gamma: float = 2.2,
    log_eps: float = 1e-3,
    seed: int = 0,
    dtype: str = "int8",
    precision: str = AUTO,
    frames_per_second: float | None = None,
    bits: int = 8,
    transfer: str = "",
    start: str = "uniform",
    **effects: float,
) -> Voxels:
    """Simulate an event camera that watches a clip.

    Args:
        frames: a numpy array or a torch tensor; [n, H, W] uint8 grey levels, or a form that :func:`grey_levels`
            converts: colour (RGB), floating point in 0 .. 1. n - 1 is a multiple of ``bins * frames_per_bin``, without
            ``grids_per_frame``.
        threshold_pos: contrast threshold of brighter events, log-intensity units.
        threshold_neg: contrast threshold of darker events; None: the same.
        noise_sigma: standard deviation of the noise, log units per frame.
        hot_pixel_count: number of pixels that drift.
        hot_pixel_sigma: standard deviation of their drift, log units per frame.
        start_residual: every pixel's residual before the first step, log units; None draws it as ``start`` says.
        bins: bins of a voxel grid.
        frames_per_bin: steps between frames in one bin.
        grids_per_frame: voxel grids in one step between frames; 0: a grid spans ``bins * frames_per_bin`` steps.
        gamma: exponent of the reverse gamma correction (``intensity.py``).
        log_eps: epsilon inside the logarithm, as a share of white.
        seed: 0 .. 2**64 - 1; the same seed gives the same bytes.
        dtype: "int8", "int16" or "float32".
        precision: arithmetic of the pixels: "float32", "float64", or "auto" for the narrowest that keeps the error
            below half a threshold (``precision.py``).
        frames_per_second: frame rate of the frames; needed for an effect in Hz or seconds.
        bits: 9 to 16 for frames of uint16 [n, H, W] with levels 0 .. 2**bits - 1.
        transfer: "pq", "hlg", "log100", "log316" or "linear" (``intensity.py``); "" uses gamma.
        start: "uniform" draws the residuals between -threshold_neg and threshold_pos, as the paper's code does,
            "triangular" as in a camera that has run for a long time; "zero" starts them at 0.
        effects: values of effects beyond the paper's model, by the recipe's names (``leak_hz=0.1``); zero is off.

    Returns:
        voxels [(n - 1) / (bins * frames_per_bin), bins, H, W], or [(n - 1) * grids_per_frame, bins, H, W], and the
        number of saturated bins. A numpy array, whatever the frames are; ``torch.from_numpy`` shares its memory. The
        other arrays, and events with times, are simulated when they are asked for (:class:`Voxels`), so do not change
        the frames before.

    Raises:
        UsageError: an argument of the wrong type, shape or range, or more events than the precision can count.
    """
    signal = Signal(bits, transfer)
    frames = grey_levels(frames, signal)
    _check_number("gamma", gamma, positive=True)
    _check_number("log_eps", log_eps, positive=True)
    known = effect_settings()
    arguments = [name for name in inspect.signature(simulate).parameters if name != "effects"]
    for name in effects.keys() - known.keys():
        close = nearest(name, [*arguments, *known])
        if any(repr(argument) in close for argument in arguments):
            raise UsageError(f"no argument {name!r}{close}")
    require_known(effects, known, "effect")
    effects = {name: value for name in effects if (value := known[name].single.check(name, effects[name]))}
    if frames_per_second is not None:
        _check_number("frames_per_second", frames_per_second, positive=True)
    elif any(known[name].unit in TIME_UNITS for name in effects):
        raise UsageError("frames_per_second is missing: effects in Hz or seconds need the time between frames")
    return _simulate_array(
        frames, Intensity(gamma, log_eps, signal), threshold_pos, threshold_neg, noise_sigma, hot_pixel_count,
        hot_pixel_sigma, start_residual, bins, frames_per_bin, seed, dtype, precision, grids_per_frame, effects,
        1.0 / (frames_per_second or 1.0), start,
    )  # fmt: skip


def simulate_log(
    log_frames: npt.NDArray[np.floating[Any]],
    *,
    threshold_pos: float,
    threshold_neg: float | None = None,
    noise_sigma: float = 0.0,
    hot_pixel_count: int = 0,
    hot_pixel_sigma: float = 0.0,
    start_residual: float | None = None,
    bins: int = 5,
    frames_per_bin: int = 1,
    grids_per_frame: int = 0,
    seed: int = 0,
    dtype: str = "int8",
    precision: str = AUTO,
    start: str = "uniform",
) -> Voxels:
    """Simulate an event camera from log intensities.

    Args:
        log_frames: [n, H, W] floating point, natural log of intensity; rounded to ``precision`` first.

    Other arguments and the result are those of :func:`simulate`. There are no effects beyond the paper's model: some
    depend on the brightness of a pixel relative to white, which a logarithm of unknown scale does not give.

    Raises:
        UsageError: see :func:`simulate`.
    """
    log_frames = np.asarray(log_frames)
    if log_frames.ndim != 3 or log_frames.dtype.kind != "f":
        raise UsageError(f"log_frames {log_frames.dtype}{list(log_frames.shape)}: give floating point [n, H, W]")
    if not np.isfinite(log_frames).all():
        raise UsageError("log_frames: a value is NaN or infinite; give the logarithm of positive intensities")
    return _simulate_array(
        log_frames, None, threshold_pos, threshold_neg, noise_sigma, hot_pixel_count, hot_pixel_sigma,
        start_residual, bins, frames_per_bin, seed, dtype, precision, grids_per_frame, start=start,
    )  # fmt: skip


def simulate_clip(
    frames: npt.NDArray[Any],
    params: SampleParams,
    recipe: Recipe,
    voxel_dtype: str,
    step_seconds: npt.NDArray[np.float64] | None = None,
    out: Mapping[str, npt.NDArray[Any]] | None = None,
    levels: Levels | None = None,
    signal: Signal = SDR,
    run_in: RunIn | None = None,
) -> Voxels:
    """Simulate one drawn sample.

    Args:
        frames: [n, H, W] of the signal's dtype, the decoded frames after ``apply_view``; n is at least the number of
            different frames the clip shows.
        params, recipe: the draw and its recipe.
        voxel_dtype: "int8", "int16" or "float32".
        step_seconds: [steps] duration of each step (``voxel.py``); needed if the recipe or an array of ``out`` needs
            seconds.
        out: C-contiguous arrays to fill, by name (``representations.NAMES``); None makes the voxels.
        levels: levels between frames; None: log intensity is linear in time there.
        signal: what the levels mean.
        run_in: frames that the pixels start from, used if the recipe asks for them; None: they start by the
            triangular law.

    Returns:
        voxels [recipe.voxel_grids, bins, H, W], and the number of saturated bins.

    Raises:
        UsageError: too few frames, ``step_seconds`` missing or of the wrong length, or a draw beyond what
            float64 can count (``precision.py``).
    """
    ends = params.ends(recipe)
    steps = int(ends[-1])
    source_index = params.source_index(steps)
    if frames.ndim != 3 or frames.dtype != signal.dtype or len(frames) <= source_index[-1]:
        raise UsageError(
            f"frames {frames.dtype}{list(frames.shape)}: this draw shows {source_index[-1] + 1} frames, "
            f"{signal.dtype} [n, H, W]"
        )
    if step_seconds is None and (recipe.needs_seconds or needs_of(out or ()).seconds):
        raise UsageError(
            f"step_seconds is missing: noise_unit is {recipe.noise_unit!r}, voxel_seconds is "
            f"{recipe.voxel_seconds[1]:g}, there {'is an' if recipe.timed_effects else 'is no'} effect in Hz or "
            f"seconds, and the arrays are {', '.join(out or ('voxels',))}"
        )
    if step_seconds is None:
        step_seconds = np.ones(steps)
    elif step_seconds.shape != (steps,) or not (np.isfinite(step_seconds) & (step_seconds > 0)).all():
        raise UsageError(
            f"step_seconds {list(step_seconds.shape)}: give {steps} positive finite durations, one per step"
        )
    check_thresholds(params.threshold_pos, params.threshold_neg)
    intensity = intensity_of(params, recipe, signal)
    edges = (
        timed_edges(ends, recipe.bins, step_seconds)
        if recipe.is_timed
        else bin_edges(steps, recipe.frames_per_bin, recipe.grids_per_frame * recipe.bins or 1)
    )
    given = KernelInput(
        frames, intensity, source_index, params,
        step_seconds if recipe.noise_unit == "second" else np.ones(steps), step_seconds, recipe.bins, edges,
        voxel_dtype, levels=levels, grids_have_durations=recipe.is_timed, start=recipe.start,
    )  # fmt: skip
    if run_in is None or recipe.start != FRAMES:
        return Voxels.of(given, choose(AUTO, _most_events(given, _log_ends(intensity))), out)
    earlier = len(run_in.frames) - 1
    lasting = np.ones(earlier) if run_in.step_seconds is None else run_in.step_seconds
    before = dataclasses.replace(
        given, frames=run_in.frames, source_index=np.arange(earlier + 1), step_seconds=lasting, bins=1, levels=None,
        noise_durations=lasting if recipe.noise_unit == "second" else np.ones(earlier),
        edges=bin_edges(earlier, earlier), grids_have_durations=False,
    )  # fmt: skip
    both = dataclasses.replace(
        given, noise_durations=np.concatenate((before.noise_durations, given.noise_durations)),
        step_seconds=np.concatenate((lasting, step_seconds)),
    )  # fmt: skip
    real = choose(AUTO, _most_events(both, _log_ends(intensity)))
    return Voxels.of(following(given, before, real), real, out)


def _simulate_array(
    frames: npt.NDArray[Any],
    intensity: Intensity | None,
    threshold_pos: float,
    threshold_neg: float | None,
    noise_sigma: float,
    hot_pixel_count: int,
    hot_pixel_sigma: float,
    start_residual: float | None,
    bins: int,
    frames_per_bin: int,
    seed: int,
    dtype: str,
    precision: str,
    grids_per_frame: int,
    effects: Mapping[str, float] = MappingProxyType({}),
    frame_seconds: float = 1.0,
    start: str = "uniform",
) -> Voxels:
    """Simulate an array. ``intensity`` None: the frames are log intensities, and there are no effects."""
    threshold_neg = threshold_pos if threshold_neg is None else threshold_neg
    _check_number("threshold_pos", threshold_pos, positive=True)
    _check_number("threshold_neg", threshold_neg, positive=True)
    check_thresholds(threshold_pos, threshold_neg)
    _check_number("noise_sigma", noise_sigma)
    _check_number("hot_pixel_sigma", hot_pixel_sigma)
    if start not in STARTS:
        raise UsageError(f"start = {start!r}: choose one of {', '.join(STARTS)}")
    if start_residual is not None and not -threshold_neg <= start_residual <= threshold_pos:
        raise UsageError(
            f"start_residual = {start_residual!r}: give a value from -threshold_neg to threshold_pos, "
            f"{-threshold_neg} to {threshold_pos}"
        )
    _check_whole("bins", bins, 1, 2**31)
    _check_whole("frames_per_bin", frames_per_bin, 1, 2**31)
    _check_whole("grids_per_frame", grids_per_frame, 0, 2**31)
    if grids_per_frame and frames_per_bin != 1:
        raise UsageError(
            f"frames_per_bin = {frames_per_bin}: with grids_per_frame, bins are parts of a step; set it to 1"
        )
    _check_whole("seed", seed, 0, 2**64 - 1)
    count, height, width = frames.shape
    _check_whole("hot_pixel_count", hot_pixel_count, 0, height * width)
    steps, span = count - 1, 1 if grids_per_frame else bins * frames_per_bin
    if height * width == 0 or count < 2 or steps % span:
        needed = f"k x bins x frames_per_bin + 1 frames, k > 0 (k x {span} + 1)"
        raise UsageError(
            f"{count} frames of {width}x{height} pixels: give {'2 frames or more' if grids_per_frame else needed}, "
            "of at least one pixel"
        )
    params = SampleParams(
        threshold_pos, threshold_neg, noise_sigma, hot_pixel_count, hot_pixel_sigma, pauses=(), scale=1.0,
        crop_top_px=0, crop_left_px=0, flip=False, contrast=0.0, noise_key=noise_key_of_seed(seed),
        effects=dict(effects),
    )  # fmt: skip
    ends = (float(frames.min()), float(frames.max())) if intensity is None else _log_ends(intensity)
    edges = bin_edges(steps, frames_per_bin, grids_per_frame * bins or 1)
    durations = np.ones(steps)
    given = KernelInput(
        frames, intensity, np.arange(count), params, durations, durations * frame_seconds, bins, edges, dtype,
        start_residual, start=start,
    )  # fmt: skip
    real = choose(precision, _most_events(given, ends))
    camera = {"threshold_pos": threshold_pos, "noise_sigma": noise_sigma, "hot_pixel_sigma": hot_pixel_sigma, **effects}
    other = {} if threshold_neg == threshold_pos else {"threshold_neg": threshold_neg}
    of_light = {} if intensity is None else {"gamma": intensity.gamma, "log_eps": intensity.log_eps}
    warn_unusual("", camera | other | of_light)
    if intensity is None:
        given = dataclasses.replace(given, frames=frames.astype(real))
    return Voxels.of(given, real)


def intensity_of(params: SampleParams, recipe: Recipe, signal: Signal = SDR) -> Intensity:
    """Return what determines the log intensity of a sample's grey levels."""
    return Intensity(recipe.gamma, recipe.log_eps[0] if params.log_eps is None else params.log_eps, signal)


def grey_levels(frames: Any, signal: Signal = SDR) -> npt.NDArray[Any]:
    """Return the grey levels of a clip: 0 .. 255, apart from a signal of more than 8 bits.

    Grey is 0.299 red + 0.587 green + 0.114 blue. Floating point means 0 for black and 1 for white; the result is
    rounded to the nearest of 256 levels (use ``simulate_log`` to avoid the rounding).

    Args:
        frames: a numpy array or a torch tensor in main memory; uint8, or floating point in 0 .. 1; [n, H, W], colour
            (RGB) as [n, H, W, 3] or [n, 3, H, W], one channel as [n, H, W, 1] or [n, 1, H, W]. If both ends could be
            channels, the last one is.
        signal: what the levels mean. With more than 8 bits, frames are uint16 [n, H, W] and returned as they are.

    Returns:
        uint8 [n, H, W]; grey uint8 is returned without a copy.

    Raises:
        UsageError: another type, shape or range, or an unknown signal.
    """
    if signal.transfer not in ("", *TRANSFERS.values()):
        raise UsageError(f"transfer {signal.transfer!r}: choose one of {', '.join(TRANSFERS.values())}, or ''")
    if signal.bits not in range(8, 17):
        raise UsageError(f"bits = {signal.bits!r}: give a whole number from 8 to 16")
    try:
        given = np.asarray(frames)
    except (TypeError, RuntimeError) as error:  # raised by torch for a tensor on a GPU or one that requires gradients
        raise UsageError(f"frames: {error}") from error
    if signal.bits > 8:
        if given.ndim != 3 or given.dtype != np.uint16 or given.max(initial=0) > signal.white:
            raise UsageError(
                f"frames {given.dtype}{list(given.shape)}, levels up to {given.max(initial=0)}: with bits = "
                f"{signal.bits}, give uint16 [n, H, W] of levels up to {signal.white}"
            )
        return given
    if given.ndim == 4 and given.shape[-1] not in (1, 3):
        given = np.moveaxis(given, 1, -1)
    fits = given.ndim == 3 or (given.ndim == 4 and given.shape[-1] in (1, 3))
    if not fits or (given.dtype != np.uint8 and given.dtype.kind != "f"):
        shape = list(np.shape(frames))
        raise UsageError(f"frames {given.dtype}{shape}: give uint8 or floating point [n, H, W], or colour [n, H, W, 3]")
    if given.ndim == 4 and given.shape[-1] == 1:
        given = given[..., 0]
    if given.ndim == 3 and given.dtype == np.uint8:
        return given
    grey = np.empty(given.shape[:3], np.uint8)
    for frame, out in zip(given, grey, strict=True):  # one at a time: the intermediate arrays are eight times as large
        out[:] = _grey(frame)
    return grey


def _grey(frame: npt.NDArray[Any]) -> npt.NDArray[Any]:
    red, green, blue = _WEIGHTS
    if frame.dtype == np.uint8:
        wide = frame.astype(np.int32)
        return (red * wide[..., 0] + green * wide[..., 1] + blue * wide[..., 2] + 500) // 1000
    if not ((frame >= 0) & (frame <= 1)).all():
        raise UsageError("frames: a value is NaN or outside 0 .. 1; floating point means 0 for black and 1 for white")
    value = frame.astype(np.float64)
    if value.ndim == 3:
        value = (red * value[..., 0] + green * value[..., 1] + blue * value[..., 2]) / 1000
    return np.rint(value * 255)


def _most_events(given: KernelInput, log_ends: tuple[float, float]) -> float:
    params = given.params
    hot_sigma = params.hot_pixel_sigma if params.hot_pixel_count else 0.0
    noise_total = noise_sum(params.noise_sigma, hot_sigma, given.noise_durations)
    return (EFFECTS_MARGIN if params.effects else 1.0) * most_events(
        given.segments, log_ends, (params.threshold_pos, params.threshold_neg), noise_total, *given.worst
    )


def _log_ends(intensity: Intensity) -> tuple[float, float]:
    # From the table, not from a maths library: the choice of arithmetic must not depend on the host.
    table = log_table_float64(*intensity)
    return float(table[0]), float(table[-1])


def _check_number(name: str, value: float, *, positive: bool = False) -> None:
    number = isinstance(plain(value), int | float) and not isinstance(plain(value), bool)
    if not number or not math.isfinite(value) or value < 0 or (positive and value == 0):
        raise UsageError(f"{name} = {value!r}: give a finite number {'above' if positive else 'of at least'} 0")


def _check_whole(name: str, value: int, low: int, high: int) -> None:
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or not low <= value <= high:
        raise UsageError(f"{name} = {value!r}: give a whole number from {low} to {high}")
