"""Convert one video to its prepared form: decode, write under a temporary name, verify, rename.

A lossless file is verified by reading all of it back: it has to give the exact frames that were decoded. A lossy one is
decoded again and compared with its source.
"""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import chain, islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import xxhash

from v2v_protocol.errors import VideoError
from v2v_protocol.write_aside import write_aside_and_rename
from v2v_server.corpus.scenes.analysis import SceneAnalysis
from v2v_server.corpus.scenes.scene import MOST_FRAMES, Scene
from v2v_server.prepare.encode import encode_luma
from v2v_server.store.chroma import matrix_of, whole_chroma
from v2v_server.store.clips import stored_arrays, stored_pictures
from v2v_server.store.depth import detail_planes, grey_of, same_transfer
from v2v_server.store.encoding import Encoding
from v2v_server.store.format import Head, group_frames_for
from v2v_server.store.motion import with_planes
from v2v_server.store.packing import SIZES
from v2v_server.store.reader import StoreFile
from v2v_server.store.writer import StoreWriter
from v2v_server.video.collect import LastFrame
from v2v_server.video.decode import BIT_EXACT_CODECS, decode_luma, stream_decoded, stream_luma
from v2v_server.video.fingerprint import check_fingerprint, fingerprint
from v2v_server.video.frame_index import FrameIndex
from v2v_server.video.luma import MOST_BITS, SDR
from v2v_server.video.orientation import Window
from v2v_server.video.probe import probe

PARTIAL_SUFFIX = ".v2v-partial"
HIGHEST_PSNR_DB = 100.0
"""Stands for equality."""

_Frame = tuple[LastFrame, npt.NDArray[Any]]
_COMPARED_FRAMES = 64
_LARGEST_DENOMINATOR = 10**6


@dataclass(frozen=True, slots=True)
class Transcoding:
    """One video to prepare.

    Attributes:
        video: its id.
        source: the file.
        fingerprint: expected fingerprint of the file.
        codec: FFmpeg's name of its format.
        index: its ``FrameIndex.to_bytes()``.
        frames_per_second: its average rate, NaN if unknown; gives the time stamps if the index has none.
        window: the part of its upright pictures to store.
        encoding: codec settings.
        root: the folder that the target must not leave, resolved.
        target: the file to write; its folder is created if missing.
        scene: whether to compute the scene statistics.
        planes: names of the planes to store beside the luma, of :data:`v2v_server.store.motion.MADE_PLANES`.
    """

    video: str
    source: Path
    fingerprint: str
    codec: str
    index: bytes
    frames_per_second: float
    window: Window
    encoding: Encoding
    root: Path
    target: Path
    scene: bool = False
    planes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Made:
    """A prepared and verified file.

    Attributes:
        fingerprint, bytes: fingerprint and size of the file.
        psnr_db, worst_psnr_db: of all frames together and of the worst, against the decoded source.
        scene: statistics of the source's frames; None if they were not requested.
    """

    fingerprint: str
    bytes: int
    psnr_db: float
    worst_psnr_db: float
    scene: Scene | None = None


def transcode(job: Transcoding) -> Made:
    """Write the prepared file. Its final name holds either the complete, verified file or the earlier one.

    Raises:
        VideoError: the source is not the catalogued file, a frame of it does not decode, its frame rate is unknown, the
            encoder refuses, or the written file does not have as many frames at the same times.
        OSError: the target cannot be written.
    """
    check_fingerprint(job.source, job.fingerprint)
    index = FrameIndex.from_bytes(job.index)
    if not job.target.parent.resolve().is_relative_to(job.root):
        raise VideoError(os.fspath(job.source), None, f"{job.target.parent} is a link out of the destination")
    job.target.parent.mkdir(parents=True, exist_ok=True)
    # Hidden, so that no catalogue includes it; hashed, so that the suffix fits even with the longest names.
    name = hashlib.sha256(os.fsencode(job.target.name)).hexdigest()[:16]
    hidden = job.target.with_name(f".{name}{PARTIAL_SUFFIX}")
    with write_aside_and_rename(job.target, partial=hidden) as partial:
        analysis = SceneAnalysis()
        frames = _decoded(job, index, MOST_BITS if job.encoding.is_lossless else SDR.bits)
        if job.scene:
            frames = _watched(frames, analysis)
        made = (
            _stored(job, index, partial, frames) if job.encoding.is_lossless else _encoded(job, index, partial, frames)
        )
    return replace(made, scene=analysis.scene()) if job.scene else made


