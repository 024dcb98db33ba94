"""Which frames and which part of the picture a sample is made of, under what scene "auto" leaves out."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import ProtocolError, UsageError, VideoError
from v2v_protocol.messages import Lease
from v2v_protocol.spec import StreamSpec
from v2v_server.corpus.scenes.scene import NO_BARS, Scene, Sides
from v2v_server.simulation.draw import FrameTimes
from v2v_server.simulation.view import Window
from v2v_server.video.decode import DecodedClip
from v2v_server.video.frame_index import FrameIndex
from v2v_server.video.rows import Rows

_LONGEST = np.iinfo(np.int16).max


@dataclass(frozen=True, slots=True)
class CleanFrames:
    """The frames of a sequence.

    Attributes:
        numbers: int64 [n], their ordinals in the video; more than a sample of ``voxel_seconds`` may use.
        stride: distance of these frames, if it is the same for all; 0 where repeated frames are left out.
        sides: bars outside of the usable picture.
    """

    numbers: npt.NDArray[np.int64]
    stride: int
    sides: Sides

    @classmethod
    def of(cls, scene: Scene | None, start_frame: int, spec: StreamSpec, count: int) -> CleanFrames:
        """Return the frames of the sequence that begins at ``start_frame``.

        Args:
            scene: statistics of what the sequence shows; None with scene "off".
            count: frames of the sequence, those that the stride leaves out included.
        """
        stride, kept = spec.recipe.frame_stride, spec.kept_defects
        numbers = start_frame + np.arange(count, dtype=np.int64)
        if scene is not None and "duplicates" not in kept:
            numbers = scene.frames_from(start_frame, count)
        is_even = int(numbers[-1]) - start_frame < count
        sides = NO_BARS if scene is None or "bars" in kept else scene.sides(start_frame, int(numbers[-1]) + 1)
        return cls(numbers[::stride], stride if is_even else 0, sides)

    @property
    def span(self) -> int:
        """Return the number of the video's frames from the first to the last of these."""
        return int(self.numbers[-1] - self.numbers[0]) + 1

    @property
    def reason(self) -> str:
        """What was left out, for the provenance; empty if nothing was."""
        dropped = self.span - len(self.numbers) if not self.stride else 0
        bars = ", ".join(f"{name} {depth}" for name, depth in zip(Sides._fields, self.sides, strict=True) if depth)
        parts = (
            f"{dropped} of {self.span} frames dropped" if dropped else "",
            f"bars left out: {bars} px" if bars else "",
        )
        return "; ".join(filter(None, parts))

    def count(self, frames: int) -> int:
        """Return how many frames are to be decoded for the first of these, ``frames`` in number."""
        return frames if self.stride else int(self.numbers[frames - 1] - self.numbers[0]) + 1

    def pick(self, clip: DecodedClip, frames: int) -> DecodedClip:
        """Return the first of these, ``frames`` in number, from a clip of :meth:`count` frames."""
        if self.stride:
            return clip
        at = self.numbers[:frames] - self.numbers[0]
        motion = None if clip.motion is None else _motion_between(clip.motion, at)
        return replace(clip, frames=clip.frames[at], seconds=clip.seconds[at], motion=motion)


def _motion_between(motion: npt.NDArray[np.int16], frames: npt.NDArray[np.int64]) -> npt.NDArray[np.int16]:
    """Return the motion to each of some frames from the one before it among them: the sum on the way."""
    way = np.cumsum(motion, axis=0, dtype=np.int32)[frames]
    return np.clip(np.diff(way, axis=0, prepend=way[:1]), -_LONGEST, _LONGEST).astype(np.int16)


def usable_window(lease: Lease, sides: Sides) -> Window:
    """Return the part of a lease's upright picture that may be used: its rows without these bars."""
    top, bottom = Rows.parse(lease.rows).bounds(lease.height_px)
    height, width = bottom - top - sides.top - sides.bottom, lease.width_px - sides.left - sides.right
    return Window(top + sides.top, sides.left, height, width)


def within_rows(lease: Lease, sides: Sides) -> Window:
    """Return the window of :func:`usable_window`, counted from the first usable row."""
    top, _ = Rows.parse(lease.rows).bounds(lease.height_px)
    usable = usable_window(lease, sides)
    return usable._replace(top_px=usable.top_px - top)


def most_frames(lease: Lease, spec: StreamSpec) -> int:
    """Return how many frames a sample may use, those in between included: the same for every server, whose index of a
    lease may hold more.
    """
    recipe, rate = spec.recipe, lease.frames_per_second
    if not recipe.is_timed:
        return recipe.frames_needed
    if not rate:
        raise VideoError(lease.video, None, "its frame rate is unknown, and voxel_seconds needs it")
    needed = int(recipe.sequence_at(rate)) + 1
    if spec.scene != "off":
        return needed
    return min(int(recipe.reach_at(rate)) + 1, frame_index(lease, needed).end - lease.start_frame)


def frame_times(lease: Lease, spec: StreamSpec, frames: CleanFrames) -> FrameTimes:
    """Return the time stamps of the frames that a sample may use."""
    seconds = frame_index(lease, frames.span).seconds(lease.start_frame, frames.span)
    rate = lease.frames_per_second / spec.recipe.frame_stride
    return FrameTimes(seconds[frames.numbers - frames.numbers[0]], rate)


def frame_index(lease: Lease, count: int) -> FrameIndex:
    """Decode the frame index of a lease, for this number of frames. Its server may not have checked it.

    Raises:
        VideoError: the index is damaged.
    """
    try:
        index = FrameIndex.from_bytes(lease.frame_index)
        index.position(lease.start_frame, count)
    except (ProtocolError, UsageError) as error:
        raise VideoError(lease.video, None, f"its index from the server is damaged: {error}") from error
    return index
