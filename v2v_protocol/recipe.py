"""The recipe: the ranges a virtual event camera and its view of a video are drawn from.

A :class:`Recipe` holds everything that shapes a sample besides the video itself. One draw from it, keyed by (seed,
epoch, index), is a :class:`v2v_protocol.sample.SampleParams`. Values of the default preset, ``paper``, are those of the
training configurations released with "V2V: Scaling Event-Based Vision through Efficient Video-to-Voxel Simulation"
(Lou et al., NeurIPS 2025, arXiv 2505.16797).

The pixel model (section 3 of the paper), per pixel, with F in 0..255:

    L(t)  = log(log_eps + (F(t) / 255) ** gamma)
    dL(t) = residual(t-1) + L(t) - L(t-1) + N(t) + H        N(t) ~ Normal(0, noise_sigma^2), fresh for every frame
    N+    = max(0, floor( dL(t) / threshold_pos))
    N-    = max(0, floor(-dL(t) / threshold_neg))
    residual(t) = dL(t) - threshold_pos N+ + threshold_neg N-
    V(bin)     += N+ - N-

Effects beyond it (mismatch, shot noise, leak, refractory period, low-pass, dead pixels) are off in ``paper``; their
equations and sources are in ``docs/effects.md``.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from v2v_protocol.errors import RecipeError
from v2v_protocol.presets import DEFAULT_PRESET, PRESET_FIELDS
from v2v_protocol.recipe_fields import check_limits, coerced

Range = tuple[float, float]
"""Lowest and highest value of a uniform draw; equal ends fix the value."""

_LARGEST_FRAMES = 1_000_001
SMALLEST_THRESHOLD_SHARE = 0.25
"""No pixel's threshold lies below this share of the nominal one, however large the mismatch."""
LARGEST_NORMAL = 6.56
"""No noise deviates by more standard deviations (``v2v_server.simulation.noise``)."""
LARGEST_EVENTS = 2.0**49
"""Most events a pixel may fire in a clip: beyond, float64 does not resolve a threshold any more."""


