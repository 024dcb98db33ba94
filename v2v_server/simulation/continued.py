"""Simulate a clip of any length piece by piece, in the memory of a piece: every pixel carries its state on."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from v2v_protocol.events import EventList
from v2v_server.simulation.kernels import Carried, KernelInput, list_piece, new_state
from v2v_server.simulation.precision import Real
from v2v_server.simulation.voxel import Doubles, Levels, Moments, bin_edges

PIECE_EVENTS = 1 << 21
"""Events of a piece, unless a single step has more: 48 MiB to list and sort them."""
_FULL = 0.8
"""Part of them that the next piece should have, if its steps fire as often as those of the last one."""


class ContinuedClip:
    """List the events of a clip that comes in consecutive parts; how it is divided changes no event.

    Args:
        real: arithmetic of the pixels. What ``precision.choose`` returns depends on the length of a clip.
        most_events: events of a piece, unless a single step has more.
    """

    def __init__(self, real: Real = np.float64, most_events: int = PIECE_EVENTS) -> None:
        self._real, self._rows = real, np.empty((most_events, 2), np.int64)
        self._carried: Carried | None = None
        self._steps_at_once = 1

    def restart(self) -> None:
        """Let every pixel start from the next frame as at the beginning: the camera sees another scene."""
        if self._carried is not None:
            self._carried = self._carried._replace(resumes=False)

    def events(self, given: KernelInput, since_us: Doubles) -> Iterator[EventList]:
        """List the events of the next part, in pieces.

        Args:
            given: the part, whose first frame is the last one of the part before, apart from a restart; its bins do
                not matter.
            since_us: [steps + 1] time of each frame, microseconds, at least 0.

        Yields:
            events, with times counted as ``since_us`` is.
        """
        first, steps = 0, len(given.step_seconds)
        while first < steps:
            carried = self._carried or Carried(new_state(given, self._real), new_state(given, self._real))
            last = min(first + self._steps_at_once, steps)
            piece = replace(part_of(given, first, last), carried=carried)
            count, events = list_piece(
                piece, self._real, np.diff(since_us[first : last + 1]), since_us[first : last + 1], self._rows
            )
            most = len(self._rows)
            self._steps_at_once = max(1, min(int(_FULL * most * (last - first) / max(count, 1)), 2 * (last - first)))
            if count > most:
                if last - first == 1:
                    self._rows = np.empty((count, 2), np.int64)
                continue
            self._carried = Carried(
                carried.after, carried.before, carried.steps + last - first, carried.segments + piece.segments, True
            )
            first = last
            yield events


def part_of(given: KernelInput, first: int, last: int) -> KernelInput:
    """Return the steps from ``first`` to before ``last`` of a clip; each is a bin."""
    levels = given.levels
    if levels is not None:
        low, high = np.searchsorted(levels.at.step, (first, last))
        levels = Levels(Moments(levels.at.step[low:high] - first, levels.at.share[low:high]), levels.grey[low:high])
    shown = given.source_index[first : last + 1]
    return replace(
        given,
        frames=given.frames[shown[0] : shown[-1] + 1],
        source_index=shown - shown[0],
        noise_durations=given.noise_durations[first:last],
        step_seconds=given.step_seconds[first:last],
        bins=1,
        edges=bin_edges(last - first, 1),
        levels=levels,
        grids_have_durations=False,
    )
