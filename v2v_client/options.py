"""What a consumer asks for of a stream: the options that change its samples' bytes. Pure."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

from v2v_client.state import Stream
from v2v_protocol.recipe import Recipe
from v2v_protocol.sample import array_layout
from v2v_protocol.spec import StreamSpec


class Options:
    """Fields of a StreamSpec by name; the server decides those that are None.

    Args:
        arrays: names of the arrays wanted; they change no byte, but must be known.
        fields: see :meth:`v2v_protocol.spec.StreamSpec.from_dict`; ``recipe`` may be a Recipe.

    Raises:
        UsageError: a value outside its limits, or an unknown array: here, and not by the server.
    """

    def __init__(self, arrays: tuple[str, ...], **fields: Any) -> None:
        recipe = fields.get("recipe")
        fields = fields | {"recipe": recipe.to_dict() if isinstance(recipe, Recipe) else recipe}
        self._asked = {name: value for name, value in fields.items() if value is not None}
        spec = StreamSpec.from_dict(self._asked)
        array_layout(spec.recipe, spec.voxel_dtype, arrays)

    def spec(self, pinned: Stream | None, side: str) -> Mapping[str, Any]:
        """What to ask the server for: a pinned stream's spec, which must be what the options say.

        Args:
            pinned: the stream begun; None when there is none.
            side: words for what pinned it.

        Raises:
            StateMismatch: the options ask for another stream.
        """
        if pinned is None:
            return dict(self._asked)
        spec = StreamSpec.from_dict(self._asked, default=pinned.resolved)
        if not spec.sibling_spacing:
            spec = spec.spaced(pinned.resolved.sibling_spacing)
        ours = dataclasses.replace(pinned, spec=spec.to_dict(), spec_digest=spec.digest)
        ours.require_same(pinned, ours="the options given to this dataset", theirs=side)
        return dict(pinned.spec)
