"""Which files are new or changed since the index was written: asks the system for the size and times of each.

Of a million files that takes seconds, so several processes do it; they import little, and are there in a moment.
"""

from __future__ import annotations

import os
from array import array
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from v2v_server.catalogue.files import Notice, by_parts
from v2v_server.cloud.copies import Copies
from v2v_server.system.isolate import Died, run_isolated

_State = tuple[int, int, int]
_NO_STATE: _State = (-1, 0, 0)  # no file has that size
_FILES_A_PROCESS = 100_000
"""With fewer another process costs more than it saves."""
_TOGETHER = 20_000


@dataclass(frozen=True, slots=True)
class _Some:
    """Some of the files.

    Attributes:
        first: number of the first of them.
        ids: relative paths.
        states: that the index knows, size, mtime and ctime of each, one after the other.
    """

    first: int
    ids: Sequence[str]
    states: array[int]


def changed(
    root: Path | Copies, ids: Sequence[str], states: array[int], processes: int, notice: Notice | None
) -> list[int]:
    """The numbers of the files that are not as the index knows them.

    Args:
        root: the folder, or what lies in object storage, that ids are relative to.
        ids: relative paths.
        states: that the index knows, size, mtime and ctime of each, one after the other.
        processes: how many may ask; up to 1 asks in this one.
        notice: told how far it is.
    """
    if isinstance(root, Copies) or len(ids) < _FILES_A_PROCESS:
        processes = 0
    some = (
        _Some(at, ids[at : at + _TOGETHER], states[3 * at : 3 * (at + _TOGETHER)])
        for at in range(0, len(ids), _TOGETHER)
    )
    found, done, ask = list[int](), 0, partial(_changed, root)
    for part, numbers in run_isolated(ask, some, processes if processes > 1 else 0):
        found += ask(part) if isinstance(numbers, Died) else numbers
        done += len(part.ids)
        if notice is not None:
            notice(f"looking at files: {done} of {len(ids)}, {len(found)} of them new or changed")
    return sorted(found)


def _changed(root: Path | Copies, some: _Some) -> list[int]:
    folder, listed = os.path.join(root, ""), root.listed if isinstance(root, Copies) else None

    def state(id: str) -> _State:
        if listed is not None:
            found = listed.get(id)
            return _NO_STATE if found is None else (found.size_bytes, found.mark, 0)
        try:
            status = os.stat(folder + id)
        except OSError:
            return _NO_STATE
        return status.st_size, status.st_mtime_ns, status.st_ctime_ns

    def those(part: Sequence[str]) -> array[int]:
        found = array("q")
        for id in part:
            found.extend(state(id))
        return found

    now = array("q")
    for _, found in by_parts(those, some.ids):
        now += found
    if now == some.states and -1 not in now[::3]:
        return []
    return [
        some.first + at
        for at in range(len(some.ids))
        if now[3 * at] < 0 or now[3 * at : 3 * at + 3] != some.states[3 * at : 3 * at + 3]
    ]
