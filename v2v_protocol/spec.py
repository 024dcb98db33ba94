"""The stream specification: everything a consumer may ask for that changes the bytes of its samples."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from v2v_protocol.errors import UsageError
from v2v_protocol.recipe import Recipe, preset

FLOW_METHODS = (
    "auto", "zero", "dis-ultrafast", "dis-ultrafast-1", "dis-fast", "dis-fast-lean", "dis-fast-1",
    "dis-fast-1-stride-6", "dis-medium", "dis-medium-0",
    "farneback", "sparse-to-dense", "deepflow",
)  # fmt: skip
FLOW_DIRECTIONS = ("forward", "backward")
LARGEST_FLOW_MARGIN_PX = 16_384
MOST_SAMPLES_PER_DECODE = 32
SCENES = ("off", "auto")
VOXEL_DTYPES = ("int8", "int16", "float32")
LOOP_FILTERS = ("exact", "skip-unreferenced", "skip")
ON_BAD_VIDEO = ("substitute", "raise")


@dataclass(frozen=True, slots=True)
class StreamSpec:
    """What a stream is made of, apart from the videos and the seed.

    Two streams of equal digest over equal catalogues, seeds and numerics versions are equal byte for byte. What does
    not change a draw (asked arrays, batch size, compression) is deliberately not here.

    Attributes:
        recipe: the virtual cameras and views to draw from.
        voxel_dtype: "int8" saturates at -127 .. 127 and counts the saturated bins in the provenance; "int16"
            saturates at -32767 .. 32767 likewise; "float32" is exact up to 2**24 events a bin.
        shuffle: False streams the sequences in catalogue order in every epoch.
        max_sequences_per_video: most sequences one video contributes to an epoch (paper: 10).
        on_bad_video: "substitute" serves the next candidate of an index whose video fails, and says so in the
            provenance; "raise" makes the consumer raise SampleUnavailable.
        loop_filter: "exact" decodes as the standard says; "skip-unreferenced" leaves out the deblocking of frames that
            no other frame refers to, "skip" that of all frames: faster where the decoder knows how (H.264, HEVC, VP8,
            VP9), at the price of visible blocks.
        samples_per_decode: K, samples made from each decoded clip, each with a camera, crop, flip and pauses of its
            own. They are no more alike in their cameras than any others, but they show the same scene. An epoch has K
            samples of every sequence.
        sibling_spacing: how far apart in the epoch those K are (``v2v_server.schedule.epoch``); 0 where K = 1. A
            consumer that leaves it 0 with K > 1 gets its own stride from batch to batch, so that no batch holds two.
        flow_method: how flow is estimated where it is asked for; "auto" chooses for each step by how much moves.
        flow_direction: "forward", on the grid of a step's earlier frame, or "backward", on that of the later one.
        flow_from: flow of the voxels before this one is not computed but zero.
        flow_margin_px: flow is estimated on the crop and this much of the picture around it; -1: on all of it.
        scene: "off" treats all clips alike; "auto" leaves out sequences with a cut or with nothing to see, and chooses
            the flow of each step where ``flow_method`` is "auto", both by statistics that the catalogue must have.

    Raises:
        UsageError: a value outside its choices or limits.
    """

    recipe: Recipe = dataclasses.field(default_factory=Recipe)
    voxel_dtype: str = "int8"
    shuffle: bool = True
    max_sequences_per_video: int = 10
    on_bad_video: str = "substitute"
    loop_filter: str = "exact"
    samples_per_decode: int = 1
    sibling_spacing: int = 0
    flow_method: str = "auto"
    flow_direction: str = "forward"
    flow_from: int = 0
    flow_margin_px: int = 64
    scene: str = "off"

    def __post_init__(self) -> None:
        _choose("voxel_dtype", self.voxel_dtype, VOXEL_DTYPES)
        _choose("on_bad_video", self.on_bad_video, ON_BAD_VIDEO)
        _choose("loop_filter", self.loop_filter, LOOP_FILTERS)
        _choose("flow_method", self.flow_method, FLOW_METHODS)
        _choose("flow_direction", self.flow_direction, FLOW_DIRECTIONS)
        _choose("scene", self.scene, SCENES)
        _whole("flow_from", self.flow_from, 0, self.recipe.voxels_per_clip)
        _whole("flow_margin_px", self.flow_margin_px, -1, LARGEST_FLOW_MARGIN_PX)
        if not isinstance(self.shuffle, bool):
            raise UsageError(f"spec shuffle = {self.shuffle!r}: give true or false")
        _whole("max_sequences_per_video", self.max_sequences_per_video, 1, 1_000_000)
        _whole("samples_per_decode", self.samples_per_decode, 1, MOST_SAMPLES_PER_DECODE)
        _whole("sibling_spacing", self.sibling_spacing, 0, 2**40)
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
        known = [field.name for field in dataclasses.fields(cls)]
        changes: dict[str, Any] = {}
        for key, value in values.items():
            if key == "preset" or value is None:
                continue
            if key not in known:
                raise UsageError(f"unknown spec key {key!r}; known: preset, {', '.join(known)}")
            changes[key] = _recipe(value, base.recipe) if key == "recipe" else value
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


# Asked for with every lease, and a spec never changes.
@lru_cache(maxsize=64)
def _canonical(spec: StreamSpec) -> bytes:
    return json.dumps(spec.to_dict(), sort_keys=True, separators=(",", ":"), allow_nan=False).encode()


@lru_cache(maxsize=64)
def _digest(spec: StreamSpec) -> str:
    return hashlib.sha256(b"v2v spec 1\n" + _canonical(spec)).hexdigest()[:32]


SPEED_PRESETS: dict[str, dict[str, Any]] = {
    "exact": {"samples_per_decode": 1, "loop_filter": "exact"},
    "balanced": {"samples_per_decode": 2, "loop_filter": "exact"},
    "fast": {"samples_per_decode": 4, "loop_filter": "exact"},
}
"""What speed is bought with: the fields of the spec that each preset sets. `docs/accuracy.md` says why these."""


def speed_preset(name: object, base: StreamSpec) -> StreamSpec:
    """``base`` with the settings of a speed preset.

    Raises:
        UsageError: no such preset.
    """
    if not isinstance(name, str) or name not in SPEED_PRESETS:
        raise UsageError(f"unknown preset {name!r}: choose one of {', '.join(SPEED_PRESETS)}")
    return dataclasses.replace(base, sibling_spacing=0, **SPEED_PRESETS[name])


def _recipe(value: object, base: Recipe) -> Recipe:
    if isinstance(value, Recipe):
        return value
    if isinstance(value, Mapping):
        named = {str(key): item for key, item in value.items()}
        return Recipe.from_dict(named) if "preset" in named else base.replace(**named)
    return preset(value)


def _whole(name: str, value: object, low: int, high: int) -> None:
    if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
        raise UsageError(f"spec {name} = {value!r}: give a whole number from {low} to {high}")


def _choose(name: str, value: object, words: tuple[str, ...]) -> None:
    if value not in words:
        # scene: off in a YAML file, of which the message would show nothing that was written.
        hint = " (YAML reads off as a truth value: put it in quotes)" if value is False and "off" in words else ""
        raise UsageError(f"spec {name} = {value!r}: choose one of {', '.join(words)}{hint}")
