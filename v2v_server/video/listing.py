"""Confirm that the frames of a file are those that its packets list.

Decoding confirms the first frames, those around the longest gaps in the time stamps, and the last group of frames if
it is short. If :mod:`v2v_server.video.signs` finds a reason for doubt, the whole file is decoded once.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import chain

import av
import numpy as np
from av.video.frame import VideoFrame

from v2v_server.video.decode import decodes_as_listed
from v2v_server.video.frame_index import NO_TIMESTAMP, FrameIndex
from v2v_server.video.luma import LumaFormat
from v2v_server.video.signs import steps_and_gaps
from v2v_server.video.source import opened, packets

_FIRST_FRAMES = 8
_LONGEST_LAST_GROUP = 64
_MOST_GAPS = 8
_MOST_LOST = 0.1
"""Share of the frames that may be lost without an error of the decoder."""


def is_confirmed(path: str, listed: FrameIndex) -> bool:
    """Return whether frames decode as listed: the first, the last, and those around gaps.

    Args:
        path: the file.
        listed: all of its frames, seekable.
    """
    places = [(0, min(_FIRST_FRAMES, len(listed)))]
    if len(listed) > 1:
        steps, are_gaps = steps_and_gaps(listed.pts)
        longest = np.argsort(steps)[::-1][:_MOST_GAPS]
        places += [(int(before), 2) for before in longest if are_gaps[before]]
    last = int(listed.keyframes[-1]) if len(listed.keyframes) else 0
    if len(listed) - last <= _LONGEST_LAST_GROUP:
        places.append((last, len(listed) - last))
    return all(decodes_as_listed(path, listed, *place) for place in places)


@dataclass(slots=True)
class Delivered:
    """What a decoder delivers of a whole file, up to the first frame of another size or luma format.

    Attributes:
        pts: time stamps from the first sound frame on, :data:`NO_TIMESTAMP` for none.
        sound: number of frames in front of the first damage behind that one.
        is_damaged: whether an error or a damaged frame came behind the first sound frame.
        change: what is different from the frame behind these on, for the user; "" if nothing is.
    """

    pts: array[int] = field(default_factory=lambda: array("q"))
    sound: int = 0
    is_damaged: bool = False
    change: str = ""

    @classmethod
    def of(cls, path: str, head: VideoFrame, check: Callable[[int], None]) -> Delivered:
        """Decode a file.

        Args:
            path: the file.
            head: its first sound frame.
            check: called with the number of frames so far.

        Raises:
            VideoError: by ``check``.
        """
        luma, found = LumaFormat.of(head), cls()
        with opened(path) as (container, stream):
            for packet in chain(packets(container, stream), [None]):
                check(len(found.pts))
                try:
                    frames = stream.decode(packet)
                except av.FFmpegError:
                    found.is_damaged = bool(found.pts)
                    continue
                for frame in frames:
                    if frame.is_corrupt and not found.pts:
                        continue
                    if (frame.height, frame.width) != (head.height, head.width) or not luma.describes(frame):
                        form, before = _form(frame), _form(head)
                        found.change = f"from frame {len(found.pts)} on they are {form} instead of {before}"
                        return found
                    found.is_damaged |= frame.is_corrupt
                    found.sound += not found.is_damaged
                    found.pts.append(NO_TIMESTAMP if frame.pts is None else frame.pts)
        return found

    def confirmed(self, listed: FrameIndex, empty_pts: array[int]) -> FrameIndex | None:
        """Return the part of a list that the decoder delivers; None where it delivers other frames, or another order.

        Frames after the last delivered one are left out, and so are empty packets. Other frames that are not delivered
        are lost: they stay in the list and are refused. If many are lost, the packets do not list frames.

        Args:
            listed: all frames of the file, seekable.
            empty_pts: time stamps of packets that may decode to nothing.
        """
        pts, came = np.array(self.pts[: self.sound], np.int64), np.isin(listed.pts, np.array(self.pts, np.int64))
        if not len(pts) or not np.isin(pts, listed.pts).all() or np.any(pts[1:] <= pts[:-1]):
            return None
        last = int(np.flatnonzero(came)[-1])
        kept = came | ~np.isin(listed.pts, np.array(empty_pts, np.int64))
        kept[last + 1 :] = False
        if not self.is_damaged and np.count_nonzero(kept & ~came) > _MOST_LOST * last:
            return None
        return listed.only(kept)


def _form(frame: VideoFrame) -> str:
    return f"{frame.width}x{frame.height} px of {LumaFormat.of(frame)}"
