"""Read a whole video part by part, each as the camera of a sample sees it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from v2v_protocol.errors import VideoError
from v2v_protocol.messages import Lease
from v2v_protocol.sample import Needs
from v2v_protocol.spec import StreamSpec
from v2v_server.corpus.sources.source import VideoSource
from v2v_server.corpus.videos import VideoEntry
from v2v_server.simulation.voxel import frame_times, step_seconds
from v2v_server.video.rows import Rows
from v2v_server.worker.arrays.context import SampleContext
from v2v_server.worker.job import ClipJob
from v2v_server.worker.making.make import sample_context
from v2v_server.worker.making.read import Decoded, decode_for

_READ_BYTES = 128 << 20
"""Memory for the frames that are decoded at a time, and as much for the levels between them."""
_NEEDS = Needs(events=True, seconds="must")


def spec_of_whole(spec: StreamSpec, video: VideoEntry, rows: Rows) -> StreamSpec:
    """Return the spec of a sample that is a whole video: its camera sees the picture as it lies, without pauses.

    Raises:
        VideoError: the video has a single frame, or its frame rate is unknown.
    """
    steps = (video.frames - 1) // spec.recipe.frame_stride
    if steps < 1:
        raise VideoError(video.id, None, "it has a single frame, and events need two")
    if not video.frames_per_second > 0:
        raise VideoError(video.id, None, "its frame rate is unknown: state it with --rate, or in a list")
    top, bottom = rows.bounds(video.height_px)
    recipe = replace(
        spec.recipe, voxels_per_clip=steps, bins=1, frames_per_bin=1, grids_per_frame=0, voxel_seconds=(0.0, 0.0),
        lead_frames=0, lead_voxels=0, crop_width_px=video.width_px, crop_height_px=bottom - top,
        resize_scale=(1.0, 1.0), flip_probability=0.0, pause_probability=0.0,
        start="triangular" if spec.recipe.start == "frames" else spec.recipe.start,
    )  # fmt: skip
    return StreamSpec(recipe=recipe, substep_px=spec.substep_px)


class WholeClip:
    """Read a whole video part by part.

    Args:
        lease: of a sample of :func:`spec_of_whole`.

    Attributes:
        size: width and height of the picture, px.
        since_us: [frames] float64, when each is shown after the first one, microseconds.
    """

    def __init__(self, lease: Lease) -> None:
        self._clip, self._index = ClipJob.of(lease), lease.indices[0]
        recipe = self._clip.spec.recipe
        self.size, self._steps, self._stride = recipe.crop_px[::-1], recipe.steps, recipe.frame_stride
        count = self._steps * self._stride + 1
        seconds = self._clip.frame_index(count).seconds(0, count)[:: self._stride]
        durations, irregular = step_seconds(seconds, np.arange(self._steps + 1), lease.frames_per_second / self._stride)
        self.since_us = 1e6 * (frame_times(durations) if irregular else seconds - seconds[0])

    def parts(self, source: VideoSource) -> Iterator[tuple[int, SampleContext]]:
        """Yield the first frame of each part, and what the camera sees; a part begins with the last frame of the one
        before.

        Raises:
            VideoError: the video is not the catalogued one, or cannot deliver the expected frames.
        """
        spec = self._clip.spec
        frame_bytes = self.size[0] * self.size[1] * (1 if spec.recipe.light == "sdr" else 2)
        most = max(1, _READ_BYTES // frame_bytes)
        at_once = max(1, most // (2 * spec.levels_per_step)) if spec.levels_per_step else most
        for first in range(0, self._steps, most):
            steps = min(most, self._steps - first)
            (decoded,) = decode_for(self._job(first, steps), (self._index,), source)
            for begin in range(0, steps, at_once):
                count = min(at_once, steps - begin)
                part = _steps_of(decoded, begin, count)
                yield first + begin, sample_context(self._job(first + begin, count), part, _NEEDS)[0]

    def _job(self, first: int, steps: int) -> ClipJob:
        """Return the clip of some steps, as if it were a sample."""
        spec = replace(self._clip.spec, recipe=replace(self._clip.spec.recipe, voxels_per_clip=steps))
        return replace(self._clip, spec=spec, start_frame=first * self._stride)


def _steps_of(decoded: Decoded, first: int, count: int) -> Decoded:
    """Return some steps of a decoded clip."""
    clip, shown = decoded.clip, slice(first, first + count + 1)
    motion = None if clip.motion is None else clip.motion[shown]
    part = replace(clip, frames=clip.frames[shown], seconds=clip.seconds[shown], motion=motion)
    return Decoded(replace(decoded.plan, source=np.arange(count + 1)), part)
