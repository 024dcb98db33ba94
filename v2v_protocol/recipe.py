"""The recipe: the ranges a virtual event camera and its view of a video are drawn from.

A :class:`Recipe` holds everything that shapes a sample besides the video itself. One draw from it, keyed by (seed,
epoch, index), is a :class:`v2v_protocol.sample.SampleParams`. Values of the default recipe, ``paper``, are those of the
training configurations released with "V2V: Scaling Event-Based Vision through Efficient Video-to-Voxel Simulation"
(Lou et al., NeurIPS 2025, arXiv 2505.16797).

The pixel model (section 3 of the paper), per pixel, with F in 0..255:

    L(t)  = log(log_eps + (F(t) / 255) ** gamma)
    dL(t) = residual(t-1) + L(t) - L(t-1) + N(t) + H        N(t) ~ Normal(0, noise_sigma^2), fresh for every frame
    N+    = max(0, floor( dL(t) / threshold_pos))
    N-    = max(0, floor(-dL(t) / threshold_neg))
    residual(t) = dL(t) - threshold_pos N+ + threshold_neg N-
    V(bin)     += N+ - N-

With ``light`` = declared, F has the bits of the video, and the transfer that it states may replace (F / 255) ** gamma
(``v2v_server/simulation/intensity.py``).

Effects beyond it (mismatch, shot noise, leak, refractory period, low-pass, dead pixels) are off in ``paper``; their
equations and sources are in ``docs/effects.md``.
"""

from __future__ import annotations

import dataclasses
import logging
import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import RecipeError
from v2v_protocol.persisted import Persisted
from v2v_protocol.settings import (
    Setting,
    check_settings,
    format_value,
    nearest,
    number,
    require_known,
    settings_of,
    span,
    switch,
    whole,
    word,
)

SMALLEST_THRESHOLD_SHARE = 0.25
"""Lower limit of a pixel's threshold under mismatch, as a share of the nominal threshold."""
LARGEST_NORMAL = 6.56
"""No noise deviates by more standard deviations (``v2v_server.simulation.noise``)."""
LARGEST_EVENTS = 2.0**49
"""Largest number of events of a pixel in a clip. With more, float64 no longer resolves a threshold."""
MOST_BAND_PARTS = 8
"""Most parts of a segment that noise below a corner is drawn for."""


class Worst(NamedTuple):
    """The most that an effect does to a pixel in a clip: ``worst(value, steps, seconds)`` of its field.

    Attributes:
        smallest, largest: limits of the pixel's thresholds, as multiples of the nominal ones.
        change: what is added to the changes of log intensity, summed over the clip, in thresholds of the pixel.
    """

    smallest: float = 1.0
    largest: float = 1.0
    change: float = 0.0


def worst_of(effects: Mapping[str, Collection[float]], steps: int, seconds: float) -> Worst:
    """Return the most that effects do together.

    Args:
        effects: by field, the value of each, or the ends of its range.
        steps, seconds: length of the clip.
    """
    cases = [
        [setting.worst(value, steps, seconds) for value in effects[name]]
        for name, setting in effect_settings().items()
        if setting.worst is not None and name in effects
    ]
    return Worst(
        math.prod(min(case.smallest for case in each) for each in cases),
        math.prod(max(case.largest for case in each) for each in cases),
        sum(max(case.change for case in each) for each in cases),
    )


def most_events(
    steps: int, log_ends: tuple[float, float], thresholds: tuple[float, float], noise_sum: float, *worst: float
) -> float:
    """Return an upper bound of the events that one pixel can fire in a clip; it determines the arithmetic that is
    needed.

    ((steps + 1) (largest threshold + range of L) + largest noise and drift of all steps + largest |L|), in units of the
    smallest threshold: no step changes dL by more, and the start and the rounding of L count as one step more.

    Args:
        steps: differences between frames, or segments of them.
        log_ends: smallest and largest log intensity L.
        thresholds: smallest and largest nominal contrast threshold, log units.
        noise_sum: standard deviations of noise and of hot drift, summed over the steps, log units.
        worst: what the effects do, the values of a :class:`Worst`; without them, nothing.
    """
    (low, high), (least, most, added) = log_ends, Worst(*worst)
    largest = max(thresholds) * most
    change = (steps + 1) * (largest + (high - low)) + LARGEST_NORMAL * (noise_sum + added * largest)
    return (change + max(abs(low), abs(high))) / (min(thresholds) * least)


DEFAULT_PRESET = "paper"

_WORLDS: Mapping[str, Any] = {
    "world_speed_px": (4.0, 400.0),
    "world_turn_deg": (0.0, 45.0),
    "world_zoom": (0.0, 0.3),
    "world_tilt": (0.0, 0.15),
    "world_shake_px": (0.0, 3.0),
    "world_patches": 2,
    "world_patch_px": (32.0, 96.0),
    "world_still_share": 0.1,
    "world_turn_only_share": 0.1,
    "world_plain_share": 0.1,
}
"""Photographs that move, for the paper's pixel: from a tripod to a run, up to 7 px from frame to frame at 60 Hz."""

