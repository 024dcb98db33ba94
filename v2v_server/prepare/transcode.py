"""One video into its prepared form: decode, encode under a temporary name, verify, rename."""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import islice
from pathlib import Path

import av
import cv2
import numpy as np
import numpy.typing as npt
from av.video.frame import VideoFrame

from v2v_protocol.errors import VideoError
from v2v_server.catalogue.look import Look
from v2v_server.catalogue.scene import MOST_FRAMES, Scene
from v2v_server.prepare.encode import Encoding, encode_luma
from v2v_server.video.decode import decode_luma
from v2v_server.video.fingerprint import check_fingerprint, fingerprint
from v2v_server.video.frame_index import FrameIndex
from v2v_server.video.luma import LumaFormat, copy_luma, luma_plane, stretch
from v2v_server.video.orientation import Orientation, Window
from v2v_server.video.probe import probe
from v2v_server.video.source import opened, pictures, reason
from v2v_server.video.tiles import parts

PARTIAL_SUFFIX = ".v2v-partial"
HIGHEST_PSNR_DB = 100.0
"""Stands for equality."""

_COMPARED_FRAMES = 64
_LARGEST_DENOMINATOR = 10**6


@dataclass(frozen=True, slots=True)
class Transcoding:
    """One video to be prepared.

    Attributes:
        source: the file.
        fingerprint: which it must have.
        index: ``FrameIndex.to_bytes()`` of it.
        frames_per_second: its average rate, NaN where unknown; gives the time stamps where the index has none.
        window: of its upright pictures, what to keep.
        encoding: codec settings.
        root: the folder that the target must not leave, resolved.
        target: the file to make; its folder is made if missing.
        scene: whether to take the statistics of what it shows.
    """

    source: Path
    fingerprint: str
    index: bytes
    frames_per_second: float
    window: Window
    encoding: Encoding
    root: Path
    target: Path
    scene: bool = False


@dataclass(frozen=True, slots=True)
class Made:
    """A prepared file that was verified.

    Attributes:
        fingerprint, bytes: of it.
        psnr_db, worst_psnr_db: of all frames together and of the worst, against what the source decodes to.
        scene: of the source's frames; None where it was not asked for.
    """

    fingerprint: str
    bytes: int
    psnr_db: float
    worst_psnr_db: float
    scene: Scene | None = None


def transcode(job: Transcoding) -> Made:
    """Make the prepared file. Under its final name it is either whole and verified, or what stood there before.

    Raises:
        VideoError: the source is not what was catalogued, a frame of it does not decode, its frame rate is unknown,
            the encoder refuses, or what was written does not give back as many frames at the same times.
        OSError: the target cannot be written.
    """
    check_fingerprint(job.source, job.fingerprint)
    index = FrameIndex.from_bytes(job.index)
    pts, time_base = _times(job, index)
    if not job.target.parent.resolve().is_relative_to(job.root):
        raise VideoError(os.fspath(job.source), None, f"{job.target.parent} is a link out of the destination")
    job.target.parent.mkdir(parents=True, exist_ok=True)
    # Hidden, so that no catalogue takes it in; hashed, so that the longest of names leaves room for the suffix.
    name = hashlib.sha256(os.fsencode(job.target.name)).hexdigest()[:16]
    partial = job.target.with_name(f".{name}{PARTIAL_SUFFIX}")
    try:
        height, width = job.window[2:]
        frames = luma_frames(job.source, index, job.window)
        seen = Look()
        if job.scene:
            frames = _watched(frames, seen)
        encode_luma(partial, frames, job.encoding, height=height, width=width, pts=pts, time_base=time_base)
        made = _verified(job, index, partial, pts, time_base)
        with partial.open("rb") as file:
            os.fsync(file.fileno())
        partial.replace(job.target)
    finally:
        partial.unlink(missing_ok=True)
    return replace(made, scene=seen.scene()) if job.scene else made


def look_again(job: Transcoding) -> Scene:
    """The statistics that :func:`transcode` takes with ``scene``, from the source alone and without a prepared file.

    Raises:
        VideoError: the source is not what was catalogued, or a frame of it does not decode.
    """
    check_fingerprint(job.source, job.fingerprint)
    seen = Look()
    for frame in islice(luma_frames(job.source, FrameIndex.from_bytes(job.index), job.window), MOST_FRAMES):
        seen.add(frame)
    return seen.scene()


def _watched(frames: Iterator[npt.NDArray[np.uint8]], seen: Look) -> Iterator[npt.NDArray[np.uint8]]:
    """The same frames; those at the beginning are looked at on their way."""
    for number, frame in enumerate(frames):
        if number < MOST_FRAMES:
            seen.add(frame)
        yield frame