@dataclass(frozen=True, slots=True)
class Recipe:
    """Ranges of one virtual camera. Frozen, hashable, validated on construction.

    Clip
        voxels_per_clip: T, voxel grids of a clip.
        bins: B, bins of one voxel grid.
        frames_per_bin: steps between video frames that fall into one bin.
        lead_frames: 1 puts the frame before the first target frame in front (flow networks), else 0.
        lead_voxels: 1 puts one more voxel grid in front (ERAFT), else 0.
        frame_stride: n uses every n-th frame, as if the video had been recorded at 1/n of its rate.

    View
        crop_height_px, crop_width_px: size of the random crop, pixels.
        resize_scale: scale of the picture before the crop; raised where the crop would not fit otherwise, as far as
            the upper end allows.
        flip_probability: chance of a horizontal flip.
        pause_probability: chance, per frame, that a running camera stops (the frame repeats).
        pause_stay_probability: chance, per frame, that a stopped camera stays so.
        contrast_probability: chance that F becomes clip((F - 127.5) s + 127.5, 0, 255), rounded half up.
        contrast_scale: range of s.

    Intensity
        gamma: exponent of the reverse gamma correction.
        log_eps: epsilon inside the logarithm.

    Pixel
        threshold: smaller of the two contrast thresholds, log-intensity units.
        threshold_ratio: the other one, as a multiple; a coin says which of the two is the positive one.
        threshold_source: "sample" draws thresholds afresh for every sample; "video" once per video for ever (taken
            from the list file where it states them).
        noise_sigma: standard deviation of the noise, log units per frame, or per square root of a second.
        noise_scales_with_threshold: True multiplies noise_sigma by the drawn positive threshold.
        hot_pixel_share: share of the crop's pixels that are hot.
        hot_pixel_sigma: standard deviation of a hot pixel's constant drift, log units per frame, or per second.
        noise_unit: "frame" or "second": the time base of noise_sigma and hot_pixel_sigma.

    Effects beyond the paper's model; zero is off
        threshold_mismatch_sigma: standard deviation of each pixel's thresholds, as a share of the nominal ones.
        shot_noise_hz: noise events of a black pixel, a second, both polarities together; a white one has a quarter.
        leak_hz: positive events a second that every pixel fires by itself.
        refractory_seconds: how long a pixel is blind after an event.
        photoreceptor_hz: corner frequency of a white pixel's low-pass; 0 is none at all, so no range begins there.
        dead_pixel_share: share of the crop's pixels that never fire.

    Raises:
        RecipeError: a value is outside its limits; the message names the field, the value and the limit.
    """

    voxels_per_clip: int = 40
    bins: int = 5
    frames_per_bin: int = 1
    lead_frames: int = 0
    lead_voxels: int = 0
    frame_stride: int = 1

    crop_height_px: int = 128
    crop_width_px: int = 128
    resize_scale: Range = (1.0, 1.0)
    flip_probability: float = 0.5
    pause_probability: float = 0.0102
    pause_stay_probability: float = 0.9791
    contrast_probability: float = 0.0
    contrast_scale: Range = (1.0, 3.0)

    gamma: float = 2.2
    log_eps: float = 0.001

    threshold: Range = (0.05, 2.0)
    threshold_ratio: Range = (1.0, 1.5)
    threshold_source: str = "sample"
    noise_sigma: Range = (0.0, 0.1)
    noise_scales_with_threshold: bool = False
    hot_pixel_share: Range = (0.0, 0.001)
    hot_pixel_sigma: Range = (0.0, 10.0)
    noise_unit: str = "frame"

    threshold_mismatch_sigma: Range = (0.0, 0.0)
    shot_noise_hz: Range = (0.0, 0.0)
    leak_hz: Range = (0.0, 0.0)
    refractory_seconds: Range = (0.0, 0.0)
    photoreceptor_hz: Range = (0.0, 0.0)
    dead_pixel_share: Range = (0.0, 0.0)

    def __post_init__(self) -> None:
        values = {
            field.name: coerced(field.name, getattr(self, field.name), field.default)
            for field in dataclasses.fields(self)
        }
        check_limits(values)
        for name, value in values.items():
            object.__setattr__(self, name, value)
        if self.frames_needed > _LARGEST_FRAMES:
            raise RecipeError(
                f"recipe needs {self.frames_needed} frames a sample (voxels_per_clip x bins x frames_per_bin x "
                f"frame_stride + 1); the limit is {_LARGEST_FRAMES}"
            )
        if self.most_events > LARGEST_EVENTS:
            raise RecipeError(
                f"recipe: a pixel may fire {self.most_events:.4g} events in a clip; the limit is {LARGEST_EVENTS:.4g} "
                f"(smallest threshold {self.smallest_and_largest_threshold[0]:.4g}, noise_sigma "
                f"{self.noise_sigma[1]:.4g}, hot_pixel_sigma {self.hot_pixel_sigma[1]:.4g}, {self.steps} steps): raise "
                "threshold or threshold_ratio, lower noise_sigma or hot_pixel_sigma, or make the clip shorter"
            )

    @property
    def has_effects(self) -> bool:
        """True where a draw may switch on an effect beyond the paper's model."""
        return self.timed_effects or self.threshold_mismatch_sigma[1] > 0.0 or self.dead_pixel_share[1] > 0.0

    @property
    def timed_effects(self) -> bool:
        """True where a draw may switch on an effect that is stated in Hz or seconds."""
        return max(self.shot_noise_hz[1], self.leak_hz[1], self.refractory_seconds[1], self.photoreceptor_hz[1]) > 0.0

    @property
    def needs_seconds(self) -> bool:
        """True where a simulation needs the time between frames: noise per second, or an effect in Hz or seconds."""
        return self.noise_unit == "second" or self.timed_effects

    @property
    def steps(self) -> int:
        """Differences between consecutive frames in a sample, lead voxel included."""
        return (self.voxels_per_clip + self.lead_voxels) * self.bins * self.frames_per_bin

    @property
    def frames_needed(self) -> int:
        """Consecutive video frames a sample needs when the camera never pauses (paper: 201)."""
        return self.steps * self.frame_stride + 1

    @property
    def frames_per_sequence(self) -> int:
        """L, the stride between the starts of a video's sequences (paper: 200)."""
        return self.steps * self.frame_stride

    @property
    def target_steps(self) -> tuple[int, ...]:
        """Frame positions (0 .. steps) of the delivered frames: the end of each voxel, and the lead frame."""
        span = self.bins * self.frames_per_bin
        first = (self.lead_voxels + 1 - self.lead_frames) * span
        return tuple(range(first, self.steps + 1, span))

    @property
    def smallest_and_largest_threshold(self) -> tuple[float, float]:
        """Ends of what the recipe itself can draw for either polarity, log units."""
        (low, high), (ratio_low, ratio_high) = self.threshold, self.threshold_ratio
        return low * min(1.0, ratio_low), high * max(1.0, ratio_high)

    @property
    def most_events(self) -> float:
        """:func:`most_events` of the worst draw; what is stated per second, at one frame a second."""
        return self.worst_events(1.0)

    def worst_events(self, step_seconds: float, thresholds: tuple[float, float] | None = None) -> float:
        """:func:`most_events` of the worst draw.

        Args:
            step_seconds: from one frame to the next, all along the clip.
            thresholds: those that are stated for the video, which hold where ``threshold_source`` is "video"; None
                where none are.
        """
        low, high = self.smallest_and_largest_threshold
        if thresholds is not None and self.threshold_source == "video":
            low, high = thresholds
        nominal = max(low, high)
        smallest, largest = pixel_thresholds(min(low, high), nominal, self.threshold_mismatch_sigma[1])
        sigma = self.noise_sigma[1] * (nominal if self.noise_scales_with_threshold else 1.0)
        hot = self.hot_pixel_sigma[1] if self.hot_pixel_share[1] else 0.0
        ends = math.log(self.log_eps), math.log1p(self.log_eps)
        unit = step_seconds if self.noise_unit == "second" else 1.0
        leak = self.leak_hz[1] * largest * step_seconds
        return most_events(
            self.steps, ends, (smallest, largest), self.steps * (sigma * math.sqrt(unit) + hot * unit + leak)
        )

    def to_dict(self) -> dict[str, Any]:
        """All fields as plain values (ranges as lists), in a stable order."""
        return {
            field.name: list(value) if isinstance(value := getattr(self, field.name), tuple) else value
            for field in dataclasses.fields(self)
        }

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Recipe:
        """A recipe from plain values.

        Args:
            values: fields by name; missing ones take the value of ``values["preset"]``, by default ``paper``.

        Raises:
            RecipeError: an unknown key (the nearest known one is named), an unknown preset, a bad value.
        """
        rest = dict(values)
        base = preset(rest.pop("preset", DEFAULT_PRESET))
        return base.replace(**{str(key): value for key, value in rest.items()})  # from YAML, say: {1: 2}

    def replace(self, /, **changes: Any) -> Recipe:
        """This recipe with some fields changed.

        Raises:
            RecipeError: an unknown key or a bad value.
        """
        known = [field.name for field in dataclasses.fields(self)]
        for key in changes:
            if key not in known:
                raise RecipeError(f"unknown recipe key {key!r}{_nearest(key, known)}; known: {', '.join(known)}")
        return dataclasses.replace(self, **changes)


