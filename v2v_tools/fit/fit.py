"""Fit a camera to a recording: estimate, match with the kernel, and keep the effects that the intervals show."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import V2VError
from v2v_recordings.items import ConvertOptions, Light, ReadProgress
from v2v_tools.fit import estimators, regression
from v2v_tools.fit.increments import Increments, increments_of, intervals_us, is_still, still_time
from v2v_tools.fit.interval import Doubles, Estimate, bootstrap, sums_by_block, unknown
from v2v_tools.fit.recording import Recorded, read_recording
from v2v_tools.fit.statistics import Panels, panels_of, simulate_recording

LEAST_FRAMES = 3
USUAL_THRESHOLD = 0.2
"""Stands in where thresholds cannot be told."""
_LEAKS_HZ = np.array([0.0, 0.03, 0.06, 0.12, 0.25, 0.5, 1.0, 2.0, 4.0])
_LEAK_SEEDS = (10, 11, 12)
_GREY_OF_STATIC = 136
"""Grey level of a quarter of white's light: a static scene without frames."""
_STATIC_LIGHT_DOUBT = 0.3
_FASTEST_HZ = 1e4
"""A faster photoreceptor changes nothing in a clip."""
_LEAST_SURPLUS_HZ = 0.03
"""Brighter events beyond the darker ones that matter in a clip."""


@dataclass(frozen=True, eq=False)
class FittedCamera:
    """A camera fitted to a recording.

    Attributes:
        estimates: by the recipe's names, and ``threshold_pos``, ``threshold_neg``.
        left_out: why an effect is not in the recipe, by name.
        measured, simulated: statistics of the recording and of its simulation; None without thresholds.
        facts: what was read: events, pixels, seconds, frames, and the shares of brighter events.
        light: of the frames.
        late: how much later than their times the frames were seen, s.
        notes: what the reader says about the recording.
    """

    estimates: Mapping[str, Estimate]
    left_out: Mapping[str, str]
    measured: Panels
    simulated: Panels | None
    facts: Mapping[str, float]
    light: Light
    late: Estimate
    notes: tuple[str, ...] = ()

    @property
    def camera(self) -> dict[str, float]:
        """Values of the parameters in use: told, and not left out."""
        return _values({name: made for name, made in self.estimates.items() if name not in self.left_out})


def fit(
    recording: str | Path | Recorded,
    *,
    static: bool = False,
    options: ConvertOptions | None = None,
    progress: ReadProgress = lambda _done, _total: None,
) -> FittedCamera:
    """Fit a camera to a recording of events with frames, or of a static scene.

    Args:
        recording: a file or folder of any form that ``v2v-convert`` reads; or what was read already.
        static: neither the scene nor the camera moved, so all events are noise.
        options: what the recording lacks, such as the size of its sensor.

    Raises:
        UsageError: the recording cannot be read, or has no events.
        V2VError: it has too few frames, and is not static.
    """
    given = recording if isinstance(recording, Recorded) else read_recording(recording, options, progress)
    frames = len(given.frames)
    if frames < LEAST_FRAMES:
        if not static:
            raise V2VError(
                f"the recording has {frames} frames, and a fit needs {LEAST_FRAMES}: record frames with the events, or "
                "give --static if nothing moved"
            )
        if given.seconds <= 0:
            raise V2VError("all events have the same time: record for longer")
        given, frames = _with_constant_frames(given), 0
    estimates, late = _estimates(given, not frames, static)
    left_out = {
        name: f"at most {made.high:.3g}, too little to matter" if made.told else made.note
        for name, made in estimates.items()
        if made.is_absent or not made.told
    }
    measured = panels_of(given)
    simulated = None
    if "threshold_pos" in _values(estimates) or static:
        used = _values({name: made for name, made in estimates.items() if name not in left_out})
        simulated = panels_of(simulate_recording(given, _complete(used), 2, "triangular"))
    facts = {
        "events": float(given.counts.sum()), "pixels": float(len(given.pixels)), "seconds": given.seconds,
        "frames": float(frames), "on_share": float(given.counts[1].sum() / max(given.counts.sum(), 1)),
    }  # fmt: skip
    return FittedCamera(estimates, left_out, measured, simulated, facts, given.known_light, late, given.notes)


