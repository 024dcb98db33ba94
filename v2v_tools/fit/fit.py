"""Fit a camera to a recording: estimate, match with the kernel, and keep the effects that the intervals show."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import UsageError
from v2v_recordings.items import ConvertOptions, Light, ReadProgress
from v2v_tools.fit import estimators, regression
from v2v_tools.fit.increments import increments_of, intervals_us, is_still, still_time
from v2v_tools.fit.interval import Doubles, Estimate, bootstrap, sums_by_block, unknown
from v2v_tools.fit.recording import Recorded, read_recording
from v2v_tools.fit.statistics import Panels, panels_of, simulate_recording

LEAST_FRAMES = 3
USUAL_THRESHOLD = 0.2
"""Stands in where thresholds cannot be told."""
_LEAKS_HZ = np.array([0.0, 0.03, 0.06, 0.12, 0.25, 0.5, 1.0, 2.0, 4.0])
_GREY_OF_STATIC = 136
"""Grey level of a quarter of white's light: a static scene without frames."""
_STATIC_LIGHT_DOUBT = 0.3
_BLOCKS_SIDE = 8


@dataclass(frozen=True, eq=False)
class FittedCamera:
    """A camera fitted to a recording.

    Attributes:
        estimates: by the recipe's names, and ``threshold_pos``, ``threshold_neg``.
        left_out: why an effect is not in the recipe, by name.
        measured, simulated: statistics of the recording and of its simulation; None without frames.
        facts: what was read: events, pixels, seconds, frames, and the shares of brighter events.
        light: of the frames.
        offset: how much later than their times the frames were seen, s.
        applied_seconds: what was added to their times.
        notes: what the reader says about the recording.
    """

    estimates: Mapping[str, Estimate]
    left_out: Mapping[str, str]
    measured: Panels
    simulated: Panels | None
    facts: Mapping[str, float]
    light: Light
    offset: Estimate
    applied_seconds: float = 0.0
    notes: tuple[str, ...] = ()

    @property
    def camera(self) -> dict[str, float]:
        """Values of the parameters in use: told, and not left out."""
        return _values({name: made for name, made in self.estimates.items() if name not in self.left_out})


def fit(
    recording: str | Path | Recorded,
    *,
    static: bool = False,
    shift: bool = False,
    options: ConvertOptions | None = None,
    progress: ReadProgress = lambda _done, _total: None,
) -> FittedCamera:
    """Fit a camera to a recording of events, with or without frames.

    Args:
        recording: a file or folder of any form that ``v2v-convert`` reads; or what was read already.
        static: neither the scene nor the camera moved, so all events are noise.
        shift: add the estimated offset to the times of the frames.
        options: what the recording lacks, such as the size of its sensor.

    Raises:
        UsageError: the recording cannot be read, or has no events.
    """
    given = recording if isinstance(recording, Recorded) else read_recording(recording, options, progress)
    has_frames = len(given.frames) >= LEAST_FRAMES
    if not has_frames:
        # That of frames that are made up.
        given = dataclasses.replace(given, light=given.light or Light.parse("2.2"))
    offset = estimators.frame_offset(given) if has_frames else unknown("there are no frames")
    applied_seconds = (options or ConvertOptions()).frame_offset_ns * 1e-9
    if shift:
        if not math.isfinite(offset.value):
            raise UsageError(
                f"the recording cannot tell the offset of its frames: {offset.note}; leave --shift-frames out"
            )
        given = dataclasses.replace(given, frame_us=given.frame_us + round(1e6 * offset.value))
        applied_seconds += offset.value
    if static and not has_frames:
        given = _with_constant_frames(given)
    estimates = _estimates(given, static and not has_frames, static)
    light = given.known_light.of(np.arange(256.0))
    begin, end = _span(given)
    measured = panels_of(given, light, begin, end)
    left_out = {
        name: f"at most {made.high:.3g}, too little to matter" if made.told else made.note
        for name, made in estimates.items()
        if made.is_absent or not made.told
    }
    simulated = None
    if len(given.frames) >= LEAST_FRAMES and ("threshold_pos" in _values(estimates) or static):
        used = _values({name: made for name, made in estimates.items() if name not in left_out})
        simulated = panels_of(simulate_recording(given, _complete(used), 2, "triangular"), light, begin, end)
    facts = {
        "events": float(given.counts.sum()), "pixels": float(len(given.pixels)), "seconds": given.seconds,
        "frames": float(len(given.frames) if has_frames else 0),
        "on_share": float(given.counts[1].sum() / max(given.counts.sum(), 1)),
    }  # fmt: skip
    return FittedCamera(
        estimates, left_out, measured, simulated, facts, given.known_light, offset, applied_seconds, given.notes
    )


