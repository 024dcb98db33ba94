"""What the fields of a :class:`v2v_protocol.recipe.Recipe` may hold: types, limits, words."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from v2v_protocol.errors import RecipeError

LARGEST_SCALE = 100.0
_LARGEST_SIDE_PX = 16_384
SMALLEST_PHOTORECEPTOR_HZ = 0.01

LIMITS_OF_EFFECTS: dict[str, tuple[float, float]] = {
    "threshold_mismatch_sigma": (0.0, 1.0),
    "shot_noise_hz": (0.0, 1e4),
    "leak_hz": (0.0, 1e4),
    "refractory_seconds": (0.0, 1e3),
    "photoreceptor_hz": (0.0, 1e6),
}

LIMITS: dict[str, tuple[float, float]] = {
    "voxels_per_clip": (1, 1_000_000),
    "bins": (1, 1024),
    "frames_per_bin": (1, 1024),
    "lead_frames": (0, 1),
    "lead_voxels": (0, 1),
    "frame_stride": (1, 1000),
    "crop_height_px": (1, _LARGEST_SIDE_PX),
    "crop_width_px": (1, _LARGEST_SIDE_PX),
    "resize_scale": (0.01, LARGEST_SCALE),
    "flip_probability": (0.0, 1.0),
    "pause_probability": (0.0, 1.0),
    "pause_stay_probability": (0.0, 1.0),
    "contrast_probability": (0.0, 1.0),
    "contrast_scale": (0.0, 100.0),
    "gamma": (0.05, 20.0),
    "log_eps": (1e-12, 1.0),
    "threshold": (1e-6, 1e6),
    "threshold_ratio": (1e-6, 1e6),
    "noise_sigma": (0.0, 1e6),
    "hot_pixel_share": (0.0, 1.0),
    "hot_pixel_sigma": (0.0, 1e9),
    **LIMITS_OF_EFFECTS,
    "dead_pixel_share": (0.0, 1.0),
}

CHOICES: dict[str, tuple[str, ...]] = {
    "threshold_source": ("sample", "video"),
    "noise_unit": ("frame", "second"),
}


def coerced(name: str, value: Any, default: Any) -> Any:
    """``value`` in the type of the field's default; a single number stands for a range of equal ends.

    Raises:
        RecipeError: it has another type, is not finite, or is a range whose ends are the wrong way round.
    """
    if isinstance(default, bool):
        if not isinstance(value, bool):
            raise RecipeError(f"recipe {name} = {value!r}: give true or false")
        return value
    if isinstance(default, int):
        if isinstance(value, bool) or not isinstance(value, int):
            raise RecipeError(f"recipe {name} = {value!r}: give a whole number")
        return value
    if isinstance(default, str):
        if not isinstance(value, str):
            raise RecipeError(f"recipe {name} = {value!r}: give a word")
        return value
    if isinstance(default, float):
        return _number(name, value)
    ends = tuple(value) if isinstance(value, list | tuple) else (value, value)
    # 0.2,0.5 without brackets, or 0.2..0.5, is text in YAML.
    if len(ends) != 2 or (isinstance(value, str) and not _reads_as_number(value)):
        raise RecipeError(f"recipe {name} = {value!r}: give one number, or a pair [lowest, highest]")
    low, high = (_number(name, end) for end in ends)
    if low > high:
        raise RecipeError(f"recipe {name} = [{low}, {high}]: the lowest value comes first")
    return low, high


def check_limits(values: Mapping[str, Any]) -> None:
    """
    Args:
        values: of all fields, in their types.

    Raises:
        RecipeError: one is outside its limits; the message names the field, the value and the limit.
    """
    for name, (low, high) in LIMITS.items():
        value = values[name]
        for end in value if isinstance(value, tuple) else (value,):
            if not low <= end <= high:
                raise RecipeError(f"recipe {name} = {_shown(value)}: {end} is outside {low} .. {high}")
    for name, words in CHOICES.items():
        if values[name] not in words:
            raise RecipeError(f"recipe {name} = {values[name]!r}: choose one of {', '.join(words)}")
    lowest, highest = values["photoreceptor_hz"]
    if highest > 0.0 and lowest < SMALLEST_PHOTORECEPTOR_HZ:
        raise RecipeError(
            f"recipe photoreceptor_hz = {_shown(values['photoreceptor_hz'])}: give 0 for no low-pass, or a range from "
            f"{SMALLEST_PHOTORECEPTOR_HZ} upwards"
        )


def _reads_as_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _number(name: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        why = ", not text (which 1e-3 is in YAML: write 1.0e-3)" if isinstance(value, str) else ""
        raise RecipeError(f"recipe {name} = {value!r}: give a number{why}")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise RecipeError(f"recipe {name} = {value!r}: give a finite number")
    # Minus zero equals zero, but would not give the same digest.
    return number + 0.0


def _shown(value: Any) -> str:
    return str(list(value)) if isinstance(value, tuple) else repr(value)
