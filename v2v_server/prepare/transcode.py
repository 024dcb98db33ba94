"""Convert one video to its prepared form: decode, write under a temporary name, verify, rename.

A file is verified by reading all of it back: it has to give the exact frames that were decoded.
"""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import chain, islice
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import xxhash

from v2v_protocol.errors import VideoError
from v2v_protocol.write_aside import write_aside_and_rename
from v2v_server.corpus.scenes.analysis import SceneAnalysis
from v2v_server.corpus.scenes.scene import MOST_FRAMES, Scene
from v2v_server.store.format import Head, group_frames_for
from v2v_server.store.packing import SIZES
from v2v_server.store.planes.chroma import matrix_of, whole_chroma
from v2v_server.store.planes.detail import detail_planes, grey_of, same_transfer
from v2v_server.store.planes.motion import with_planes
from v2v_server.store.reader import StoreFile
from v2v_server.store.video_file import stored_arrays, stored_pictures
from v2v_server.store.writer import StoreWriter
from v2v_server.video.collect import LastFrame
from v2v_server.video.decode import BIT_EXACT_CODECS, stream_decoded, stream_luma
from v2v_server.video.fingerprint import check_fingerprint, fingerprint
from v2v_server.video.frame_index import FrameIndex
from v2v_server.video.luma import MOST_BITS
from v2v_server.video.orientation import Window

PARTIAL_SUFFIX = ".v2v-partial"

_Frame = tuple[LastFrame, npt.NDArray[Any]]


@dataclass(frozen=True, slots=True)
class Transcoding:
    """One video to prepare.

    Attributes:
        video: its id.
        source: the file.
        fingerprint: expected fingerprint of the file.
        codec: FFmpeg's name of its format.
        index: its ``FrameIndex.to_bytes()``.
        frames_per_second: its average rate, NaN if unknown.
        window: the part of its upright pictures to store.
        size: how the file is packed, a key of :data:`v2v_server.store.packing.SIZES`.
        root: the folder that the target must not leave, resolved.
        target: the file to write; its folder is created if missing.
        scene: whether to compute the scene statistics.
        planes: names of the planes to store beside the luma, of :data:`v2v_server.store.planes.motion.MADE_PLANES`.
    """

    video: str
    source: Path
    fingerprint: str
    codec: str
    index: bytes
    frames_per_second: float
    window: Window
    size: str
    root: Path
    target: Path
    scene: bool = False
    planes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Made:
    """A prepared and verified file.

    Attributes:
        fingerprint, bytes: fingerprint and size of the file.
        scene: statistics of the source's frames; None if they were not requested.
    """

    fingerprint: str
    bytes: int
    scene: Scene | None = None


def transcode(job: Transcoding) -> Made:
    """Write the prepared file. Its final name holds either the complete, verified file or the earlier one.

    Raises:
        VideoError: the source is not the catalogued file, a frame of it does not decode, or the written file does not
            give the same frames.
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
        frames = _decoded(job, index, MOST_BITS)
        if job.scene:
            frames = _watched(frames, analysis)
        made = _stored(job, index, partial, frames)
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
    packing = SIZES[job.size]
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
    return Made(fingerprint(made), made.stat().st_size)