def _estimates(given: Recorded, is_blank: bool, static: bool) -> tuple[dict[str, Estimate], Estimate]:
    """Estimate all parameters, and how much later than their times the frames were seen, s.

    Args:
        is_blank: the frames are made up, of one grey level.
        static: see :func:`fit`.
    """
    blocks, gaps_us = given.blocks(), intervals_us(given)
    period, longest_us = estimators.refractory(gaps_us), float(np.median(np.diff(given.frame_us)))
    if not static and not period.told and math.isfinite(period.high):
        period = regression.refractory_by_change(given, blocks, period, longest_us)
    refractory_seconds = period.value if math.isfinite(period.value) else 0.0
    at_rest = is_still(given)
    still = still_time(given, at_rest)
    is_hot = estimators.hot_mask(still)

    def usual(period_seconds: float) -> Increments:
        increments = increments_of(given, period_seconds, longest_us)
        return increments.take(~is_hot[increments.pixel] & (not static))

    increments = usual(refractory_seconds)
    fitted = regression.Regression(increments, blocks)
    positive, negative = fitted.positive, fitted.negative
    if positive.told and not period.told and math.isfinite(period.high):
        # What is lost in a period that is not known well passes for a larger threshold.
        ends = [regression.Regression(usual(end), blocks) for end in (period.low, period.high)]
        positive = positive.widened(0.0, abs(ends[1].positive.value - ends[0].positive.value) / 2)
        negative = negative.widened(0.0, abs(ends[1].negative.value - ends[0].negative.value) / 2)
    why = estimators.unexplained(given, at_rest, is_hot)
    shot = unknown(why) if why else estimators.shot_noise(still, blocks, is_hot, static)
    if is_blank and shot.told:
        shot = dataclasses.replace(
            shot.widened(_STATIC_LIGHT_DOUBT),
            note=f"{shot.note}; without frames, for a mean light of 5 to 60 % of white's",
        )
    made = {
        "threshold_pos": positive, "threshold_neg": negative, "log_eps": fitted.log_eps,
        "threshold_mismatch_sigma": estimators.mismatch(fitted, increments, blocks),
        "photoreceptor_hz": fitted.corner if fitted.positive.told else unknown("needs the thresholds"),
        "refractory_seconds": estimators.with_noise(period, shot, gaps_us[0]), "shot_noise_hz": shot,
        "dead_pixel_share": unknown(why) if why and static else estimators.dead_pixels(given, blocks),
    }  # fmt: skip
    values = _complete(_values(made))
    thresholds = values["threshold_pos"], values["threshold_neg"]
    made["hot_pixel_share"], made["hot_pixel_sigma"] = estimators.hot_pixels(
        still, is_hot, thresholds, refractory_seconds, blocks
    )
    made["leak_hz"] = unknown("needs the thresholds")
    if static or fitted.positive.told:
        made["leak_hz"] = _matched_leak(given, values, still, blocks, at_rest, is_hot, shot)
    made = {name: dataclasses.replace(one, low=0.0) if one.is_absent else one for name, one in made.items()}
    return made, fitted.late


def _matched_leak(
    given: Recorded, camera: dict[str, float], still: Doubles, blocks: npt.NDArray[np.int64],
    at_rest: npt.NDArray[np.bool_], is_hot: npt.NDArray[np.bool_], shot: Estimate,
) -> Estimate:  # fmt: skip
    """Find the leak with which the simulation has the surplus of brighter events that was measured.

    Noise resets a pixel before its leak crosses the threshold, and the motion before a still stretch leaves residuals
    of its own: only a simulation has both.
    """
    if not math.isfinite(shot.value):
        return unknown(shot.note)
    camera = camera | {"hot_pixel_share": 0.0, "dead_pixel_share": 0.0}

    def simulated(leak: float) -> Doubles:
        """Return the mean of some simulations; their noise is the same for every leak."""
        made = [simulate_recording(given, camera | {"leak_hz": leak}, seed, "triangular") for seed in _LEAK_SEEDS]
        return np.asarray(np.mean([still_time(each, at_rest) for each in made], axis=0))

    stills = np.stack([still, *map(simulated, _LEAKS_HZ.tolist())])
    table = np.concatenate([still[:1], stills[:, 2] - stills[:, 3]]) * ~is_hot[:, None]
    sums = sums_by_block((blocks[:, None] * 4 + np.arange(4)).ravel(), table.reshape(len(table), -1).T, 4)

    def rates(s: Doubles) -> Doubles:
        return np.asarray(np.maximum.accumulate(s[2:] / max(s[0], 1e-9)) + 1e-9 * np.arange(len(_LEAKS_HZ)))

    value, low, high = (
        float(each[0]) for each in bootstrap(sums, lambda s: np.interp([s[1] / max(s[0], 1e-9)], rates(s), _LEAKS_HZ))
    )
    total = sums.sum(axis=0)
    # Few events: those of a Poisson process that was not seen to fire.
    high = max(high, float(np.interp((total[1] + 3.0) / max(total[0], 1e-9), rates(total), _LEAKS_HZ)))
    # Noise of s Hz resets the pixel, so that a leak of l Hz fires s / (exp(s / l) - 1) events a second.
    noise = max(shot.value, 1e-3)
    negligible = max(0.05, noise / math.log1p(noise / _LEAST_SURPLUS_HZ))
    most = high if high < _LEAKS_HZ[-1] else math.inf
    made = Estimate(value, max(low, 0.0), most, negligible, f"simulated with leaks up to 4 Hz; {shot.note}")
    return made.widened(regression.SYSTEMATIC["leak_hz"])


def _values(estimates: Mapping[str, Estimate]) -> dict[str, float]:
    """Return the values that are told; the corner is estimated as 1 / Hz."""
    values = {name: made.value for name, made in estimates.items() if made.told}
    if "photoreceptor_hz" in values:
        values["photoreceptor_hz"] = 1.0 / max(values["photoreceptor_hz"], 1.0 / _FASTEST_HZ)
    for pair in ({"threshold_pos", "threshold_neg"}, {"hot_pixel_share", "hot_pixel_sigma"}):
        if not pair <= values.keys():
            values = {name: value for name, value in values.items() if name not in pair}
    return values


def _complete(values: Mapping[str, float]) -> dict[str, float]:
    return {"threshold_pos": USUAL_THRESHOLD, "threshold_neg": USUAL_THRESHOLD, "log_eps": 1e-3, **values}


def _with_constant_frames(given: Recorded) -> Recorded:
    """Add frames of one grey level, ten a second, of gamma 2.2 if their light is not given."""
    count = int(np.clip(10 * given.seconds, LEAST_FRAMES, 2000))
    times = given.t_us.min() + np.linspace(0.0, 1e6 * given.seconds, count).astype(np.int64)
    frames = np.full((count, len(given.pixels)), _GREY_OF_STATIC, np.uint8)
    return dataclasses.replace(given, frames=frames, frame_us=times, light=given.light or Light.parse("2.2"))