_RUNNING: Mapping[str, Any] = {
    "start": "triangular",  # a residual that moves as a Brownian motion: where it stands in the long run
    # v2e's logarithm becomes linear below 20 of 255, with the slope of an epsilon of 0.026; half and twice of it.
    "log_eps": (0.013, 0.052),
    "threshold": (0.134, 0.405),  # ln 1.143, its least contrast, to ln 1.5 (Gallego et al. 2022)
    "threshold_mismatch_sigma": (0.05, 0.16),  # 2.1 % of contrast (Lichtsteiner et al. 2008) at these thresholds
    "rate_draw": "log",  # quiet cameras are as common as loud ones
    # Around v2e's `noisy`, 5, and two recordings, 0.44 and 4.06 a pixel, halved by grey light. But the first moves, and
    # 37 % of the second are bursts: "davis346-measured" has the rates of still pixels.
    "shot_noise_hz": (0.1, 10.0),
    "leak_hz": (0.05, 0.2),  # around v2e's 0.1
    "refractory_seconds": (1e-4, 1e-3),  # ESIM's examples 1e-4, v2e's default 5e-4; the upper end is a guess
    "photoreceptor_hz": (300.0, 3000.0),  # v2e's default; the bandwidth in bright light of Lichtsteiner et al. 2008
    "dead_pixel_share": (0.0, 1e-4),  # a guess
    "noise_sigma": (0.0, 0.0),
    "noise_unit": "second",
    "hot_pixel_share": (0.0, 5e-4),  # a guess, as its sigma
    "hot_pixel_sigma": (0.0, 20.0),
}
"""A DAVIS346 in ordinary light that has run for a while. Numbers are from sources, no fit (docs/effects.md). ``gamma``
stays that of the videos; for frames that are linear in intensity, as a DAVIS stores them, set it to 1.
"""

PRESET_FIELDS: Mapping[str, Mapping[str, Any]] = {
    "paper": {},
    # Ablation "-F": one draw of the thresholds per video, the same in every epoch.
    "paper-fixed-thresholds": {"threshold_source": "video"},
    # Ablation "LDR": contrast raised, then clipped.
    "paper-contrast": {"contrast_probability": 0.8},
    # EVFlowNet: the frame before the first target frame, for pseudo flow.
    "paper-flow": {"lead_frames": 1},
    # ERAFT: that frame, and one more voxel grid before the first.
    "paper-eraft": {"lead_frames": 1, "lead_voxels": 1},
    # The paper's pixel without noise, hot pixels or pauses: for tests and for viewing.
    "noise-free": {
        "noise_sigma": (0.0, 0.0),
        "hot_pixel_share": (0.0, 0.0),
        "hot_pixel_sigma": (0.0, 0.0),
        "pause_probability": 0.0,
    },
    # What v2e (Hu et al. 2021) calls `clean`: thresholds 0.2 with a deviation of 0.02, nothing else.
    "clean": {
        "threshold": (0.2, 0.2),
        "threshold_ratio": (1.0, 1.0),
        "threshold_mismatch_sigma": (0.1, 0.1),
        "noise_sigma": (0.0, 0.0),
        "hot_pixel_share": (0.0, 0.0),
        "hot_pixel_sigma": (0.0, 0.0),
    },
    # The paper's pixel with a higher dark floor, drawn (docs/effects.md).
    "sensor": {"log_eps": (0.01, 0.2)},
    # A DAVIS346 in ordinary light; docs/effects.md gives the source of each value.
    "davis346": {
        # ln 1.143, its least contrast, to ln 1.5, as far as such cameras are usually set (Gallego et al. 2022).
        "threshold": (0.134, 0.405),
        # 2.1 % of contrast (Lichtsteiner et al. 2008); 0.05 of 0.2 (v2e `noisy`)
        "threshold_mismatch_sigma": (0.1, 0.25),
        "shot_noise_hz": (0.0, 5.0),  # up to v2e's `noisy`
        "leak_hz": (0.05, 0.2),  # around v2e's 0.1; the width is a guess
        "refractory_seconds": (1e-4, 1e-3),  # ESIM's examples 1e-4, v2e's default 5e-4; the upper end is a guess
        "photoreceptor_hz": (30.0, 300.0),  # v2e's `noisy` and its default
        "dead_pixel_share": (0.0, 1e-4),  # a guess
        # Shot noise takes the place of the paper's noise; hot pixels of up to about a hundred events a second: a guess.
        "noise_sigma": (0.0, 0.0),
        "noise_unit": "second",
        "hot_pixel_share": (0.0, 5e-4),
        "hot_pixel_sigma": (0.0, 20.0),
    },
    "davis346-running": _RUNNING,
    # The same with the noise of still pixels, as measured in two cameras.
    "davis346-measured": {
        **_RUNNING,
        # 0.006 events a second in a DAVIS346, 2.4 in a DAVIS240C without the bursts of its exposure. A pixel of 0.27 of
        # white has 0.8 of a black one's.
        "shot_noise_hz": (0.0075, 3.0),
        "leak_hz": (0.01, 0.2),  # around the surplus of brighter events in the DAVIS346, 0.015, and v2e's 0.1
    },
    "worlds": _WORLDS,
    # The same, closer to light (docs/guides/photographs.md).
    "worlds-fine": {**_WORLDS, "world_bits": 16, "world_change_share": 0.5},
    # Recordings of event cameras, which have their own noise: a grid from each mark to the next.
    "recordings": {
        "grids_per_frame": 1,
        "noise_sigma": (0.0, 0.0),
        "hot_pixel_share": (0.0, 0.0),
        "hot_pixel_sigma": (0.0, 0.0),
        "pause_probability": 0.0,
    },
}

