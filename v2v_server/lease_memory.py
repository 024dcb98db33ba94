"""How much memory a lease takes, and how much it may."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from v2v_protocol.spec import StreamSpec
from v2v_server.kinds.registry import kind_of
from v2v_server.video.rows import Rows

if TYPE_CHECKING:  # a worker, which needs one limit, starts without SQLite
    from v2v_server.corpus.videos import VideoEntry

MOST_CLIP_BYTES = 2 << 30
"""Largest size of the decoded frames of one lease without margins, in 8 bits."""
MOST_LEASE_BYTES = 7 << 30
"""Largest memory that one lease may take, with all that its spec may ask for; a worker has a GiB more."""
LARGEST_MEMORY_BYTES = MOST_LEASE_BYTES + (1 << 30)
"""A worker that needs more ends. After three such ends its sample is refused for its spec."""
WORKER_BYTES = 2 << 30
"""Memory that the files in ``deploy`` and the Ray engine give a worker: enough for the 201 frames of the paper, resized
from 3840 x 2160 (:func:`lease_bytes`).
"""
_IDLE_BYTES = 256 << 20
"""A worker without a lease has 182 MiB; the rest is for what grows with neither frames nor pictures."""
_DECODER_BYTES = 24
"""For each pixel of a picture. H.264 of 3840 x 2160 took 13 with 8 bits and 29 with 10."""


def frame_bytes(video: VideoEntry, rows: Rows, spec: StreamSpec) -> tuple[int, int]:
    """Return the bytes that each frame of a lease adds: to the decoded frames of all its samples, without margins and
    in 8 bits; and at most to its worker's memory. Requested arrays do not count: they never change which videos are
    shown.

    Frames are held whole until they are resized, however small the sample is. With scene "auto" those of all samples
    are held twice while repeated ones are left out. One sample at a time then has its view and a copy of it, voxels,
    and the levels between its frames.
    """
    recipe, samples = spec.recipe, spec.samples_per_decode
    window, crop, depth = _sizes_of(video, rows, spec)
    read = window if recipe.resize_scale != (1.0, 1.0) else crop
    held = samples + (1 if spec.scene == "off" else samples)
    seen = 2 * depth + np.dtype(spec.voxel_dtype).itemsize + 2 * spec.levels_per_step
    return read * samples, depth * window * held + seen * crop


def _sizes_of(video: VideoEntry, rows: Rows, spec: StreamSpec) -> tuple[int, int, int]:
    """Return the pixels of each frame that are decoded for a sample, those of its crop, and the bytes of a level."""
    top, bottom = rows.bounds(video.height_px)
    window, depth = kind_of(video.id).reads(spec, bottom - top, video.width_px)
    return window, spec.recipe.crop_height_px * spec.recipe.crop_width_px, depth


def lease_bytes(video: VideoEntry, rows: Rows, spec: StreamSpec, array_bytes: int) -> int:
    """Return the memory that a worker needs for one lease, its own included, bytes: an upper bound, by measurements.

    Unlike the limit on sequences, it may change from release to release: it decides which worker makes a sample, and
    never what is in it.

    Args:
        video, rows, spec: what the lease is for.
        array_bytes: size of the arrays of one sample. Those of the sample before may still be on their way.
    """
    recipe = spec.recipe
    window, crop, depth = _sizes_of(video, rows, spec)
    frames = int(recipe.held_at(video.frames_per_second)) // recipe.frame_stride + 1
    # Repeated frames are left out of a copy, and a picture is turned upright in one: phones film upright pictures so.
    is_copied = (spec.scene != "off" and "duplicates" not in spec.kept_defects) or video.height_px > video.width_px
    views = (recipe.resize_scale != (1.0, 1.0)) + (2 if recipe.contrast_probability else 1)
    clips = frames * depth * window * spec.samples_per_decode * (1 + is_copied)
    decoder = _DECODER_BYTES * video.width_px * video.height_px
    simulation = frames * crop * (depth * views + 2 * spec.levels_per_step) + array_bytes
    return _IDLE_BYTES + clips + max(decoder, simulation) + array_bytes


def most_steps(video: VideoEntry, rows: Rows, spec: StreamSpec) -> int:
    """Return the largest number of steps whose frames a lease may hold."""
    read, taken = frame_bytes(video, rows, spec)
    return min(MOST_CLIP_BYTES // read, MOST_LEASE_BYTES // taken) - 1
