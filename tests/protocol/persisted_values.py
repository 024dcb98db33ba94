"""Values of every persisted class, for property tests: strategies from the types of its fields, and what fits them."""

from __future__ import annotations

import dataclasses
import math
import os
import typing
from functools import cache
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, get_args, get_origin

from hypothesis import strategies as st

from v2v_protocol.messages import Message
from v2v_protocol.persisted import LARGEST_LIST, MOST_DEPTH

MESSAGES: tuple[type[Any], ...] = get_args(Message)
FLOATS = st.floats(allow_nan=False, allow_infinity=False)
TEXT = st.text(max_size=20)
PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | FLOATS | TEXT | st.binary(max_size=20),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(TEXT, inner, max_size=3),
    max_leaves=8,
)
"""Anything that a record may hold in place of a value."""
_SCALARS: dict[Any, st.SearchStrategy[Any]] = {
    int: st.integers(0, 2**64 - 1),
    float: FLOATS,
    bool: st.booleans(),
    str: TEXT,
    bytes: st.binary(max_size=20),
    NoneType: st.none(),
    Path: st.sampled_from([Path("/a"), Path(os.fsdecode(b"/b\xff"))]),
}


@cache
def hints_of(cls: Any) -> dict[str, Any]:
    hints = typing.get_type_hints(cls, include_extras=True)
    return {field.name: hints[field.name] for field in dataclasses.fields(cls)}


@cache
def values_of(kind: Any) -> st.SearchStrategy[Any]:
    """Values of a type that a field may have."""
    origin, parts = get_origin(kind), get_args(kind)
    if kind in _SCALARS:
        return _SCALARS[kind]
    if origin is Annotated:
        number, (low, high) = parts[0], dataclasses.astuple(parts[1])
        return st.integers(low, high) if number is int else st.floats(low, high)
    if origin in (typing.Union, UnionType):
        return st.one_of(map(values_of, parts))
    if origin is tuple and parts[-1] is ...:
        return st.lists(values_of(parts[0]), max_size=5).map(tuple)
    if origin is tuple:
        return st.tuples(*map(values_of, parts))
    if hasattr(kind, "from_bytes"):
        return st.nothing()  # the bytes of pictures and of their index have tests of their own
    if hasattr(kind, "_make"):
        return st.tuples(*map(values_of, typing.get_type_hints(kind).values())).map(kind._make)
    if origin is not None:
        return st.dictionaries(TEXT, PLAIN if parts[1] is Any else values_of(parts[1]), max_size=4)
    return st.builds(kind, **{name: values_of(hint) for name, hint in hints_of(kind).items()})


def fits(kind: Any, value: Any) -> bool:
    """Whether plain data stands for a value of that type; of another class's fields, whether they are a map."""
    origin, parts = get_origin(kind), get_args(kind)
    if kind is int:
        return type(value) is int and 0 <= value < 2**64
    if kind is float:
        return type(value) in (int, float) and math.isfinite(value)
    if origin is Annotated:
        allowed = (int,) if parts[0] is int else (int, float)
        is_open = parts[1].high == math.inf  # then NaN stands for an unknown value
        return type(value) in allowed and (parts[1].low <= value <= parts[1].high or (is_open and math.isnan(value)))
    if origin in (typing.Union, UnionType):
        return any(fits(part, value) for part in parts)
    if origin is tuple and parts[-1] is ...:
        return isinstance(value, list | tuple) and len(value) <= LARGEST_LIST and all(fits(parts[0], v) for v in value)
    if origin is tuple or hasattr(kind, "_make"):
        hints = parts or tuple(typing.get_type_hints(kind).values())
        return isinstance(value, list | tuple) and len(value) == len(hints) and all(map(fits, hints, value))
    if origin is not None and isinstance(value, dict):
        return depth(value) <= MOST_DEPTH if parts[1] is Any else all(fits(parts[1], v) for v in value.values())
    if kind is Path or (hasattr(kind, "from_bytes") and kind is not bool):
        return type(value) is bytes
    return isinstance(value, dict) if origin is not None or hasattr(kind, "from_dict") else type(value) is kind


def depth(value: Any) -> int:
    if not isinstance(value, dict | list):
        return 0
    return 1 + max(map(depth, value.values() if isinstance(value, dict) else value), default=0)


def _example(kind: Any) -> Any:
    origin, parts = get_origin(kind), get_args(kind)
    if origin in (typing.Union, UnionType):
        return None
    if origin is tuple:
        return (_example(parts[0]), _example(parts[0]))
    if origin is not None:
        return {"key": [1, 2.5, "three", None]}
    if dataclasses.is_dataclass(kind):
        return kind()
    return {int: 1, float: 0.5, bool: True, str: "text", bytes: b"bytes"}[kind]


def example(cls: type[Any]) -> Any:
    """One message of that type."""
    return cls(**{name: _example(hint) for name, hint in hints_of(cls).items()})


messages: st.SearchStrategy[Any] = st.one_of([values_of(cls) for cls in MESSAGES])