DEPRECATED: Mapping[str, str] = dict.fromkeys(("sensor", "davis346"), "davis346-measured")
"""Recipes that stay readable but are not listed, with their successors."""
LISTED = tuple(name for name in PRESET_FIELDS if name not in DEPRECATED)
"""Names of recipes to choose from."""

STREAM_PRESETS: Mapping[str, Mapping[str, Any]] = {
    "exact": {"samples_per_decode": 1},
    "balanced": {"samples_per_decode": 2},
    "fast": {"samples_per_decode": 4},
    "natural": {"samples_per_decode": 1, "scene": "auto", "moving_share": 0.75},
    "worlds": {"samples_per_decode": 1, "recipe": "worlds"},
    "worlds-fine": {"samples_per_decode": 1, "recipe": "worlds-fine"},
    "recordings": {"samples_per_decode": 1, "recipe": "recordings"},
    "natural-davis346": {
        "samples_per_decode": 1, "scene": "auto", "moving_share": 0.75, "recipe": "davis346-running",
    },
}  # fmt: skip
"""Spec fields that each preset sets; a recipe by its name. The first three trade accuracy for speed
(`docs/accuracy.md`); "natural" is for videos as they are: what spoils events is left out, and most crops show something
that moves (`docs/scene.md`); "natural-davis346" shows them to a running camera (`docs/effects.md`); "worlds" and
"worlds-fine" are for photographs (`docs/guides/photographs.md`), "recordings" for recordings of event cameras.
"""


_LOG = logging.getLogger(__name__)
_WARNED: set[str] = set()
"""Warnings that this process has given."""
Range = tuple[float, float]
"""Lowest and highest value of a uniform draw; equal ends fix the value."""

LARGEST_SIDE_PX = 16_384
LARGEST_SCALE = 100.0
EFFECTS_SECTION = "Effects beyond the paper's model; zero is off"
"""The group of fields that switch on an effect where the upper end of their range is above zero."""
WORLDS_SECTION = "Worlds: photographs that move (--videos-kind photographs)"
RECORDED_SECTION = "Recordings of event cameras (--videos-kind recordings)"
ADDED = "added_sigma", "added_hot_share", "added_hot_sigma"
"""Fields of the noise that is added to finished bins."""
TIME_UNITS = ("Hz", "s")
"""An effect in one of these needs the time between frames."""
STARTS = ("uniform", "triangular", "zero")
"""How the residual of a pixel is drawn at the start of a clip (``v2v_server/simulation/pixel.py``)."""
FRAMES = "frames"
"""The start of a recipe whose residuals are what frames before the clip leave."""
_RUN_IN_FRAMES, _RUN_IN_SECONDS = 5, 0.15
"""Least number of these frames, and least time that they last at the average rate."""
_LARGEST_FRAMES = 1_000_001
MOST_STEPS_PER_GRID = 1024
"""Largest number of steps between video frames that a grid of ``voxel_seconds`` may span."""
BRIGHTEST = 50.0
"""Upper limit of light where a recipe uses the transfer that a video states; white is 1. PQ reaches 49.3."""