def luma_frames(path: str | os.PathLike[str], index: FrameIndex, window: Window) -> Iterator[npt.NDArray[np.uint8]]:
    """All frames of a file, one by one: what :func:`v2v_server.video.decode.decode_luma` gives for the whole range, in
    the memory of one.

    Args:
        path: the file.
        index: its whole index.
        window: (top, left, height, width) in the upright picture, pixels.

    Yields:
        [height, width] uint8, full-range luma.

    Raises:
        VideoError: a frame is missing or damaged, or the picture's size or format is not the same all along.
    """
    if not index.tiles:
        yield from _track_frames(path, index, window)
        return
    needed = parts(window, index.tiles)
    tiles = [_track_frames(path, index.of_tile(part.track), part.window, part.track) for part in needed]
    for columns in zip(*tiles, strict=True):
        yield np.concatenate(columns, axis=1)


def _track_frames(
    path: str | os.PathLike[str], index: FrameIndex, window: Window, track: int = 0
) -> Iterator[npt.NDArray[np.uint8]]:
    name = os.fspath(path)
    done = 0
    with opened(path, track=track) as (container, stream):
        try:
            for frame in pictures(container, stream):
                if index.seekable and frame.pts is not None and frame.pts < index.pts[0]:
                    continue
                _check(name, frame, index, done)
                if done == 0:
                    luma, orientation = LumaFormat.of(frame), Orientation.of(frame)
                    size = orientation.size(index.height_px, index.width_px)
                    stored = orientation.stored_window(window, index.height_px, index.width_px)
                if (frame.height, frame.width) != size or not luma.describes(frame):
                    raise VideoError(name, done, "the picture's size or format changes here")
                frames = np.empty((1, *stored[2:]), np.uint8)
                copy_luma(luma_plane(frame, luma), luma, stored, frames[0])
                stretch(frames, luma)
                yield orientation.upright(frames)[0]
                done += 1
                if done == len(index):
                    return
        except av.FFmpegError as error:
            raise VideoError(name, done, f"does not decode: {reason(error)}") from error
    raise VideoError(name, done, "the file ends before it")


def _check(name: str, frame: VideoFrame, index: FrameIndex, ordinal: int) -> None:
    if frame.is_corrupt:
        raise VideoError(name, ordinal, "is damaged")
    if index.seekable and frame.pts != index.pts[ordinal]:
        raise VideoError(
            name, ordinal, f"the decoder delivers time stamp {frame.pts} where {index.pts[ordinal]} should come"
        )


def _times(job: Transcoding, index: FrameIndex) -> tuple[list[int], Fraction]:
    if index.seekable:
        # Containers cannot begin before 0, and nothing depends on where the clock begins.
        return (index.pts - min(0, int(index.pts[0]))).tolist(), Fraction(*index.time_base)
    if not (math.isfinite(job.frames_per_second) and job.frames_per_second > 0):
        raise VideoError(os.fspath(job.source), None, "has neither usable time stamps nor a frame rate")
    period = 1 / Fraction(job.frames_per_second).limit_denominator(1001)
    return list(range(len(index))), period.limit_denominator(_LARGEST_DENOMINATOR)


def _verified(job: Transcoding, index: FrameIndex, made: Path, pts: list[int], time_base: Fraction) -> Made:
    found = probe(made).index
    height, width = job.window[2:]
    name = os.fspath(job.source)
    if (len(found), found.height_px, found.width_px) != (len(index), height, width):
        raise VideoError(
            name, None, f"verification: {len(found)} frames of {found.width_px}x{found.height_px} px were written, not "
            f"{len(index)} of {width}x{height} px"
        )  # fmt: skip
    scale = Fraction(*found.time_base) / time_base
    for ordinal, (stamp, wanted) in enumerate(zip(found.pts.tolist(), pts, strict=True)):
        if stamp * scale != wanted:
            raise VideoError(name, ordinal, f"verification: its time stamp became {stamp * scale} instead of {wanted}")
    errors = _squared_errors(job, index, made, found)
    return Made(fingerprint(made), made.stat().st_size, _psnr_db(float(errors.mean())), _psnr_db(float(errors.max())))


def _squared_errors(job: Transcoding, index: FrameIndex, made: Path, found: FrameIndex) -> npt.NDArray[np.float64]:
    """[n] mean squared error of each prepared frame, as the server will decode it, against the source's."""
    errors = np.empty(len(index))
    for ordinal, wanted in enumerate(luma_frames(job.source, index, job.window)):
        at = ordinal % _COMPARED_FRAMES
        if at == 0:
            count = min(_COMPARED_FRAMES, len(index) - ordinal)
            got = decode_luma(made, found.slice(ordinal, count), ordinal, count).frames
        errors[ordinal] = cv2.norm(wanted, got[at], cv2.NORM_L2SQR) / wanted.size
    return errors


def _psnr_db(mean_squared_error: float) -> float:
    if mean_squared_error == 0:
        return HIGHEST_PSNR_DB
    return min(HIGHEST_PSNR_DB, 10 * math.log10(255**2 / mean_squared_error))