def pixel_thresholds(smallest: float, largest: float, mismatch_sigma: float) -> tuple[float, float]:
    """Ends of what any pixel's threshold can be, for nominal ones between two values."""
    spread = LARGEST_NORMAL * mismatch_sigma
    return smallest * max(1.0 - spread, SMALLEST_THRESHOLD_SHARE), largest * (1.0 + spread)


def most_events(steps: int, log_ends: tuple[float, float], thresholds: tuple[float, float], noise_sum: float) -> float:
    """An upper bound of the events that one pixel can fire in a clip, and the measure of the arithmetic it needs.

    ((steps + 1) (largest threshold + range of L) + largest noise and hot drift of all steps + largest |L|), in units of
    the smallest threshold: no step changes dL by more, and the start and the rounding of L count as one step more.

    Args:
        steps: differences between frames.
        log_ends: smallest and largest log intensity L.
        thresholds: smallest and largest contrast threshold, log units.
        noise_sum: standard deviations of noise and of hot drift, and the leak, summed over the steps, log units.
    """
    low, high = log_ends
    change = (steps + 1) * (max(thresholds) + (high - low)) + LARGEST_NORMAL * noise_sum
    return (change + max(abs(low), abs(high))) / min(thresholds)


PRESETS: dict[str, Recipe] = {name: Recipe(**fields) for name, fields in PRESET_FIELDS.items()}


def preset(name: object) -> Recipe:
    """The preset of that name.

    Raises:
        RecipeError: no such preset; the message lists them.
    """
    if not isinstance(name, str) or name not in PRESETS:
        raise RecipeError(f"unknown recipe preset {name!r}{_nearest(str(name), list(PRESETS))}; "
                          f"known: {', '.join(PRESETS)}")  # fmt: skip
    return PRESETS[name]


def _nearest(word: str, known: list[str]) -> str:
    close = difflib.get_close_matches(word, known, n=1)
    return f" (did you mean {close[0]!r}?)" if close else ""
