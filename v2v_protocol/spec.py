"""The stream specification: everything a consumer may ask for that changes the bytes of its samples."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal, TypedDict, get_args

from v2v_protocol.errors import UsageError
from v2v_protocol.recipe import LARGEST_SIDE_PX, Recipe, preset
from v2v_protocol.settings import check_settings, format_value, nearest, require_known, settings_of, switch, whole, word

VoxelDtype = Literal["int8", "int16", "float32"]
OnBadVideo = Literal["substitute", "raise"]
FlowMethod = Literal["auto", "zero", "dis-ultrafast", "dis-fast", "dis-fast-lean", "dis-fast-1"]
FlowDirection = Literal["forward", "backward"]
SceneChoice = Literal["off", "auto"]
SpeedPreset = Literal["exact", "balanced", "fast"]
VOXEL_DTYPES: tuple[VoxelDtype, ...] = get_args(VoxelDtype)
FLOW_METHODS: tuple[FlowMethod, ...] = get_args(FlowMethod)
ON_BAD_VIDEO: tuple[OnBadVideo, ...] = get_args(OnBadVideo)
FLOW_DIRECTIONS: tuple[FlowDirection, ...] = get_args(FlowDirection)
SCENES: tuple[SceneChoice, ...] = get_args(SceneChoice)
MOST_SAMPLES_PER_DECODE = 32


@dataclass(frozen=True, slots=True)
class StreamSpec:
    """What a stream is made of, apart from the videos and the seed.

    Two streams of equal digest over equal catalogues, seeds and numerics versions are equal byte for byte. What does
    not change a draw (asked arrays, batch size, compression) is deliberately not here.

    Attributes:
        recipe: the virtual cameras and views to draw from.

    The K samples of one decode (``samples_per_decode``) are no more alike in their cameras than any others, but they
    show the same scene. An epoch has K samples of every sequence, ``sibling_spacing`` apart
    (``v2v_server.schedule.epoch``).

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
    shuffle: bool = switch(True, "another order in every epoch; false is the catalogue's order")
    max_sequences_per_video: int = whole(10, 1, 1_000_000, "most sequences that one video contributes to an epoch")
    on_bad_video: OnBadVideo = word(
        "substitute", OnBadVideo,
        "what becomes of a sample whose video fails: substitute makes it from the next candidate and says so in the "
        "provenance; raise makes the consumer raise SampleUnavailable",
    )  # fmt: skip
    samples_per_decode: int = whole(
        1, 1, MOST_SAMPLES_PER_DECODE,
        "K, samples made from each decoded clip, each with a camera, crop, flip and pauses of its own",
    )  # fmt: skip
    sibling_spacing: int = whole(
        0,
        0,
        2**40,
        "how far apart in the epoch those K samples are; 0: a batch of the consumer, so that none holds two",
    )
    flow_method: FlowMethod = word(
        "auto", FlowMethod,
        "how flow is estimated where it is asked for; auto chooses for each step by how much moves",
        group="Flow",
    )  # fmt: skip
    flow_direction: FlowDirection = word(
        "forward", FlowDirection, "on the grid of a step's earlier frame (forward) or of its later one (backward)"
    )
    flow_from: int = whole(0, 0, 1_000_000, "flow of the voxels before this one is not computed but zero")
    flow_margin_px: int = whole(
        64, -1, LARGEST_SIDE_PX, "flow is estimated on the crop and this much of the picture around it; -1: on all",
        unit="px",
    )  # fmt: skip
    scene: SceneChoice = word(
        "off", SceneChoice,
        "auto decodes all videos once, leaves out sequences with a cut or with nothing to see, and spares flow where "
        "nothing moves (if flow_method is auto)",
        group="Scene",
    )  # fmt: skip

    def __post_init__(self) -> None:
        check_settings(self, "spec {}".format)
        if self.flow_from > self.recipe.voxels_per_clip:
            raise UsageError(
                f"spec flow_from = {self.flow_from}: give a whole number from 0 to the recipe's voxels_per_clip "
                f"= {self.recipe.voxels_per_clip}"
            )
        if self.samples_per_decode == 1 and self.sibling_spacing:
            raise UsageError(
                f"spec sibling_spacing = {self.sibling_spacing} says how far apart the samples of one decode are, and "
                "samples_per_decode is 1: leave it 0, or ask for more samples_per_decode"
            )

    def spaced(self, stride: int) -> StreamSpec:
        """This spec with its ``sibling_spacing`` settled.

        Args:
            stride: samples from the beginning of one batch of the consumer to that of its next.
        """
        if self.samples_per_decode == 1 or self.sibling_spacing:
            return self
        return dataclasses.replace(self, sibling_spacing=stride)

    def to_dict(self) -> dict[str, Any]:
        """All fields as plain values."""
        plain = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return plain | {"recipe": self.recipe.to_dict()}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any], default: StreamSpec | None = None) -> StreamSpec:
        """A spec from what somebody asked for.

        Args:
            values: fields by name; ``recipe`` is a preset's name or a mapping of recipe fields (see
                :meth:`Recipe.from_dict`); a missing or None field takes the value of ``default``. ``preset`` names one
                of :data:`SPEED_PRESETS`, which the other fields may change.
            default: the server's own spec; the paper's when None.

        Raises:
            RecipeError, UsageError: an unknown key or a bad value.
        """
        base = cls() if default is None else default
        if values.get("preset") is not None:
            base = speed_preset(values["preset"], base)
        require_known(values, SPEC_KEYS, "spec key")
        changes = {key: value for key, value in values.items() if key != "preset" and value is not None}
        if "recipe" in changes:
            changes["recipe"] = _recipe(changes["recipe"], base.recipe)
        if changes.get("samples_per_decode") == 1:
            changes.setdefault("sibling_spacing", 0)
        return dataclasses.replace(base, **changes)

    def canonical(self) -> bytes:
        """The one encoding of this spec that its digest is taken of: JSON, keys sorted, no spaces."""
        return _canonical(self)

    @property
    def digest(self) -> str:
        """32 hexadecimal digits that name this spec."""
        return _digest(self)


