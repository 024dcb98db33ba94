"""Declare a setting once.

    bins: int = whole(5, 1, 1024, "B, bins of one voxel grid")

is a field of a frozen dataclass. Its check, its command-line flag (:mod:`v2v_protocol.command`), its key in a YAML file
or a message, and its line in ``docs/reference/keys.md`` are derived from this line.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import operator
import re
import typing
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from numbers import Real
from types import MappingProxyType
from typing import Any, Literal

from v2v_protocol.errors import UsageError
from v2v_protocol.foreign_words import FOREIGN

_SETTING = "v2v setting"
LATER = "v2v later"
"""Key in the metadata of a field that is left out of its record at its default (:mod:`v2v_protocol.persisted`)."""
_LONGEST_SHOWN = 200
_LEAST_ALIKE = 0.74
"""Share of characters in common, from which a key counts as misspelt."""
_SHORTEST_STEM = 3


@dataclass(frozen=True, slots=True)
class Setting:
    """Declaration of one field.

    Attributes:
        kind: "range" is a pair (lowest, highest) of a uniform draw; one number stands for both ends. "bounds" is a pair
            of whole numbers, written LEAST:MOST; one number stands for both.
        default: default value of the field.
        help: one line for people, without a full stop.
        low, high: limits of a number, inclusive. Equal limits leave one value, and ``help`` then says why.
        off: 0 means "off", although ``low`` is above it; a range may not begin at 0 and end above it.
        words: the choices of a word; a registry is kept by reference, so later additions count.
        unit: unit of a number, such as "px" or "Hz".
        group: heading in help and on the reference page.
        metavar: placeholder for the value in help.
        bare: value of a flag that is given without one; None: a value is required.
        is_hidden: internal to a program, or without a use: left out of help and the reference page.
        usual: range of real devices, within the limits. A value outside it is allowed, with a warning.
        mistake: what a value outside ``usual`` (``{0:g}``) means, and the unit that was probably meant.
        too_low: the same for a value below ``usual``, where that is another mistake.
        is_later: a later release added the field: a record leaves it out at its default, so older digests hold.
        worst: for a field that is an effect of the camera, the most that a value does (``v2v_protocol.recipe.Worst``).
    """

    kind: Literal["whole", "bounds", "number", "range", "switch", "word", "text"]
    default: Any
    help: str
    low: float = -math.inf
    high: float = math.inf
    off: bool = False
    words: Collection[str] = ()
    unit: str = ""
    group: str = ""
    metavar: str = ""
    bare: Any = None
    is_hidden: bool = False
    is_later: bool = False
    usual: tuple[float, float] = (-math.inf, math.inf)
    mistake: str = ""
    too_low: str = ""
    worst: Callable[..., Any] | None = None

    @property
    def expected(self) -> str:
        """Instruction for an error message: "give a whole number from 1 to 1024"."""
        if self.low == self.high:
            return f"give {_limit(self.low)}, or leave it out: {self.help}"
        if self.kind == "word":
            return f"choose one of {', '.join(self.words)}"
        plain = {
            "whole": "give a whole number", "bounds": "give a whole number, or LEAST:MOST,",
            "number": "give a number", "switch": "give true or false",
            "range": "give one number, or a pair [lowest, highest],", "text": "give text",
        }[self.kind]  # fmt: skip
        if self.low == -math.inf:
            return plain.removesuffix(",")
        unit = f" {self.unit}" if self.unit else ""
        return f"{plain} from {_limit(self.low)} to {_limit(self.high)}{unit}" + (", or 0 for off" if self.off else "")

    @property
    def single(self) -> Setting:
        """Setting of one number drawn from this range."""
        return dataclasses.replace(self, kind="number")

    def warning(self, name: str, value: Any) -> str:
        """Return a warning if a checked value, or an end of its range, lies outside ``usual``; "" otherwise."""
        low, high = self.usual
        for end in value if isinstance(value, tuple) else (value,):
            if self.mistake and not low <= end <= high and not (self.off and end == 0):
                span = f"{low:g} to {high:g} {self.unit}".rstrip()
                meaning = self.too_low if end < low and self.too_low else self.mistake
                return f"{name} = {end:g}: real cameras have {span}. {meaning.format(end)}"
        return ""

    def check(self, name: str, value: object, error: type[UsageError] = UsageError) -> Any:
        """Return ``value`` in the field's own type: a float for a number, two for a range.

        Args:
            name: name of the field in the message.
            error: class of the error to raise.

        Raises:
            UsageError: it has another type or is outside the limits.
        """
        checked = self._converted(value)
        if checked is None:
            raise error(f"{name} = {format_value(value)}: {self.expected}{self._hint(value)}")
        if self.kind in ("range", "bounds") and checked[0] > checked[1]:
            raise error(f"{name} = {format_value(value)}: the lowest value comes first")
        return checked

    def _converted(self, value: object) -> Any:
        """Convert a value; None if it has another type or is outside the limits."""
        value = plain(value)
        if self.kind == "switch":
            return value if isinstance(value, bool) else None
        if self.kind == "text":
            return value if isinstance(value, str) else None
        if self.kind == "word":
            return value if isinstance(value, str) and value in self.words else None
        if self.kind == "whole":
            number = as_whole(value)
            return number if number is not None and self._allows(number) else None
        if self.kind == "number":
            return self._number(value)
        if self.kind == "bounds":
            return self._bounds(value)
        ends = tuple(value) if isinstance(value, list | tuple) else (value, value)
        low, high = map(self._number, ends) if len(ends) == 2 else (None, None)
        if low is None or high is None or (self.off and low == 0.0 < high):
            return None
        return low, high

    def _bounds(self, value: object) -> tuple[int, int] | None:
        ends: list[Any] = value.split(":") if isinstance(value, str) else [value]
        if isinstance(value, list | tuple):
            ends = list(value)
        try:
            wholes = [int(end) if isinstance(end, str) else as_whole(end) for end in ends]
        except ValueError:
            return None
        allowed = [end for end in wholes if end is not None and self._allows(end)]
        return (allowed[0], allowed[-1]) if len(wholes) == len(allowed) in (1, 2) else None

    def _number(self, value: object) -> float | None:
        if isinstance(value, bool) or not isinstance(value, Real | str):
            return None
        try:
            # Text, because YAML 1.1 takes 1e-3 for text. Minus zero equals zero, but would not give the same digest.
            number = float(value) + 0.0
        except (OverflowError, ValueError):
            return None
        return number if self._allows(number) else None

    def _allows(self, number: float) -> bool:
        return (self.low <= number <= self.high and math.isfinite(number)) or (self.off and number == 0)

    def _hint(self, value: object) -> str:
        # For instance scene: off; the message would not show what the user wrote.
        if self.kind in ("word", "text") and isinstance(value, bool):
            return " (YAML reads off, on, no and yes as truth values: put it in quotes)"
        return ""


def whole(default: int, low: int, high: int, help: str, **more: Any) -> Any:
    """Return a field for a whole number. ``more``: other attributes of :class:`Setting`, here and below."""
    return _field(Setting("whole", default, help, low, high, **more))


def bounds(default: tuple[int, int], low: int, high: int, help: str, **more: Any) -> Any:
    """Return a field for two whole numbers, least and most, or one number for both."""
    return _field(Setting("bounds", default, help, low, high, **more))


def number(default: float, low: float, high: float, help: str, **more: Any) -> Any:
    """Return a field for a finite number."""
    return _field(Setting("number", default, help, low, high, **more))


def span(default: tuple[float, float], low: float, high: float, help: str, **more: Any) -> Any:
    """Return a field for the range of a draw."""
    return _field(Setting("range", default, help, low, high, **more))


def switch(default: bool, help: str, **more: Any) -> Any:
    """Return a field that is true or false."""
    return _field(Setting("switch", default, help, **more))


def word(default: str, choices: Any, help: str, **more: Any) -> Any:
    """Return a field for one of some words; ``choices`` is a ``Literal``, or the words."""
    return _field(Setting("word", default, help, words=typing.get_args(choices) or choices, **more))


def text(default: str, help: str, **more: Any) -> Any:
    """Return a field for any text."""
    return _field(Setting("text", default, help, **more))


def of_type(hint: Any) -> Setting | None:
    """Return the setting that a type alone implies: for a Literal, bool, int, float or str; None for any other."""
    if typing.get_origin(hint) is Literal:
        return Setting("word", None, "", words=typing.get_args(hint))
    kinds: dict[Any, Any] = {bool: "switch", int: "whole", float: "number", str: "text"}
    return Setting(kinds[hint], None, "") if hint in kinds else None


def _field(setting: Setting) -> Any:
    return dataclasses.field(default=setting.default, metadata={_SETTING: setting, LATER: setting.is_later})


@cache
def settings_of(cls: Any) -> Mapping[str, Setting]:
    """Return the settings of a dataclass, by name, in their order. A group continues until a field names the next."""
    found: dict[str, Setting] = {}
    group = ""
    for item in dataclasses.fields(cls):
        if _SETTING in item.metadata:
            setting: Setting = item.metadata[_SETTING]
            group = setting.group or group
            found[item.name] = dataclasses.replace(setting, group=group)
    return MappingProxyType(found)


def check_settings(item: Any, name: Callable[[str], str], error: type[UsageError] = UsageError) -> None:
    """Check and convert all settings of a dataclass, in its ``__post_init__``, frozen or not.

    Args:
        name: returns the name of a field for messages.
        error: class of the error to raise.

    Raises:
        UsageError: see :meth:`Setting.check`.
    """
    for key, setting in settings_of(item.__class__).items():
        object.__setattr__(item, key, setting.check(name(key), getattr(item, key), error))


def require_known(
    keys: Iterable[object], known: Iterable[str], what: str, error: type[UsageError] = UsageError
) -> None:
    """Check that all keys are known.

    Raises:
        UsageError: a key is unknown; the message names the nearest known one, and all of them.
    """
    names = list(known)
    for key in keys:
        if key not in names:
            raise error(f"unknown {what} {format_value(key)}{nearest(key, names)}; known: {', '.join(names)}")


def require_whole(name: str, value: object, low: int, high: int) -> int:
    """Return ``value`` if it is a whole number within the limits.

    Raises:
        UsageError: it is not; the message uses ``name``.
    """
    number = as_whole(value)
    if number is None or not low <= number <= high:
        raise UsageError(f"{name} = {format_value(value)}: give a whole number from {low} to {high}")
    return number


def plain(value: Any) -> Any:
    """Return the numbers of NumPy and of tensors as Python's, arrays as lists, also within lists and mappings."""
    if isinstance(value, list | tuple):
        return type(value)(map(plain, value))
    if isinstance(value, Mapping):
        return {key: plain(each) for key, each in value.items()}
    return value.tolist() if hasattr(value, "tolist") and not isinstance(value, type) else value


