"""Make the pieces of a video for tests."""

from __future__ import annotations

import numpy as np

from v2v_server.corpus.scenes.scene import NO_BARS, PIECE, Flag, Pieces, Sides


def pieces(*each: tuple[int, int] | tuple[int, int, Sides]) -> Pieces:
    """Return pieces from (frame after the last, flags, bars)."""
    return np.array([(end, flags, *(sides[0] if sides else NO_BARS)) for end, flags, *sides in each], PIECE)


def shots(end: int, *boundaries: int) -> Pieces:
    """Return the pieces of a video that has nothing but shot boundaries."""
    ends = [*boundaries, end]
    return pieces(*((at, Flag.CUT if number else 0) for number, at in enumerate(ends)))