def _estimates(given: Recorded, is_blank: bool, static: bool = False) -> dict[str, Estimate]:
    """Estimate all parameters. ``is_blank``: the frames are made up, of one grey level. ``static``: see :func:`fit`."""
    blocks, light = given.blocks(_BLOCKS_SIDE), given.known_light.of(np.arange(256.0))
    period = estimators.refractory(intervals_us(given))
    has_frames = len(given.frames) >= LEAST_FRAMES
    longest_us = float(np.median(np.diff(given.frame_us))) if has_frames else 0.0
    if has_frames and not period.told and math.isfinite(period.high) and not is_blank:
        period = regression.refractory_by_change(given, blocks, period, longest_us)
    made = {"refractory_seconds": period}
    if not has_frames:
        note = f"needs at least {LEAST_FRAMES} frames"
        names = ("threshold_pos", "threshold_neg", "log_eps", "threshold_mismatch_sigma", "photoreceptor_hz")
        noise = "shot_noise_hz", "leak_hz", "hot_pixel_share", "hot_pixel_sigma"
        made |= {name: unknown(note) for name in names}
        made |= {name: unknown(f"{note}, or a static scene (--static)") for name in noise}
        return made | {"dead_pixel_share": estimators.dead_pixels(given, blocks)}
    refractory_seconds = period.value if period.told else 0.0
    at_rest = is_still(given)
    still = still_time(given, at_rest, light)
    is_hot = estimators.hot_mask(still)
    increments = increments_of(given, refractory_seconds, longest_us)
    usual = ~is_hot[increments.pixel]
    increments = increments.take(usual)
    fitted = regression.Regression(increments, blocks)
    made["threshold_pos"], made["threshold_neg"] = fitted.positive, fitted.negative
    made["log_eps"] = fitted.log_eps
    made["threshold_mismatch_sigma"] = estimators.mismatch(fitted, increments, blocks)
    made["photoreceptor_hz"] = fitted.corner if made["threshold_pos"].told else unknown("needs the thresholds")
    shot, surplus = estimators.noise_rates(still, blocks, is_hot, static)
    if is_blank and shot.told:
        shot = dataclasses.replace(
            shot.moved(shot.value, _STATIC_LIGHT_DOUBT * shot.value),
            note=f"{shot.note}; without frames, for a mean light of 5 to 60 % of white's",
        )
    made["shot_noise_hz"] = shot
    values = _complete(_values(made))
    thresholds = values["threshold_pos"], values["threshold_neg"]
    made["hot_pixel_share"], made["hot_pixel_sigma"] = estimators.hot_pixels(
        still, is_hot, thresholds, refractory_seconds, blocks
    )
    if not any(made[name].told for name in ("threshold_pos", "threshold_neg")) and made["hot_pixel_sigma"].told:
        note = f"{made['hot_pixel_sigma'].note}; in units of a threshold of {USUAL_THRESHOLD}"
        made["hot_pixel_sigma"] = dataclasses.replace(made["hot_pixel_sigma"], note=note)
    made["dead_pixel_share"] = estimators.dead_pixels(given, blocks)
    made["leak_hz"] = _matched_leak(given, values, surplus, blocks, at_rest, is_hot)
    return {name: dataclasses.replace(one, low=0.0) if one.is_absent else one for name, one in made.items()}