def as_whole(value: Any) -> int | None:
    """Return a whole number of any type as an int; None for other values, truth values included."""
    value = plain(value)
    try:
        return None if isinstance(value, bool) else operator.index(value)
    except TypeError:
        return None


def nearest(key: object, known: Iterable[str]) -> str:
    """Return a hint, " (did you mean 'bins'?)", or "" if no known key is similar. A word of another tool
    (:mod:`v2v_protocol.foreign_words`) names what it is called here. A longer key is compared in part: the time grows
    with its length, and a peer may send one of 60 kB.
    """
    word, names = _bare(str(key)[:_LONGEST_SHOWN]), {_bare(name): name for name in known}
    for meant in FOREIGN.get(word, ()) if word not in names else ():
        if meant in names:
            return f" (did you mean {names[meant]!r}?)"
        if not meant.isidentifier():
            return f" ({meant})"
    close = difflib.get_close_matches(word, list(names), n=1, cutoff=_LEAST_ALIKE)
    close = close or [name for name in names if _is_part(word, name)]
    return f" (did you mean {' or '.join(repr(names[name]) for name in close[:3])}?)" if close else ""


def _bare(name: str) -> str:
    """Return a key or flag in the form of a key: page_host for --page-host."""
    return name.lstrip("-").replace("-", "_").lower()


def _is_part(word: str, name: str) -> bool:
    """Return whether a name has a word as one of its words, crop of crop_width_px, or a word is longer: output, out."""
    return bool(word) and (
        word in re.split("[^a-z0-9]+", name) or (len(name) >= _SHORTEST_STEM and word.startswith(name))
    )


def format_value(value: object) -> str:
    """Format a value for a message, shortened."""
    as_text = repr(list(value) if isinstance(value, tuple) else value)
    return as_text if len(as_text) <= _LONGEST_SHOWN else as_text[:_LONGEST_SHOWN] + " ..."


def _limit(value: float) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)