class SpecOptions(TypedDict, total=False):
    """What a consumer may ask for besides its recipe, as keyword arguments, for editors and type checkers; None takes
    the server's value. A test holds it to the fields of :class:`StreamSpec`, which say what each is."""

    preset: SpeedPreset | None
    voxel_dtype: VoxelDtype | None
    shuffle: bool | None
    max_sequences_per_video: int | None
    on_bad_video: OnBadVideo | None
    samples_per_decode: int | None
    sibling_spacing: int | None
    flow_method: FlowMethod | None
    flow_direction: FlowDirection | None
    flow_from: int | None
    flow_margin_px: int | None
    scene: SceneChoice | None


SPEC_KEYS = ("preset", "recipe", *settings_of(StreamSpec))
"""What :meth:`StreamSpec.from_dict` takes."""


# Asked for with every lease, and a spec never changes.
@lru_cache(maxsize=64)
def _canonical(spec: StreamSpec) -> bytes:
    return json.dumps(spec.to_dict(), sort_keys=True, separators=(",", ":"), allow_nan=False).encode()


@lru_cache(maxsize=64)
def _digest(spec: StreamSpec) -> str:
    return hashlib.sha256(b"v2v spec 1\n" + _canonical(spec)).hexdigest()[:32]


SPEED_PRESETS: dict[str, dict[str, Any]] = {
    "exact": {"samples_per_decode": 1},
    "balanced": {"samples_per_decode": 2},
    "fast": {"samples_per_decode": 4},
}
"""What speed is bought with: the fields of the spec that each preset sets. `docs/accuracy.md` says why these."""


def speed_preset(name: object, base: StreamSpec) -> StreamSpec:
    """``base`` with the settings of a speed preset.

    Raises:
        UsageError: no such preset.
    """
    if not isinstance(name, str) or name not in SPEED_PRESETS:
        near, known = nearest(name, SPEED_PRESETS), ", ".join(SPEED_PRESETS)
        raise UsageError(f"unknown preset {format_value(name)}{near}; known: {known}")
    return dataclasses.replace(base, sibling_spacing=0, **SPEED_PRESETS[name])


def _recipe(value: object, base: Recipe) -> Recipe:
    if isinstance(value, Recipe):
        return value
    if isinstance(value, Mapping):
        named = {str(key): item for key, item in value.items()}
        return Recipe.from_dict(named) if "preset" in named else base.replace(**named)
    return preset(value)
