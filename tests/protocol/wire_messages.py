"""Any message, for property tests: strategies derived from the field types the wire knows."""

from __future__ import annotations

import dataclasses
import math
from typing import Any, get_args

from hypothesis import strategies as st

from v2v_protocol.messages import Message

MESSAGES: tuple[type[Any], ...] = get_args(Message)

_words = st.integers(0, 2**64 - 1)
_text = st.text(max_size=20)
_plain = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats(allow_nan=False) | _text | st.binary(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(_text, inner, max_size=3),
    max_leaves=8,
)

BY_ANNOTATION: dict[str, st.SearchStrategy[Any]] = {
    "int": _words,
    "float": st.floats(allow_nan=False, allow_infinity=False),
    "bool": st.booleans(),
    "str": _text,
    "bytes": st.binary(max_size=20),
    "int | None": st.none() | _words,
    "tuple[int, ...]": st.lists(_words, max_size=5).map(tuple),
    "tuple[float, ...]": st.lists(st.floats(allow_nan=False, allow_infinity=False), max_size=5).map(tuple),
    "tuple[str, ...]": st.lists(_text, max_size=5).map(tuple),
    "Mapping[str, Any]": st.dictionaries(_text, _plain, max_size=4),
}

WRONG: dict[str, tuple[Any, ...]] = {
    "int": (-1, True, 1.0, None, "1", b"1", [], {}),
    "float": (math.nan, math.inf, -math.inf, True, None, "1.0", [], {}),
    "bool": (0, 1, None, "true"),
    "str": (None, 1, b"text", [], {}),
    "bytes": (None, 1, "text", [], {}),
    "int | None": (-1, True, 1.0, "1", [], {}),
    "tuple[int, ...]": (None, 1, "12", b"12", {}, [-1], [True], [1.0], [None], [[1]], ["1"]),
    "tuple[float, ...]": (None, 1.0, "12", {}, [math.nan], [True], ["1.0"], [None], [[1.0]]),
    "tuple[str, ...]": (None, 1, "ab", {}, [1], [None], [b"a"], [["a"]]),
    "Mapping[str, Any]": (None, 1, "ab", [], [["a", 1]]),
}
"""Values that a field of that type must refuse."""

EXAMPLE: dict[str, Any] = {
    "int": 1,
    "float": 0.5,
    "bool": True,
    "str": "text",
    "bytes": b"bytes",
    "int | None": None,
    "tuple[int, ...]": (1, 2),
    "tuple[float, ...]": (0.5, 1.0),
    "tuple[str, ...]": ("a", "b"),
    "Mapping[str, Any]": {"key": [1, 2.5, "three", None]},
}


def example(cls: type[Any]) -> Any:
    """One message of that type."""
    return cls(**{field.name: EXAMPLE[str(field.type)] for field in dataclasses.fields(cls)})


def _of(cls: type[Any]) -> st.SearchStrategy[Any]:
    return st.builds(cls, **{field.name: BY_ANNOTATION[str(field.type)] for field in dataclasses.fields(cls)})


messages: st.SearchStrategy[Any] = st.one_of([_of(cls) for cls in MESSAGES])