def look_again(job: Transcoding) -> Scene:
    """Compute the statistics that :func:`transcode` computes with ``scene``, from the source alone.

    Raises:
        VideoError: the source is not the catalogued file, or a frame of it does not decode.
    """
    check_fingerprint(job.source, job.fingerprint)
    analysis = SceneAnalysis()
    for frame in islice(_frames(job, FrameIndex.from_bytes(job.index)), MOST_FRAMES):
        analysis.add(frame)
    return analysis.scene()


def _watched(frames: Iterator[_Frame], analysis: SceneAnalysis) -> Iterator[_Frame]:
    """Yield the same frames; those at the beginning are analysed as they pass."""
    for number, frame in enumerate(frames):
        if number < MOST_FRAMES:
            analysis.add(grey_of(*frame))
        yield frame


def _decoded(job: Transcoding, index: FrameIndex, most_bits: int | None) -> Iterator[_Frame]:
    chroma = whole_chroma(job.planes, job.window)
    return stream_decoded(job.source, index, 0, len(index), job.window, most_bits, chroma)


def _frames(job: Transcoding, index: FrameIndex) -> Iterator[npt.NDArray[np.uint8]]:
    return stream_luma(job.source, index, 0, len(index), job.window)


def _stored(job: Transcoding, index: FrameIndex, made: Path, frames: Iterator[_Frame]) -> Made:
    """Write a store file, and verify it by reading it back."""
    first = next(frames)
    signal = first[0].signal
    packing = SIZES[job.encoding.size]
    top, _, rows, width = job.window
    rate = job.frames_per_second
    head = Head(
        video=job.video, fingerprint=job.fingerprint, height_px=index.height_px, width_px=width, top=top, rows=rows,
        first=0, count=len(index), frames=len(index), frames_per_second=0.0 if math.isnan(rate) else rate,
        codec=job.codec, bit_exact=job.codec in BIT_EXACT_CODECS, group=group_frames_for(rows, width),
        packing=packing.method, index=job.index, bits=signal.bits, transfer=signal.transfer,
        matrix=matrix_of(first[0]),
    )  # fmt: skip
    names = [*job.planes, *detail_planes(signal)]
    wanted, got = ({name: xxhash.xxh3_128() for name in ("", *names)} for _ in range(2))
    with StoreWriter(made, head, packing, names) as writer:
        for picture, planes in with_planes(same_transfer(head, chain((first,), frames)), names):
            for name, array in (("", picture), *planes.items()):
                wanted[name].update(np.ascontiguousarray(array).data)
            writer.add(picture, planes)
        writer.close(lasting=True)
    with StoreFile(made, job.fingerprint) as stored:
        for picture in stored_pictures(stored, job.window):
            got[""].update(np.ascontiguousarray(picture).data)
        for name in names:
            for array in stored_arrays(stored, name):
                got[name].update(array.data)
    if any(wanted[name].digest() != got[name].digest() for name in wanted):
        raise VideoError(os.fspath(job.source), None, "verification: the stored file does not reproduce the frames")
    return Made(fingerprint(made), made.stat().st_size, HIGHEST_PSNR_DB, HIGHEST_PSNR_DB)


def _encoded(job: Transcoding, index: FrameIndex, made: Path, frames: Iterator[_Frame]) -> Made:
    """Encode a video, and compare it with its source."""
    pts, time_base = _times(job, index)
    height, width = job.window[2:]
    first = next(frames)
    pictures, transfer = (picture for _, picture in chain((first,), frames)), first[0].signal.transfer
    encode_luma(
        made, pictures, job.encoding, transfer, height=height, width=width, pts=pts, time_base=time_base
    )  # fmt: skip
    verified = _verified(job, index, made, pts, time_base)
    with made.open("rb") as file:
        os.fsync(file.fileno())
    return verified


def _times(job: Transcoding, index: FrameIndex) -> tuple[list[int], Fraction]:
    if index.seekable:
        # Containers cannot begin before 0, and only differences of time stamps matter.
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
    """Return the mean squared error of each prepared frame [n], as the server will decode it, against the source."""
    errors = np.empty(len(index))
    for ordinal, wanted in enumerate(_frames(job, index)):
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