def _matched_leak(
    given: Recorded, camera: dict[str, float], surplus: Estimate, blocks: npt.NDArray[np.int64],
    at_rest: npt.NDArray[np.bool_], is_hot: npt.NDArray[np.bool_],
) -> Estimate:
    """Find the leak with which the simulation has the surplus of brighter events that was measured.

    Noise resets a pixel before its leak crosses the threshold, and the motion before a still stretch leaves residuals
    of its own: only a simulation has both.
    """
    if not math.isfinite(surplus.value):
        return surplus
    camera = camera | {"hot_pixel_share": 0.0, "dead_pixel_share": 0.0}
    # The same noise in all simulations: they differ by their leak alone.
    simulated = [simulate_recording(given, camera | {"leak_hz": float(leak)}, 10) for leak in _LEAKS_HZ]
    light = given.known_light.of(np.arange(256.0))
    stills = [still_time(each, at_rest, light) for each in (given, *simulated)]
    table = np.stack([stills[0].seconds, *(each.on - each.off for each in stills)], axis=2) * ~is_hot[:, None, None]
    sums = sums_by_block((blocks[:, None] * 4 + np.arange(4)).ravel(), table.reshape(-1, table.shape[2]), 4)

    def rates(s: Doubles) -> Doubles:
        return np.asarray(np.maximum.accumulate(s[2:] / max(s[0], 1e-9)) + 1e-9 * np.arange(len(_LEAKS_HZ)))

    def solve(s: Doubles) -> Doubles:
        return np.interp([s[1] / max(s[0], 1e-9)], rates(s), _LEAKS_HZ)

    value, low, high = (float(each[0]) for each in bootstrap(sums, solve))
    rising = rates(sums.sum(axis=0))
    # Beside much noise a leak hardly fires: it matters from where the simulation shows it.
    negligible = max(0.05, float(np.interp(rising[0] + surplus.negligible, rising, _LEAKS_HZ)))
    most = high if high < _LEAKS_HZ[-1] else math.inf
    made = Estimate(value, max(low, 0.0), most, negligible, f"simulated with leaks up to 4 Hz; {surplus.note}")
    return made.moved(value, regression.SYSTEMATIC["leak_hz"] * value) if value > 0.0 else made


def _values(estimates: Mapping[str, Estimate]) -> dict[str, float]:
    """Return the values that are told; the corner is estimated as 1 / Hz, and is off where that is negligible."""
    values = {name: made.value for name, made in estimates.items() if made.told}
    if "photoreceptor_hz" in values:
        inverse, limit = values["photoreceptor_hz"], estimates["photoreceptor_hz"].negligible
        values["photoreceptor_hz"] = 1.0 / inverse if inverse > 0.05 * limit else 0.0
    if not {"threshold_pos", "threshold_neg"} <= values.keys():
        values = {name: value for name, value in values.items() if not name.startswith("threshold_")}
    if not {"hot_pixel_share", "hot_pixel_sigma"} <= values.keys():
        values = {name: value for name, value in values.items() if not name.startswith("hot_pixel")}
    return values


def _complete(values: Mapping[str, float]) -> dict[str, float]:
    return {"threshold_pos": USUAL_THRESHOLD, "threshold_neg": USUAL_THRESHOLD, "log_eps": 1e-3, **values}


def _span(given: Recorded) -> tuple[int, int]:
    """Return the time that recording and simulation have in common, us."""
    if len(given.frames) >= LEAST_FRAMES:
        return int(given.frame_us[0]), int(given.frame_us[-1])
    return given.begin_us, given.begin_us + int(1e6 * given.seconds) + 1


def _with_constant_frames(given: Recorded) -> Recorded:
    """Add frames of one grey level, ten a second."""
    count = int(np.clip(10 * given.seconds, LEAST_FRAMES, 2000))
    times = given.begin_us + np.linspace(0.0, 1e6 * given.seconds, count).astype(np.int64)
    frames = np.full((count, len(given.pixels)), _GREY_OF_STATIC, np.uint8)
    return dataclasses.replace(given, frames=frames, frame_us=times)
