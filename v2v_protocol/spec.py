"""The stream specification: everything a consumer may ask for that changes the bytes of its samples."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from v2v_protocol.errors import UsageError
from v2v_protocol.recipe import Recipe, preset

VOXEL_DTYPES = ("int8", "int16", "float32")
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

    Raises:
        UsageError: a value outside its choices or limits.
    """

    recipe: Recipe = dataclasses.field(default_factory=Recipe)
    voxel_dtype: str = "int8"
    shuffle: bool = True
    max_sequences_per_video: int = 10
    on_bad_video: str = "substitute"

    def __post_init__(self) -> None:
        _choose("voxel_dtype", self.voxel_dtype, VOXEL_DTYPES)
        _choose("on_bad_video", self.on_bad_video, ON_BAD_VIDEO)
        if not isinstance(self.shuffle, bool):
            raise UsageError(f"spec shuffle = {self.shuffle!r}: give true or false")
        most = self.max_sequences_per_video
        if isinstance(most, bool) or not isinstance(most, int) or not 1 <= most <= 1_000_000:
            raise UsageError(f"spec max_sequences_per_video = {most!r}: give a whole number from 1 to 1000000")

    def to_dict(self) -> dict[str, Any]:
        """All fields as plain values."""
        plain = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return plain | {"recipe": self.recipe.to_dict()}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any], default: StreamSpec | None = None) -> StreamSpec:
        """A spec from what somebody asked for.

        Args:
            values: fields by name; ``recipe`` is a preset's name or a mapping of recipe fields (see
                :meth:`Recipe.from_dict`); a missing or None field takes the value of ``default``.
            default: the server's own spec; the paper's when None.

        Raises:
            RecipeError, UsageError: an unknown key or a bad value.
        """
        base = cls() if default is None else default
        known = [field.name for field in dataclasses.fields(cls)]
        changes: dict[str, Any] = {}
        for key, value in values.items():
            if key not in known:
                raise UsageError(f"unknown spec key {key!r}; known: {', '.join(known)}")
            if value is None:
                continue
            changes[key] = _recipe(value, base.recipe) if key == "recipe" else value
        return dataclasses.replace(base, **changes)

    def canonical(self) -> bytes:
        """The one encoding of this spec that its digest is taken of: JSON, keys sorted, no spaces."""
        return json.dumps(self.to_dict(), sort_keys=True, separators=(",", ":"), allow_nan=False).encode()

    @property
    def digest(self) -> str:
        """32 hexadecimal digits that name this spec."""
        return hashlib.sha256(b"v2v spec 1\n" + self.canonical()).hexdigest()[:32]


def _recipe(value: object, base: Recipe) -> Recipe:
    if isinstance(value, Recipe):
        return value
    if isinstance(value, Mapping):
        named = {str(key): item for key, item in value.items()}
        return Recipe.from_dict(named) if "preset" in named else base.replace(**named)
    return preset(value)


def _choose(name: str, value: object, words: tuple[str, ...]) -> None:
    if value not in words:
        raise UsageError(f"spec {name} = {value!r}: choose one of {', '.join(words)}")