@dataclass(frozen=True, slots=True)
class Recipe(Persisted):
    """Ranges of one virtual camera. Frozen, hashable, validated on construction.

    Raises:
        RecipeError: a value is outside its limits; the message names the field, the value and the limit.
    """

    voxels_per_clip: int = whole(
        40, 1, 1_000_000, "T, frames of a clip, each with the voxel grids that end at it", group="Clip"
    )
    bins: int = whole(5, 1, 1024, "B, bins of one voxel grid")
    frames_per_bin: int = whole(1, 1, 1024, "steps between video frames in one bin")
    grids_per_frame: int = whole(
        0, 0, 1024, "n voxel grids in each step between video frames; 0: a grid spans bins x frames_per_bin steps",
        is_later=True,
    )  # fmt: skip
    voxel_seconds: Range = span(
        (0.0, 0.0), 1e-6, 100.0,
        "duration of a voxel grid: it spans the number of steps between video frames that comes nearest, and its bins "
        "are equal parts of its time",
        unit="s", off=True, is_later=True,
        usual=(1e-4, 2.0), mistake="A grid would hold {0:g} s of events. Divide milliseconds by 1000.",
        too_low="A grid would hold {0:g} s of events. It is in seconds.",
    )  # fmt: skip
    lead_frames: int = whole(0, 0, 1, "1 adds the frame before the first target frame (flow networks)")
    lead_voxels: int = whole(0, 0, 1, "1 adds one voxel grid before the first (ERAFT)")
    frame_stride: int = whole(1, 1, 1000, "use every n-th frame, as if the video had 1/n of its frame rate")
    exposure_seconds: Range = span(
        (0.0, 0.0), 1e-6, 10.0,
        "exposure of frames_blurred, around the time of each frame; the events are those of the same light",
        unit="s", off=True, is_later=True,
        usual=(1e-5, 0.2), mistake="The picture would be exposed for {0:g} s. Divide milliseconds by 1000.",
    )  # fmt: skip
    max_boxes: int = whole(
        64, 1, 4096, "most boxes of a frame, if boxes are requested; the smallest ones beyond it are left out",
        is_later=True,
    )  # fmt: skip

    crop_height_px: int = whole(128, 1, LARGEST_SIDE_PX, "height of the random crop", unit="px", group="View")
    crop_width_px: int = whole(128, 1, LARGEST_SIDE_PX, "width of the random crop", unit="px")
    resize_scale: Range = span(
        (1.0, 1.0), 0.01, LARGEST_SCALE,
        "scale of the picture before the crop; raised, up to the upper end, if the crop would not fit",
    )  # fmt: skip
    flip_probability: float = number(0.5, 0.0, 1.0, "probability of a horizontal flip")
    pause_probability: float = number(
        0.0102, 0.0, 1.0, "probability per frame that a running camera stops (the frame repeats)"
    )
    pause_stay_probability: float = number(
        0.9791, 0.0, 1.0, "probability per frame that a stopped camera stays stopped"
    )
    contrast_probability: float = number(
        0.0, 0.0, 1.0, "probability that F becomes clip((F - 127.5) s + 127.5, 0, 255), rounded half up"
    )
    contrast_scale: Range = span((1.0, 3.0), 0.0, 100.0, "range of s in contrast_probability")

    gamma: float = number(
        2.2,
        0.05,
        20.0,
        "exponent of the reverse gamma correction",
        group="Intensity",
        usual=(0.4, 3.0),
        mistake="Videos are coded with about 2.2.",
    )
    log_eps: Range = span(
        (0.001, 0.001),
        1e-12,
        1.0,
        "epsilon inside the logarithm: the dark current as a share of white's photocurrent",
        usual=(1e-6, 0.5),
        mistake="It is a share of white's photocurrent: of 8-bit grey levels, divide by 255.",
        too_low="Black pixels would fire at the least change. It is a share of white's photocurrent.",
    )
    light: str = word(
        "sdr", ("sdr", "declared"),
        "sdr: read 8 bits and apply gamma; declared: read up to 12 bits and apply the transfer that the video states "
        "(PQ, HLG, log, linear), else gamma",
        is_later=True,
    )  # fmt: skip

    threshold: Range = span(
        (0.05, 2.0),
        1e-6,
        1e6,
        "smaller of the two contrast thresholds",
        unit="log units",
        group="Pixel",
        usual=(0.01, 5.0),
        mistake="An event would need a brightness e^{0:g} times as high. Divide percent by 100.",
        too_low="Every change of a level would make many events. It is a difference of natural logarithms.",
    )
    threshold_ratio: Range = span(
        (1.0, 1.5),
        1e-6,
        1e6,
        "the larger threshold as a multiple of the smaller; which of them is positive is random",
        usual=(0.1, 10.0),
        mistake="One polarity would hardly fire. It is a multiple: divide percent by 100.",
        too_low="One polarity would hardly fire. It is a multiple of the smaller threshold.",
    )
    threshold_source: str = word(
        "sample", ("sample", "video"),
        "sample: new thresholds for every sample; video: the same for all samples of a video (those of the list file, "
        "if it states any)",
    )  # fmt: skip
    start: str = word(
        "uniform", (*STARTS, FRAMES),
        "residual of each pixel at the start of a clip, between its thresholds: uniform, as in the paper's code; "
        "triangular, as in a camera that has run for a long time; zero, as if each pixel had just fired; frames, what "
        "at least 5 frames and 0.15 s before the clip leave, which are simulated and thrown away, else triangular",
        is_later=True,
    )  # fmt: skip
    noise_sigma: Range = span(
        (0.0, 0.1), 0.0, 1e6, "standard deviation of the noise, per frame, or per square root of a second",
        unit="log units",
        usual=(0.0, 1.0), mistake="Noise would make events in most pixels of each frame. Divide percent by 100.",
    )  # fmt: skip
    noise_scales_with_threshold: bool = switch(False, "multiply noise_sigma by the drawn positive threshold")
    hot_pixel_share: Range = span(
        (0.0, 0.001),
        0.0,
        1.0,
        "share of the crop's pixels that are hot",
        usual=(0.0, 0.05),
        mistake="Events of hot pixels would hide the others. It is a share: divide percent by 100.",
    )
    hot_pixel_sigma: Range = span(
        (0.0, 10.0), 0.0, 1e9, "standard deviation of a hot pixel's constant drift, per frame, or per second",
        unit="log units",
        usual=(0.0, 1000.0), mistake="A hot pixel would fire hundreds of events in each frame.",
    )  # fmt: skip
    noise_unit: str = word("frame", ("frame", "second"), "the time base of noise_sigma and hot_pixel_sigma")

    rate_draw: str = word(
        "uniform", ("uniform", "log"),
        "draw effects in Hz uniformly from their range, or uniformly in its logarithm: from 0.1 to 10, half of the "
        "draws are below 1",
        is_later=True,
    )  # fmt: skip
    threshold_mismatch_sigma: Range = span(
        (0.0, 0.0), 0.0, 1.0, "standard deviation of each pixel's thresholds, as a share of the nominal ones",
        group=EFFECTS_SECTION,
        usual=(0.0, 0.3), mistake="Many pixels would fire far too easily. Divide percent by 100.",
        worst=lambda sigma, *_: Worst(
            max(1.0 - LARGEST_NORMAL * sigma, SMALLEST_THRESHOLD_SHARE), 1.0 + LARGEST_NORMAL * sigma
        ),
    )  # fmt: skip
    shot_noise_hz: Range = span(
        (0.0, 0.0), 0.0, 1e4,
        "rate of noise events of a black pixel, both polarities together; a white pixel has a quarter",
        unit="Hz",
        usual=(0.0, 100.0), mistake="Each dark pixel would fire {0:g} times a second, the sensor many more.",
    )  # fmt: skip
    leak_hz: Range = span(
        (0.0, 0.0),
        0.0,
        1e4,
        "rate of positive events that every pixel fires without a change of brightness",
        unit="Hz",
        usual=(0.0, 20.0),
        mistake="Every pixel would fire {0:g} events a second without a change. Divide millihertz by 1000.",
        worst=lambda rate_hz, _, seconds: Worst(change=rate_hz * seconds),
    )
    refractory_seconds: Range = span(
        (0.0, 0.0),
        0.0,
        1e3,
        "time after an event in which a pixel fires none",
        unit="s",
        usual=(0.0, 0.02),
        mistake="A pixel would be blind for {0:g} s after each event. Divide milliseconds by 1000.",
    )
    photoreceptor_hz: Range = span(
        (0.0, 0.0),
        0.01,
        1e6,
        "corner frequency of a white pixel's low-pass filter",
        unit="Hz",
        off=True,
        usual=(1.0, 1e5),
        mistake="Pixels would see no change faster than {0:g} Hz. A time constant of T s is 0.16 / T Hz.",
    )
    dead_pixel_share: Range = span(
        (0.0, 0.0),
        0.0,
        1.0,
        "share of the crop's pixels that never fire",
        usual=(0.0, 0.05),
        mistake="It is a share: divide percent by 100.",
    )

    noise_band_share: Range = span(
        (0.0, 0.0), 0.0, 10.0, "standard deviation of noise below noise_band_hz, as a share of the mean threshold",
        is_later=True, usual=(0.0, 0.4), mistake="Still pixels would fire without a pause. Divide percent by 100.",
        worst=lambda share, steps, _: Worst(change=8.0 * share * steps),
    )  # fmt: skip
    noise_band_hz: Range = span(
        (0.0, 0.0), 0.01, 1e4, "corner frequency of the noise of noise_band_share", unit="Hz", off=True, is_later=True,
        usual=(1.0, 300.0), mistake="Noise of {0:g} Hz was not measured in a sensor.",
    )  # fmt: skip

    world_speed_px: Range = span(
        (0.0, 0.0), 1e-3, 1e4,
        "speed of camera and patches over the photograph, px of the crop a second; drawn uniformly in its logarithm",
        unit="px/s", off=True, is_later=True, group=WORLDS_SECTION,
    )  # fmt: skip
    world_turn_deg: Range = span((0.0, 0.0), 0.0, 3600.0, "speed at which they turn, either way", unit="deg/s",
                                 is_later=True)  # fmt: skip
    world_zoom: Range = span(
        (0.0, 0.0), 0.0, 10.0, "speed at which they zoom, in or out, as a share of the size a second", is_later=True
    )
    world_tilt: Range = span(
        (0.0, 0.0), 0.0, 0.25, "most tilt of the camera: share by which the crop's edges are larger or smaller",
        is_later=True,
    )  # fmt: skip
    world_shake_px: Range = span(
        (0.0, 0.0), 0.0, 1000.0, "most deviation of the camera by a shaking hand", unit="px", is_later=True
    )
    world_patches: int = whole(
        0, 0, 2, "most patches, cut from other places of the photograph, that move in front of it", is_later=True
    )
    world_patch_px: Range = span(
        (40.0, 100.0), 4.0, LARGEST_SIDE_PX, "diameter of the circle that holds a patch", unit="px", is_later=True
    )
    world_still_share: float = number(
        0.0, 0.0, 1.0, "share of scenes with a still camera; patches still move", is_later=True
    )
    world_turn_only_share: float = number(
        0.0, 0.0, 1.0, "share of scenes whose camera turns and does nothing else", is_later=True
    )
    world_plain_share: float = number(
        0.0, 0.0, 1.0, "share of scenes whose photograph is out of focus behind sharp patches", is_later=True
    )
    world_bits: int = whole(12, 12, 16, "bits of a level of the rendered pictures", is_later=True)
    world_change_share: float = number(
        0.0, 0.0, 100.0,
        "most change of light in a sub-step, as a share of the threshold, of 99 % of the pixels that change: steps are "
        "divided, at most 16 times, by pictures rendered between two frames; 0: off",
        is_later=True,
    )  # fmt: skip
    track_points: int = whole(64, 1, 65_536, "N, points that the array tracks follows", is_later=True)

    bin_span: str = word(
        "grid", ("grid", "events"),
        "bins of a grid are equal parts of its time; events: of the time from its first event to its last, as in the "
        "released code",
        is_later=True, group=RECORDED_SECTION,
    )  # fmt: skip
    added_sigma: Range = span(
        (0.0, 0.0), 0.0, 1e6, "standard deviation of noise that is added to every finished bin, events", is_later=True
    )
    added_hot_share: Range = span(
        (0.0, 0.0), 0.0, 1.0, "share of the crop's pixels whose finished bins all get the same value added",
        is_later=True,
    )  # fmt: skip
    added_hot_sigma: Range = span((0.0, 0.0), 0.0, 1e6, "standard deviation of that value, events", is_later=True)

    def __post_init__(self) -> None:
        check_settings(self, "recipe {}".format, RecipeError)
        if self.grids_per_frame and self.frames_per_bin != 1:
            raise RecipeError(
                f"recipe frames_per_bin = {self.frames_per_bin}: bins are parts of a step if grids_per_frame is set "
                f"({self.grids_per_frame}): set frames_per_bin to 1, or grids_per_frame to 0"
            )
        for name, alone in (("frames_per_bin", 1), ("grids_per_frame", 0)):
            if self.is_timed and getattr(self, name) != alone:
                raise RecipeError(
                    f"recipe {name} = {getattr(self, name)}: the duration of a grid is that of voxel_seconds "
                    f"({format_value(self.voxel_seconds)}): set {name} to {alone}, or voxel_seconds to 0"
                )
        if any(self.noise_band_share) and not any(self.noise_band_hz):
            raise RecipeError(
                f"recipe noise_band_share = {format_value(self.noise_band_share)}: set noise_band_hz, the corner of "
                "this noise, too"
            )
        for name in self.log_drawn:
            low, high = getattr(self, name)
            if low <= 0.0 and low < high:
                raise RecipeError(
                    f"recipe {name} = {format_value((low, high))}: a range that is drawn in its logarithm must begin "
                    "above 0: raise its lower end, or set rate_draw to uniform"
                )
        if not self.is_timed and self.frames_needed > _LARGEST_FRAMES:
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
        """Return whether a draw may switch on an effect beyond the paper's model."""
        return any(any(getattr(self, name)) for name in effect_settings())

    @property
    def is_world(self) -> bool:
        """Return whether a field is set that only photographs can obey."""
        return any(
            getattr(self, name) != setting.default
            for name, setting in settings_of(Recipe).items()
            if name.startswith("world_")
        )

    @property
    def is_recorded(self) -> bool:
        """Return whether a field is set that only recordings can obey."""
        return self.bin_span != "grid" or self.is_noisy

    @property
    def is_noisy(self) -> bool:
        """Return whether noise may be added to finished bins."""
        return any(any(getattr(self, name)) for name in ADDED)

    @property
    def timed_effects(self) -> bool:
        """Return whether a draw may switch on an effect that is stated in Hz or seconds."""
        return any(any(getattr(self, name)) for name, each in effect_settings().items() if each.unit in TIME_UNITS)

    @property
    def log_drawn(self) -> tuple[str, ...]:
        """Return the effects whose value is drawn uniformly in its logarithm."""
        names = (name for name, setting in effect_settings().items() if setting.unit == "Hz")
        return tuple(names) if self.rate_draw == "log" else ()

    @property
    def needs_seconds(self) -> bool:
        """Whether a simulation needs the time between frames: noise per second, an effect in Hz or seconds, or grids of
        a duration.
        """
        return self.noise_unit == "second" or self.timed_effects or self.is_timed

    @property
    def is_timed(self) -> bool:
        """Whether a grid has a duration (``voxel_seconds``), and the video's frame rate decides how many steps it
        spans. The properties that count steps and frames are then upper bounds over all videos.
        """
        return self.voxel_seconds[1] > 0.0

    @property
    def crop_px(self) -> tuple[int, int]:
        """Height and width of the crop."""
        return self.crop_height_px, self.crop_width_px

    @property
    def steps_per_frame(self) -> int:
        """Steps between consecutive video frames from one delivered frame to the next."""
        if self.is_timed:
            return MOST_STEPS_PER_GRID
        return 1 if self.grids_per_frame else self.bins * self.frames_per_bin

    def steps_at(self, frames_per_second: npt.ArrayLike) -> npt.NDArray[np.int64]:
        """Return ``steps_per_frame`` in videos of these rates, [videos].

        With ``voxel_seconds``: in the longest grid that the recipe can draw, which may be more than
        MOST_STEPS_PER_GRID, and 0 where a rate is not above 0.
        """
        if not self.is_timed:
            return np.asarray(self.steps_per_frame, np.int64)
        rates = np.nan_to_num(np.asarray(frames_per_second, np.float64), nan=0.0)
        steps = np.floor(np.minimum(self.voxel_seconds[1] * rates / self.frame_stride, 2.0**31) + 0.5)
        return np.where(rates > 0.0, np.maximum(steps, 1.0), 0.0).astype(np.int64)

    def sequence_at(self, frames_per_second: npt.ArrayLike) -> npt.NDArray[np.int64]:
        """Return ``frames_per_sequence`` of videos of these rates, [videos] (:meth:`steps_at`)."""
        return self.steps_at(frames_per_second) * (self.spans * self.frame_stride)

    def reach_at(self, frames_per_second: npt.ArrayLike) -> npt.NDArray[np.int64]:
        """Return the largest number of frames after its first one that a sample of videos of these rates may use.

        Rates and result are [videos]. With ``voxel_seconds`` twice :meth:`sequence_at`: where the frame rate varies,
        time stamps may be closer than the average rate says.
        """
        return self.sequence_at(frames_per_second) * (2 if self.is_timed else 1)

    def run_in_at(self, frames_per_second: npt.ArrayLike) -> npt.NDArray[np.int64]:
        """Return how many frames before its first one a sample of videos of these rates starts from, those included
        that the stride leaves out, [videos]; unknown rates count as 0.
        """
        seconds = np.nan_to_num(np.asarray(frames_per_second, np.float64), nan=0.0) * _RUN_IN_SECONDS
        steps = np.maximum(np.ceil(seconds / self.frame_stride - 1e-6), _RUN_IN_FRAMES).astype(np.int64)
        return steps * (self.frame_stride if self.start == FRAMES else 0)

    def held_at(self, frames_per_second: npt.ArrayLike) -> npt.NDArray[np.int64]:
        """Return the largest number of frames beside its first one that a sample of videos of these rates may use,
        before it (:meth:`run_in_at`) and after it (:meth:`reach_at`), [videos].
        """
        return self.run_in_at(frames_per_second) + self.reach_at(frames_per_second)

    @property
    def voxel_grids(self) -> int:
        """Voxel grids of a sample: T + lead_voxels, times ``grids_per_frame`` if that is set."""
        return (self.voxels_per_clip + self.lead_voxels) * max(1, self.grids_per_frame)

    @property
    def frame_grids(self) -> tuple[int, ...]:
        """Number of the voxel grid that ends at each delivered frame; -1 for a lead frame before the first grid."""
        grids = max(1, self.grids_per_frame)
        return tuple(end * grids - 1 for end in range(self.first_frame, self.spans + 1))

    @property
    def delivered_frames(self) -> int:
        """Frames of a sample that arrays have: T + lead_frames."""
        return self.voxels_per_clip + self.lead_frames

    @property
    def spans(self) -> int:
        """Spans from one delivered frame to the next in a sample, lead voxel included."""
        return self.voxels_per_clip + self.lead_voxels

    @property
    def first_frame(self) -> int:
        """Number of the span that begins at the first delivered frame."""
        return self.lead_voxels + 1 - self.lead_frames

    @property
    def steps(self) -> int:
        """Differences between consecutive frames in a sample, lead voxel included."""
        return self.spans * self.steps_per_frame

    def most_segments(self, steps: int, levels_per_step: int = 0) -> int:
        """Return the largest number of segments (``Timeline``) of a sample with this number of steps.

        ``levels_per_step``: see :meth:`worst_events`.
        """
        return (MOST_BAND_PARTS if any(self.noise_band_share) else 1) * (
            steps * (1 + levels_per_step)
            + (self.spans * self.bins if self.is_timed else steps * max(0, self.grids_per_frame * self.bins - 1))
        )

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
        """Frame positions (0 .. steps) of the delivered frames: the end of each voxel, and the lead frame.

        Raises:
            RecipeError: they depend on the sample (``voxel_seconds``): use ``SampleParams.ends``.
        """
        if self.is_timed:
            raise RecipeError("recipe voxel_seconds: frames lie at other steps in each sample; use SampleParams.ends")
        return tuple(range(self.first_frame * self.steps_per_frame, self.steps + 1, self.steps_per_frame))

    @property
    def smallest_and_largest_threshold(self) -> tuple[float, float]:
        """Limits of the thresholds that the recipe itself can draw for either polarity, log units."""
        (low, high), (ratio_low, ratio_high) = self.threshold, self.threshold_ratio
        return low * min(1.0, ratio_low), high * max(1.0, ratio_high)

    @property
    def most_events(self) -> float:
        """Upper bound from :func:`most_events` for the worst draw; quantities per second are taken at one frame per
        second.
        """
        return self.worst_events(1.0)

    def worst_events(
        self, step_seconds: float, thresholds: tuple[float, float] | None = None, levels_per_step: int = 0
    ) -> float:
        """Return the upper bound of :func:`most_events` for the worst draw.

        Args:
            step_seconds: time from one frame to the next, constant over the clip.
            thresholds: thresholds stated for the video, used if ``threshold_source`` is "video"; None if there are
                none.
            levels_per_step: largest number of levels between two frames (``substep_px`` of the spec).
        """
        low, high = self.smallest_and_largest_threshold
        if thresholds is not None and self.threshold_source == "video":
            low, high = thresholds
        nominal = max(low, high)
        sigma = self.noise_sigma[1] * (nominal if self.noise_scales_with_threshold else 1.0)
        hot = self.hot_pixel_sigma[1] if self.hot_pixel_share[1] else 0.0
        brightest = 1.0 if self.light == "sdr" else BRIGHTEST
        ends = math.log(self.log_eps[0]), math.log1p(self.log_eps[1] + (brightest - 1.0))
        unit = step_seconds if self.noise_unit == "second" else 1.0
        rate = self.frame_stride / step_seconds
        steps = self.spans * int(self.steps_at(rate)) + int(self.run_in_at(rate)) // self.frame_stride
        segments = self.most_segments(steps, levels_per_step)
        worst = worst_of({name: getattr(self, name) for name in effect_settings()}, segments, steps * step_seconds)
        return most_events(segments, ends, (low, high), steps * (sigma * math.sqrt(unit) + hot * unit), *worst)

    def warn(self, say: Callable[[str], object] = _LOG.warning) -> None:
        """Warn of values that no real camera has, each once in a process."""
        warn_unusual("recipe ", {name: getattr(self, name) for name in settings_of(Recipe)}, say)

    def to_dict(self) -> dict[str, Any]:
        """Return all fields as plain values: ranges as lists, without those of later releases that are at their
        defaults.
        """
        plain = {
            name: list(value) if isinstance(value, tuple) else value for name, value in Persisted.to_dict(self).items()
        }
        # A fixed value is written as a number: older digests depend on this form.
        low, high = self.log_eps
        return plain | {"log_eps": low} if low == high else plain

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Recipe:
        """Build a recipe from plain values.

        Args:
            values: fields by name; missing ones are those of the recipe that ``preset`` names, by default ``paper``.

        Raises:
            RecipeError: an unknown key (the nearest known one is named), an unknown recipe, a bad value.
        """
        rest = dict(values)
        base = preset(rest.pop("preset", DEFAULT_PRESET))
        return base.replace(**{str(key): value for key, value in rest.items()})  # YAML keys may be numbers: {1: 2}

    def replace(self, /, **changes: Any) -> Recipe:
        """Return this recipe with some fields changed.

        Raises:
            RecipeError: an unknown key or a bad value.
        """
        require_known(changes, settings_of(Recipe), "recipe key", RecipeError)
        return dataclasses.replace(self, **changes)


