"""Check the options with which a consumer requests a stream: those that change its samples' bytes. Pure."""

from __future__ import annotations

import dataclasses
import inspect
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from v2v_client.position import StreamIdentity
from v2v_protocol.errors import SampleUnavailable, UsageError
from v2v_protocol.recipe import Recipe
from v2v_protocol.sample import Provenance, array_layout
from v2v_protocol.settings import format_value, nearest, plain, settings_of
from v2v_protocol.spec import MOST_SAMPLES_PER_DECODE, SPEC_KEYS, StreamSpec
from v2v_protocol.spec_flags import read_recipe

Labels = Literal["required", "optional"]
# Fields left to the server may have any value, so an option that fits at least one of them is accepted here.
_ANY = StreamSpec(samples_per_decode=MOST_SAMPLES_PER_DECODE, scene="auto")
_LONGEST = Recipe(voxels_per_clip=1_000_000, bins=1)


@dataclass(frozen=True, slots=True)
class Patience:
    """Hold a consumer's timeouts.

    Attributes:
        ping_seconds: silence after which the server is pinged, and the interval of further pings. It is at most half of
            ``timeout_seconds``, so that the server is always pinged before it counts as lost.
        rewant_seconds: time without an answer to any request after which all are sent again, although the server is
            alive: a network interruption can lose messages in either direction. If nothing was received in that time,
            a new connection is opened. The interval doubles each time, up to ``timeout_seconds``, so that a slow
            network is neither flooded nor abandoned before it can answer.
        timeout_seconds: silence after which the server counts as lost, and time without a sample after which a server
            without workers does.
        takeover_seconds: with several brokers, silence after which the next one is tried. ServerLost is raised after
            ``timeout_seconds``, once each of them has had its turn.

    Raises:
        UsageError: a time is not positive.
    """

    timeout_seconds: float = 60.0
    ping_seconds: float = 2.0
    rewant_seconds: float = 10.0
    takeover_seconds: float = 10.0

    def __post_init__(self) -> None:
        for name in ("timeout_seconds", "ping_seconds", "rewant_seconds", "takeover_seconds"):
            value = plain(getattr(self, name))
            if not isinstance(value, int | float) or not value > 0:
                raise UsageError(f"{name} = {getattr(self, name)!r}: give a positive number of seconds")


class Fixed:
    """Refuse to assign the arguments that a dataset was created with: the assignment would have no effect."""

    def __setattr__(self, name: str, value: Any) -> None:
        """Set an attribute.

        Raises:
            AttributeError: it is an argument of the dataset.
        """
        is_given = name in inspect.signature(type(self).__init__).parameters or name in SPEC_KEYS
        if is_given or isinstance(getattr(type(self), name, None), property):
            remedy = "call set_epoch" if name == "epoch" else f"create another one with {name}=..."
            raise AttributeError(
                f"dataset.{name} = {format_value(value)}: it is fixed when the dataset is created; {remedy}"
            )
        super().__setattr__(name, value)


class Options:
    """Hold fields of a StreamSpec by name. The server decides those that are None.

    Args:
        arrays: names of the requested arrays. They do not change the samples' bytes, but must be known.
        fields: see :meth:`v2v_protocol.spec.StreamSpec.from_dict`; ``recipe`` may be a Recipe.

    Raises:
        UsageError: a value is outside its limits, or an array is unknown. Conflicts with the server's own spec are
            reported by the server.
    """

    def __init__(self, arrays: tuple[str, ...], **fields: Any) -> None:
        fields = fields | {"recipe": _plain(fields.get("recipe"))}
        self._asked = {name: plain(value) for name, value in fields.items() if value is not None}
        spec = StreamSpec.from_dict(self._asked | {"flow_from": None}, default=_ANY)
        array_layout(spec.recipe, spec.voxel_dtype, arrays)
        asked = self._asked.get("recipe", {})
        is_ours = isinstance(asked, str) or not {"preset", "voxels_per_clip"}.isdisjoint(asked)
        clip = StreamSpec(recipe=spec.recipe if is_ours else _LONGEST)
        StreamSpec.from_dict({"flow_from": self._asked.get("flow_from")}, default=clip)

    def spec(self, pinned: StreamIdentity | None, side: str) -> Mapping[str, Any]:
        """Return the spec to request from the server: a pinned stream's spec, or else these options.

        Args:
            pinned: the stream already begun; None if there is none.
            side: what pinned it, in words for the message of a mismatch.

        Raises:
            StateMismatch: the options contradict the pinned stream.
        """
        if pinned is None:
            return dict(self._asked)
        spec = StreamSpec.from_dict(self._asked, default=pinned.resolved)
        if not spec.sibling_spacing:
            spec = spec.spaced(pinned.resolved.sibling_spacing)
        ours = dataclasses.replace(pinned, spec=spec.to_dict(), spec_digest=spec.digest)
        ours.require_same(pinned, ours="the options given to this dataset", theirs=side)
        return dict(pinned.spec)


def require_arguments(function: Callable[..., Any], options: Mapping[str, Any]) -> None:
    """Check the names of keyword arguments.

    Args:
        function: its named parameters are listed among the known arguments.
        options: fields of a StreamSpec by name, as the caller gave them.

    Raises:
        UsageError: a name is not a field of a StreamSpec.
    """
    named = [name for name in inspect.signature(function).parameters if name not in ("self", "options")]
    known = dict.fromkeys((*named, *SPEC_KEYS))
    for name in options:
        if name not in SPEC_KEYS:
            hint = f": it belongs to the recipe, recipe={{{name!r}: ...}}" if name in settings_of(Recipe) else ""
            hint = hint or nearest(name, known)
            if "flags" in named and hint in ("", nearest("flags", known)):
                flag = "--bind" if name == "port" else f"--{name.replace('_', '-')}"
                hint = f'; if it is a flag of v2v-serve: flags=["{flag}", "..."]'
            raise UsageError(f"no argument {name!r}{hint}; known: {', '.join(known)}")


def require_videos(videos: str | os.PathLike[str]) -> str:
    """Return the path of the videos.

    Raises:
        UsageError: it is no path.
    """
    if not isinstance(videos, str | os.PathLike):
        raise UsageError(f"videos = {format_value(videos)}: give one folder, video, or list file with a path a line")
    return os.fspath(videos)


def check_labels(labels: str) -> bool:
    """Return whether samples without their labels are errors.

    Raises:
        UsageError: the option is neither "required" nor "optional".
    """
    if labels not in ("required", "optional"):
        raise UsageError(f'labels = {labels!r}: choose "required" or "optional"')
    return labels == "required"


def require_labels(provenances: Sequence[Provenance]) -> None:
    """Check that samples have all labels that were requested.

    Raises:
        SampleUnavailable: one has not. The message names the file, the reason and the remedy.
    """
    for origin in provenances:
        for name, why in origin.unlabelled.items():
            raise SampleUnavailable(
                "unlabelled",
                f"sample {origin.id.index} of epoch {origin.id.epoch} has no {name}: {why}. Correct the file and "
                'restart the server, leave the video out, or create the dataset with labels="optional" and use '
                "batch.labelled",
            )


def _plain(recipe: Any) -> Any:
    """Copy a recipe into plain values, because the caller may change a mapping for the next dataset."""
    recipe = read_recipe(recipe)
    if isinstance(recipe, Recipe):
        return recipe.to_dict()
    if not isinstance(recipe, Mapping):
        return recipe
    recipe = {key: plain(value) for key, value in recipe.items()}
    return {key: list(value) if isinstance(value, list | tuple) else value for key, value in recipe.items()}
