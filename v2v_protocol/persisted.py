"""Let a dataclass leave its process as plain values, and read it back under checks.

    @dataclass(frozen=True, slots=True)
    class Entry(Persisted):
        frame: Annotated[int, Limits(0, 2**24)]
        reason: str
        spec: str = later("")

``Entry(3, "hangs").to_dict()`` is ``{"frame": 3, "reason": "hangs"}``, and ``Entry.from_dict`` reads it: of a message,
a file, a saved state, or another process, which may hold anything. A field's annotation states its check:

    int                     a whole number from 0 to 2**64 - 1
    float                   a finite number; a whole one is converted
    Annotated[T, Limits]    an int or float within other limits
    bool, str, bytes, None  nothing else
    tuple[T, ...]           a list of at most LARGEST_LIST
    tuple[A, B], NamedTuple a list of these
    Mapping[str, T]         a map; with Any, of plain values that are nested at most MOST_DEPTH deep
    A | B                   either; no two of them may look alike
    a Persisted             a map of its fields
    Path, any from_bytes    bytes

Only a field with a default may be missing. One that a later release added (:func:`later`) is also left out at its
default, so records, and the digests of them, keep the bytes that they had before it. No other field may be added.
"""

from __future__ import annotations

import dataclasses
import json
import math
import os
import sys
import typing
from collections.abc import Callable, Mapping, Set
from dataclasses import MISSING, dataclass
from functools import cache
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, NamedTuple, Self, TypeAlias, TypeVar

from v2v_protocol.errors import LimitExceeded, ProtocolError, UsageError
from v2v_protocol.settings import LATER, nearest

