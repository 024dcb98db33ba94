"""The stream specification: everything a consumer may request that changes the bytes of its samples."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal, get_args

from v2v_protocol.errors import RecipeError, UsageError
from v2v_protocol.persisted import Persisted, always_written
from v2v_protocol.recipe import LARGEST_EVENTS, LARGEST_SIDE_PX, STREAM_PRESETS, Recipe, preset
from v2v_protocol.settings import (
    check_settings,
    format_value,
    nearest,
    number,
    require_known,
    settings_of,
    switch,
    text,
    whole,
    word,
)

VoxelDtype = Literal["int8", "int16", "float32"]
OnBadVideo = Literal["substitute", "raise"]
FlowMethod = Literal["auto", "zero", "dis-ultrafast", "dis-fast", "dis-fast-lean", "dis-fast-1"]
FlowDirection = Literal["forward", "backward"]
SceneChoice = Literal["off", "auto"]
VOXEL_DTYPES: tuple[VoxelDtype, ...] = get_args(VoxelDtype)
SCENES: tuple[SceneChoice, ...] = get_args(SceneChoice)
DEFECTS = ("bars", "black", "combed", "cuts", "duplicates", "fades", "white")
"""What scene "auto" finds in a video and leaves out."""
MOST_SAMPLES_PER_DECODE = 32
MOST_SUBSTEPS = 16
"""Largest number of sub-steps of a step between video frames."""
MARGIN_PX = 16
"""Margin around the crop that sub-steps are made from."""
_OF_SCENES = {"quiet_share": 1.0, "moving_share": 0.0}
"""Fields that scene "off" admits at these values only."""


@dataclass(frozen=True, slots=True)
class StreamSpec(Persisted):
    """Definition of a stream, apart from the videos and the seed.

    Two streams of equal digest over equal catalogues, seeds and numerics versions are equal byte for byte. Settings
    that do not change a draw (requested arrays, batch size, compression) are deliberately not here.

    Attributes:
        recipe: the virtual cameras and views to draw from.

    The K samples of one decode (``samples_per_decode``) have independent cameras like any other samples, but they show
    the same scene. An epoch has K samples of every sequence, ``sibling_spacing`` apart (``v2v_server.schedule``).

    Raises:
        UsageError: a value outside its choices or limits.
    """

    recipe: Recipe = dataclasses.field(default_factory=Recipe)
    voxel_dtype: VoxelDtype = word(
        "int8", VoxelDtype,
        "int8 saturates at -127 .. 127 and int16 at -32767 .. 32767, and saturated bins are counted in the provenance; "
        "float32 is exact up to 2**24 events a bin",
        group="Stream",
    )  # fmt: skip
    shuffle: bool = switch(True, "use another random order in every epoch; false keeps the catalogue's order")
    max_sequences_per_video: int = whole(10, 1, 1_000_000, "largest number of sequences from one video in an epoch")
    on_bad_video: OnBadVideo = word(
        "substitute", OnBadVideo,
        "if the video of a sample fails: substitute makes the sample from the next candidate and notes it in the "
        "provenance; raise raises SampleUnavailable in the consumer",
    )  # fmt: skip
    samples_per_decode: int = whole(
        1, 1, MOST_SAMPLES_PER_DECODE,
        "K, number of samples from each decoded clip, each with its own camera, crop, flip and pauses",
    )  # fmt: skip
    sibling_spacing: int = whole(
        0,
        0,
        2**40,
        "distance of these K samples in the epoch; 0: one batch of the consumer, so no batch holds two",
    )
    flow_method: FlowMethod = word(
        "auto", FlowMethod,
        "method that estimates flow, if flow is requested; auto chooses for each step by the amount of motion",
        group="Flow",
    )  # fmt: skip
    flow_direction: FlowDirection = word(
        "forward", FlowDirection, "flow on the pixel grid of a step's earlier frame (forward) or later frame (backward)"
    )
    flow_from: int = whole(
        0, 0, 1_000_000, "index of the first voxel grid with computed flow; flow of earlier grids is zero"
    )
    flow_margin_px: int = whole(
        64, -1, LARGEST_SIDE_PX, "margin around the crop in which flow is also estimated; -1: the whole picture",
        unit="px",
    )  # fmt: skip
    scene: SceneChoice = word(
        "off", SceneChoice,
        "auto decodes all videos once, drops repeated frames, leaves out bars, cuts, fades, combed pictures and what "
        "shows nothing, and skips flow where nothing moves (if flow_method is auto)",
        group="Scene",
    )  # fmt: skip
    keep_defects: str = text(
        "", f"what scene auto serves as it is, with commas between; of {', '.join(DEFECTS)}", is_later=True
    )
    still_share: float = number(0.1, 0.0, 1.0, "share of the still sequences that scene auto serves", is_later=True)
    quiet_share: float = number(
        1.0,
        0.0,
        1.0,
        "share of the quiet sequences, in which little of the picture changes, that scene auto serves",
        is_later=True,
    )
    moving_share: float = number(
        0.0,
        0.0,
        1.0,
        "share of the samples whose crop is drawn with weight by how much changes there (scene auto)",
        is_later=True,
    )
    substep_px: float = number(
        0.0, 0.0, 64.0,
        "longest motion that a pixel model sees as one step: a step in which the picture moves further is divided, at "
        f"most {MOST_SUBSTEPS} times, by pictures made along the motion; 0: light changes evenly between two frames",
        unit="px",
        group="Motion",
        is_later=True,
    )  # fmt: skip
    tolerance: float = number(
        0.0, 0.0, 0.0,
        "it left effects out of clips that they change little, which saved hardly any time; all are simulated",
        is_hidden=True,
        is_later=True,
    )  # fmt: skip

    def __post_init__(self) -> None:
        check_settings(self, "spec {}".format)
        kinds = sorted({kind.strip() for kind in self.keep_defects.split(",")} - {""})
        require_known(kinds, DEFECTS, "kind in spec keep_defects")
        object.__setattr__(self, "keep_defects", ",".join(kinds))
        for name, default in _OF_SCENES.items():
            if (share := getattr(self, name)) != default and self.scene == "off":
                raise UsageError(
                    f'spec {name} = {share:g} applies only to scene = "auto", which is "off": set {name} = '
                    f"{default:g}, or scene = auto"
                )
        if self.flow_from > self.recipe.voxels_per_clip:
            raise UsageError(
                f"spec flow_from = {self.flow_from}: give a whole number from 0 to the recipe's voxels_per_clip "
                f"= {self.recipe.voxels_per_clip}"
            )
        most_events = self.recipe.worst_events(1.0, levels_per_step=self.levels_per_step)
        if most_events > LARGEST_EVENTS:
            name = "substep_px" if self.substep_px else "world_change_share"
            value = self.substep_px or self.recipe.world_change_share
            raise UsageError(
                f"spec {name} = {value:g}: a pixel may fire {most_events:.4g} events in a clip; the "
                f"limit is {LARGEST_EVENTS:.4g}: raise the recipe's smallest threshold, or set {name} to 0"
            )
        if self.samples_per_decode == 1 and self.sibling_spacing:
            raise UsageError(
                f"spec sibling_spacing = {self.sibling_spacing} applies only to samples_per_decode above 1, which is "
                "1: set sibling_spacing = 0, or raise samples_per_decode"
            )

    @property
    def levels_per_step(self) -> int:
        """Return the largest number of levels between two frames."""
        return MOST_SUBSTEPS - 1 if self.substep_px or self.recipe.world_change_share else 0

    @property
    def kept_defects(self) -> frozenset[str]:
        """Return the defects that are served as they are: all with scene "off"."""
        return frozenset(DEFECTS if self.scene == "off" else filter(None, self.keep_defects.split(",")))

    def spaced(self, stride: int) -> StreamSpec:
        """Return this spec with its ``sibling_spacing`` set.

        Args:
            stride: samples from the beginning of one batch of the consumer to that of its next.
        """
        if self.samples_per_decode == 1 or self.sibling_spacing:
            return self
        return dataclasses.replace(self, sibling_spacing=stride)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any], default: StreamSpec | None = None) -> StreamSpec:
        """Build a spec from requested values.

        Args:
            values: fields by name; ``recipe`` is a preset's name or a mapping of recipe fields (see
                :meth:`Recipe.from_dict`); a missing or None field takes the value of ``default``. ``preset`` names one
                of :data:`STREAM_PRESETS`, which the other fields may change.
            default: the server's own spec; the paper's if None.

        Raises:
            RecipeError, UsageError: an unknown key or a bad value.
        """
        is_complete = always_written(cls) - {"recipe"} <= values.keys()
        base = cls() if default is None or is_complete else default
        if values.get("preset") is not None:
            base = speed_preset(values["preset"], base)
        require_known(values, SPEC_KEYS, "spec key")
        changes = {key: value for key, value in values.items() if key != "preset" and value is not None}
        if "recipe" in changes:
            changes["recipe"] = _recipe(changes["recipe"], base.recipe)
        if changes.get("samples_per_decode") == 1:
            changes.setdefault("sibling_spacing", 0)
        if changes.get("scene") == "off":
            changes = _OF_SCENES | changes
        return dataclasses.replace(base, **changes)

    def canonical(self) -> bytes:
        """Return the canonical encoding that the digest is computed from: JSON, keys sorted, no spaces."""
        return _canonical(self)

    @property
    def digest(self) -> str:
        """32 hexadecimal digits that name this spec."""
        return _digest(self)


SPEC_KEYS = ("preset", "recipe", *settings_of(StreamSpec))
"""What :meth:`StreamSpec.from_dict` takes."""


# Cached: every lease uses it, and a spec never changes.
@lru_cache(maxsize=64)
def _canonical(spec: StreamSpec) -> bytes:
    return json.dumps(spec.to_dict(), sort_keys=True, separators=(",", ":"), allow_nan=False).encode()


@lru_cache(maxsize=64)
def _digest(spec: StreamSpec) -> str:
    return hashlib.sha256(b"v2v spec 1\n" + _canonical(spec)).hexdigest()[:32]


def speed_preset(name: object, base: StreamSpec) -> StreamSpec:
    """Return ``base`` with the settings of a preset.

    Raises:
        UsageError: there is no such preset.
    """
    if not isinstance(name, str) or name not in STREAM_PRESETS:
        near, known = nearest(name, STREAM_PRESETS), ", ".join(STREAM_PRESETS)
        raise UsageError(f"unknown preset {format_value(name)}{near}; known: {known}")
    fields: dict[str, Any] = {
        key: preset(value) if key == "recipe" else value for key, value in STREAM_PRESETS[name].items()
    }
    return dataclasses.replace(base, sibling_spacing=0, **fields)


def _recipe(value: object, base: Recipe) -> Recipe:
    if isinstance(value, Recipe):
        return value
    if isinstance(value, Mapping):
        named = {str(key): item for key, item in value.items()}
        settings = settings_of(StreamSpec)
        for key in settings.keys() & named.keys():
            settings[key].check(f"spec {key}", named[key], RecipeError)
            flag = f"--{key.replace('_', '-')}"
            raise RecipeError(
                f"recipe key {key!r} is a setting of the stream: give {key}={format_value(named[key])} beside the "
                f"recipe, or {flag} {named[key]} instead of --set on a command line"
            )
        is_complete = always_written(Recipe) <= named.keys()
        return Recipe.from_dict(named) if "preset" in named or is_complete else base.replace(**named)
    return preset(value)
