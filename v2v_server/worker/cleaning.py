"""Which frames and which part of the picture a sample is made of, under what scene "auto" leaves out."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from v2v_protocol.spec import StreamSpec
from v2v_server.corpus.scenes.scene import NO_BARS, Scene, Sides
from v2v_server.video.decode import DecodedClip

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