LARGEST_LIST = 65_536
MOST_DEPTH = 16
"""Containers within containers. Deeper ones could not even be shown in an error message (RecursionError)."""
T = TypeVar("T")
Read: TypeAlias = Callable[[Any], Any]


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits of a number, inclusive. A float without an upper limit may be NaN."""

    low: float
    high: float


Int64: TypeAlias = Annotated[int, Limits(-(2**63), 2**63 - 1)]
FloatOrNaN: TypeAlias = Annotated[float, Limits(-math.inf, math.inf)]
"""A number that may be unknown."""
_FINITE = Limits(-sys.float_info.max, sys.float_info.max)


def later(default: Any = MISSING, **options: Any) -> Any:
    """Declare a field that is left out at its default; ``options`` are those of ``dataclasses.field``."""
    return dataclasses.field(default=default, metadata={LATER: True}, **options)


class Persisted:
    """Base of a dataclass that leaves its process."""

    __slots__ = ()

    def to_dict(self) -> dict[str, Any]:
        """Return all fields as plain values by name, without those of later releases that are at their defaults."""
        return add_fields({}, self)

    @classmethod
    def from_dict(cls, values: Any) -> Self:
        """Return what :meth:`to_dict` wrote.

        Raises:
            ProtocolError: the values are not its fields; the message names class, field, value and limit.
        """
        return read_fields(cls, values)


def add_fields(plain: dict[str, Any], item: Any) -> dict[str, Any]:
    """Add what ``item.to_dict()`` returns to plain values, and return them."""
    kind: Any = type(item)
    names, nested, defaults = _written(kind)
    # dataclasses.asdict copies every value, which takes a quarter of a millisecond for a provenance.
    for name in names:
        plain[name] = getattr(item, name)
    for name, default in defaults.items():
        if plain[name] == default:
            del plain[name]
    for name in nested:
        if name in plain:
            plain[name] = _nested(plain[name])
    return plain


def read_fields(kind: Callable[..., T], values: Any) -> T:
    """Return a Persisted of the fields that its ``to_dict`` wrote.

    Raises:
        ProtocolError: as of :meth:`Persisted.from_dict`.
    """
    if not isinstance(values, dict):
        raise ProtocolError(f"{kind.__name__} = {shown(values)}: expected a map of its fields")
    readers, read, name = _readers(kind), {}, ""
    try:
        for name, value in values.items():
            read[name] = readers[name](value)
    except ProtocolError as error:
        raise type(error)(f"{kind.__name__}.{name} {error}") from None
    except KeyError:
        known = f"{nearest(name, readers)}; its fields are {', '.join(readers)}; of a later release? Update the reader"
        raise ProtocolError(f"{kind.__name__} has no field {shown(name)}{known}") from None
    try:
        return kind(**read)
    except (ProtocolError, UsageError) as error:
        raise ProtocolError(f"{kind.__name__}: {error}") from error
    except TypeError as error:
        fields: Any = dataclasses.fields(kind)  # type: ignore[arg-type]
        lacking = [each.name for each in fields if each.name not in read and each.default is each.default_factory]
        raise ProtocolError(f"{kind.__name__} lacks {', '.join(lacking)}") from error


def always_written(kind: Any) -> Set[str]:
    """Return the names of the fields that every record has, whichever release wrote it."""
    names, _, defaults = _written(kind)
    return {name: None for name in names if name not in defaults}.keys()


def to_plain(value: Any) -> Any:
    """Return plain data for what msgpack does not know, as ``default`` of ``msgpack.packb``."""
    if isinstance(value, Persisted):
        return value.to_dict()
    return os.fsencode(value) if isinstance(value, Path) else value.to_bytes()


@cache
def _written(kind: Any) -> tuple[list[str], list[str], Mapping[str, Any]]:
    """Return the names of all fields, those of fields that hold a Persisted, and the defaults of later ones."""
    fields: Mapping[str, Any] = {each.name: each for each in dataclasses.fields(kind)}
    parts = {name: (hint, *typing.get_args(hint)) for name, hint in typing.get_type_hints(kind).items()}
    defaults = {
        name: each.default_factory() if each.default is MISSING else each.default
        for name, each in fields.items()
        if each.metadata.get(LATER)
    }
    return list(fields), [name for name in fields if any(map(_is_persisted, parts[name]))], defaults


@cache
def _readers(kind: Any) -> Mapping[str, Read]:
    hints = typing.get_type_hints(kind, include_extras=True)
    return {each.name: reader(hints[each.name]) for each in dataclasses.fields(kind)}


def _is_persisted(kind: Any) -> bool:
    return isinstance(kind, type) and issubclass(kind, Persisted)


def _nested(value: Any) -> Any:
    if isinstance(value, tuple):
        return tuple(map(_nested, value))
    return value.to_dict() if isinstance(value, Persisted) else value


def shown(value: Any) -> str:
    """Format a value for an error message. Containers, whose nesting is not checked yet, show their type and length."""
    if isinstance(value, list | tuple | Mapping):
        return f"a {type(value).__name__} of {len(value)}"
    return f"{value!r:.80}" if type(value) in (int, float, bool, str, bytes, NoneType) else f"a {type(value).__name__}"


class _Rule(NamedTuple):
    """Check of a value.

    Attributes:
        kinds: types that it may have as plain data.
        expected: what it may be, for messages.
        fits: whether a value of these types is within the limits.
        convert: returns it in the field's own type.
    """

    kinds: tuple[type, ...]
    expected: str
    fits: Callable[[Any], bool] | None = None
    convert: Read | None = None


@cache
def reader(kind: Any) -> Read:
    """Return a function that returns plain data as a value of a type.

    Raises:
        ProtocolError: by the function, for any other data.
    """
    kinds, expected, fits, convert = _rule(kind)
    first = kinds[0]

    def read(value: Any) -> Any:
        # A server decodes two headers per sample, so the text for an error is built only when there is one.
        if (type(value) is first or type(value) in kinds) and (fits is None or fits(value)):
            return value if convert is None else convert(value)
        error = LimitExceeded if type(value) in kinds else ProtocolError
        raise error(f"= {shown(value)}: expected {expected}")

    return read


def _rule(kind: Any) -> _Rule:
    limits = Limits(0, 2**64 - 1) if kind is int else _FINITE
    origin, parts = typing.get_origin(kind), typing.get_args(kind)
    if origin is Annotated:
        kind, limits = parts
    low, high = limits.low, limits.high
    if kind is int:
        return _Rule((int,), f"a whole number from {low} to {high}", lambda it: low <= it <= high)
    if kind is float:
        what = "a finite number" if limits is _FINITE else f"a number from {low:g} to {high:g}"
        is_open = high == math.inf
        return _Rule((float, int), what, lambda it: low <= it <= high or (is_open and it != it), float)
    if origin in (typing.Union, UnionType):
        options = [_rule(part) for part in parts]
        by_kind = {each: reader(part) for part, rule in zip(parts, options, strict=True) for each in rule.kinds}
        return _Rule(
            tuple(by_kind), " or ".join(each.expected for each in options), None, lambda it: by_kind[type(it)](it)
        )
    if origin is tuple and parts[-1] is ...:
        return _Rule(
            (list, tuple),
            f"a list of at most {LARGEST_LIST}",
            lambda it: len(it) <= LARGEST_LIST,
            _list_of(parts[0]),
        )
    if origin is tuple or hasattr(kind, "_make"):
        row = [reader(part) for part in parts or typing.get_type_hints(kind).values()]
        make = getattr(kind, "_make", tuple)
        return _Rule(
            (list, tuple),
            f"a list of {len(row)}",
            lambda it: len(it) == len(row),
            lambda it: make(read(value) for read, value in zip(row, it, strict=True)),
        )
    if origin is not None and parts[1] is Any:
        return _Rule((dict,), f"a map nested at most {MOST_DEPTH} deep", _is_shallow)
    if origin is not None:
        key, value = map(reader, parts)
        return _Rule((dict,), "a map", None, lambda it: {key(name): value(each) for name, each in it.items()})
    if _is_persisted(kind):
        return _Rule((dict,), f"a map of the fields of {kind.__name__}", None, kind.from_dict)
    if kind is Path:
        return _Rule((bytes,), "bytes", None, lambda it: Path(os.fsdecode(it)))
    if hasattr(kind, "from_bytes") and kind is not bool:
        return _Rule((bytes,), "bytes", None, kind.from_bytes)
    return _Rule((kind,), kind.__name__)


def _list_of(kind: Any) -> Read:
    """Return a function that reads each value of a list; if none is to be converted, it checks them all at once."""
    kinds, _, fits, convert = _rule(kind)
    read, is_plain = reader(kind), {*kinds}.issuperset

    def read_all(values: Any) -> tuple[Any, ...]:
        if convert is None and is_plain(map(type, values)) and (fits is None or all(map(fits, values))):
            return tuple(values)
        return tuple(map(read, values))

    return read_all


def _is_shallow(value: dict[str, Any]) -> bool:
    level: list[Any] = [value]
    for _ in range(MOST_DEPTH):
        inner: list[Any] = []
        for outer in level:
            inner.extend(outer.values() if type(outer) is dict else outer)
        level = [item for item in inner if type(item) is dict or type(item) is list]
        if not level:
            return True
    return False


def parse_json(text: str | bytes) -> Any:
    """Return the value of a JSON text.

    Raises:
        ValueError: it is not JSON, is nested too deeply, or holds half of a surrogate pair, which is not Unicode text.
    """
    try:
        value = json.loads(text)
        json.dumps(value, ensure_ascii=False).encode()
    except RecursionError:
        raise ValueError("is nested too deeply") from None
    except UnicodeEncodeError:
        raise ValueError("holds half of a surrogate pair, which is not Unicode text") from None
    return value
