"""Read the times of pictures from a text whose unit may be open.

A line for each picture holds its time, and if you like its name, or its number in front of the time. Spaces, tabs,
commas and semicolons separate them. A time is a number, or a date such as ``2011-09-26 13:02:25.594360375``, whose zone
does not matter. A byte order mark, comments from ``#`` on and headings are passed over.

Numbers are seconds, unless a heading or first comment states another unit (``time_us``, ``[ns]``, "in ms"), or seconds
give a rate that no camera has and another unit gives one. What is assumed so is said, also of numbers of pictures in
place of times, which are seconds too.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

PLAUSIBLE_HZ = 0.5, 20_000.0
"""Rates at which cameras take pictures. Others are questioned."""
_USUAL_HZ = 5.0, 1000.0
"""Rates that decide where two units give plausible ones."""
_NS = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}
_STATED = {
    "s": r"seconds?|secs?|(?<=[\[(_])s|(?<=in )s",
    "ms": r"milli-?seconds?|msecs?|ms",
    "us": r"micro-?seconds?|[uµμ]secs?|[µμ]s|(?<=[\[(_])us|(?<=in )us",
    "ns": r"nano-?seconds?|nsecs?|ns",
}
"""What states a unit in a heading. "s" and "us" count in brackets, after "_" and after "in" only."""
_DATE = r"(\d{4}-\d\d-\d\d[T ]\d\d:\d\d:\d\d(?:\.\d+)?)( ?Z| ?[+-]\d\d:?\d\d)?"
_WORD = re.compile(rf"{_DATE}(?![^\s,;\"'])|[^\s,;\"']+")
_KINDS = {"n": r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?", "d": _DATE, "w": ".*"}
"""Numbers, dates and other words."""
_LINE = "w?n?[nd]|n?[nd]w?|[nd]n"
"""Kinds of the words of a line."""
_WANTED = "a line is a time in seconds or a date, with the picture's name, or its number in front, if you like"


def read_times(data: bytes) -> tuple[npt.NDArray[np.int64], Sequence[str], str]:
    """Read a text of times.

    Returns:
        [N] nanoseconds, increasing; the pictures' names as they are written, N, empty where none are stated; what was
        assumed of the unit, "" where the text states it, and for seconds that do not count the pictures.

    Raises:
        ValueError: a line is something else, or its time does not come after the one before; or the unit is open.
    """
    lines, heading = list[tuple[int, list[str], str]](), ""
    for number, line in enumerate(data.decode("utf-8-sig").splitlines(), 1):
        words = [found[0] for found in _WORD.finditer(re.sub(r"(^|\s)#.*", "", line))]
        kinds = "".join(next(kind for kind in _KINDS if re.fullmatch(_KINDS[kind], word)) for word in words)
        if words and (lines or set(kinds) != {"w"}):
            lines.append((number, words, kinds))
        elif not lines:
            heading += f"{line}\n"
    ((usual, _),) = Counter(kinds for *_, kinds in lines).most_common(1) or [("", 0)]
    for number, words, kinds in lines:
        if kinds != usual or not re.fullmatch(_LINE, kinds):
            raise ValueError(f"line {number}: {' '.join(words)[:60]!r}: {_WANTED}")
    if not lines:
        raise ValueError(f"states no time: {_WANTED}")
    columns = list(zip(*(words for _, words, _ in lines), strict=True))
    times = [at for at, kind in enumerate(usual) if kind != "w"]
    if len(times) == 2:  # one of them counts the pictures
        counts = (usual[at] == "n" and set(np.diff(np.array(columns[at], float))) <= {1.0} for at in times)
        times = [other for at, other, does in zip(times, reversed(times), counts, strict=True) if does]
    if not times:
        raise ValueError(f"line {lines[0][0]}: two columns of numbers, and none counts the pictures: {_WANTED}")
    column, remark = columns[times[0]], ""
    if usual[times[0]] == "d":
        ns = np.array([re.sub(_DATE, r"\1", word) for word in column], "datetime64[ns]").astype(np.int64)
    else:
        ns, remark = _nanoseconds(column, heading.lower())
    if len(late := np.flatnonzero(ns[1:] <= ns[:-1])):
        one, other = (f"{column[at]} in line {lines[at][0]}" for at in (late[0] + 1, late[0]))
        raise ValueError(f"states times that do not increase: {one} does not come after {other}")
    return ns, columns[usual.index("w")] if "w" in usual else (), remark


def _nanoseconds(column: Sequence[str], heading: str) -> tuple[npt.NDArray[np.int64], str]:
    """Return times in nanoseconds, whole numbers exactly, and what was assumed of their unit.

    Raises:
        ValueError: two units are as plausible, or a time is too large.
    """
    is_whole = all(re.fullmatch(r"[-+]?(\d{1,18}|[1-8]\d{18})", word) for word in column)
    times: npt.NDArray[Any] = np.array([int(word) if is_whole else float(word) for word in column])
    step = float(np.median(np.diff(times.astype(float)))) if len(times) > 1 else 0.0
    rates = {unit: 1e9 / (step * ns) for unit, ns in _NS.items()} if step > 0 else {}
    stated = [unit for unit in _NS if re.search(rf"(?<![a-z])({_STATED[unit]})(?![a-z])", heading)]
    plausible, usual = (
        [unit for unit, hz in rates.items() if low <= hz <= high] for low, high in (PLAUSIBLE_HZ, _USUAL_HZ)
    )
    is_open = len(stated) != 1 and plausible and "s" not in plausible
    units = (usual or plausible) if is_open else stated if len(stated) == 1 else ["s"]
    shown = " or ".join(f"{unit}, {rates.get(unit, 0):.4g} pictures a second" for unit in units)
    if len(units) > 1:
        raise ValueError(f"its times may be in {shown}: state the unit in a first line, such as # time_{units[0]}")
    if not np.all(np.abs(times.astype(float) * _NS[units[0]]) < 2.0**62):
        raise ValueError(f"states a time beyond 4e9 s, if it is in {units[0]}")
    remark = f"its times are taken for {shown}" if is_open else ""
    if is_whole and not stated and len(times) > 1 and (np.diff(times) == 1).all():
        remark = (
            f"its numbers, {column[0]}, {column[1]} ..., count the pictures one by one and are taken for seconds, 1 "
            "picture a second: if they are no times, remove the file and state the rate with --rate"
        )
    ns = times * _NS[units[0]]
    return ns if is_whole else np.rint(ns).astype(np.int64), remark