def warn_unusual(side: str, values: Mapping[str, Any], say: Callable[[str], object] = _LOG.warning) -> None:
    """Warn of checked values that no real camera has, each once in a process.

    Args:
        side: what the names belong to, for the text.
        values: of fields of a recipe, by name; ``threshold_pos`` and ``threshold_neg`` are thresholds.
    """
    known = settings_of(Recipe)
    for name, value in values.items():
        setting = known["threshold" if name in ("threshold_pos", "threshold_neg") else name]
        _say_once(setting.warning(f"warning: {side}{name}", value), say)


def _say_once(line: str, say: Callable[[str], object] = _LOG.warning) -> None:
    if line and line not in _WARNED:
        _WARNED.add(line)
        say(line)


@cache
def effect_settings() -> Mapping[str, Setting]:
    """Return the fields of a recipe that switch on an effect beyond the paper's model."""
    return {name: setting for name, setting in settings_of(Recipe).items() if setting.group == EFFECTS_SECTION}


PRESETS: dict[str, Recipe] = {name: Recipe(**fields) for name, fields in PRESET_FIELDS.items()}


def preset(name: object) -> Recipe:
    """Return the recipe with this name; warn once in a process if it is deprecated.

    Raises:
        RecipeError: there is no such recipe; the message lists them.
    """
    if not isinstance(name, str) or name not in PRESETS:
        near, known = nearest(name, LISTED), ", ".join(LISTED)
        near = f": it is a preset of the stream, --preset {name}" if str(name) in STREAM_PRESETS else near
        raise RecipeError(f"unknown recipe {format_value(name)}{near}; known: {known}, or a file that ends in .yaml")
    if name in DEPRECATED:
        _say_once(f"warning: recipe {name} is deprecated: give {DEPRECATED[name]}. Samples of {name} stay as they are.")
    return PRESETS[name]
