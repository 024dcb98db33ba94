"""Convert one video to its prepared form: decode, write under a temporary name, verify, rename.

A file is verified by reading all of it back: it has to give the exact frames that were decoded.
"""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import chain, islice
from pathlib import Path

import numpy as np
import xxhash

from v2v_protocol.errors import VideoError
from v2v_protocol.persisted import FloatOrNaN, Persisted
from v2v_protocol.write_aside import write_aside_and_rename
from v2v_server.corpus.scenes.analysis import SceneAnalysis
from v2v_server.corpus.scenes.scene import MOST_FRAMES, Scene
from v2v_server.store.packing import SIZES
from v2v_server.store.pixels import open_pixels
from v2v_server.store.planes import whole_cut
from v2v_server.store.reader import StoreFile
from v2v_server.store.writer import StoreWriter, head_of, planes_of, write_pictures
from v2v_server.video.collect import ClipRequest, Cut, DecodedPicture
from v2v_server.video.fingerprint import fingerprint
from v2v_server.video.frame_index import FrameIndex
from v2v_server.video.luma import MOST_BITS
from v2v_server.video.orientation import Window

PARTIAL_SUFFIX = ".v2v-partial"


@dataclass(frozen=True, slots=True)
class Transcoding(Persisted):
    """One video to prepare.

    Attributes:
        video: its id.
        source: the file.
        fingerprint: expected fingerprint of the file.
        index: its ``FrameIndex.to_bytes()``.
        frames_per_second: its average rate, NaN if unknown.
        window: the part of its upright pictures to store.
        size: how the file is packed, a key of :data:`v2v_server.store.packing.SIZES`.
        root: the folder that the target must not leave, resolved.
        target: the file to write; its folder is created if missing.
        scene: whether to compute the scene statistics.
        planes: names of the planes to store beside the luma, of :data:`v2v_server.store.planes.OPTIONAL`.
    """

    video: str
    source: Path
    fingerprint: str
    index: bytes
    frames_per_second: FloatOrNaN
    window: Window
    size: str
    root: Path
    target: Path
    scene: bool = False
    planes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Made(Persisted):
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
    index = FrameIndex.from_bytes(job.index)
    if not job.target.parent.resolve().is_relative_to(job.root):
        raise VideoError(os.fspath(job.source), None, f"{job.target.parent} is a link out of the destination")
    job.target.parent.mkdir(parents=True, exist_ok=True)
    # Hidden, so that no catalogue includes it; hashed, so that the suffix fits even with the longest names.
    name = hashlib.sha256(os.fsencode(job.target.name)).hexdigest()[:16]
    hidden = job.target.with_name(f".{name}{PARTIAL_SUFFIX}")
    with open_pixels(job.source) as source, write_aside_and_rename(job.target, partial=hidden) as partial:
        source.check(job.fingerprint)
        analysis = SceneAnalysis()
        pictures = source.pictures(_request(job, index, job.planes))
        if job.scene:
            pictures = _watched(pictures, analysis)
        made = _stored(job, index, partial, pictures)
    return replace(made, scene=analysis.scene()) if job.scene else made


def look_again(job: Transcoding) -> Scene:
    """Compute the statistics that :func:`transcode` computes with ``scene``, from the source alone.

    Raises:
        VideoError: the source is not the catalogued file, or a frame of it does not decode.
    """
    analysis = SceneAnalysis()
    with open_pixels(job.source) as source:
        source.check(job.fingerprint)
        for picture in islice(source.pictures(_request(job, FrameIndex.from_bytes(job.index))), MOST_FRAMES):
            analysis.add(picture.grey)
    return analysis.scene()


def _watched(pictures: Iterable[DecodedPicture], analysis: SceneAnalysis) -> Iterator[DecodedPicture]:
    """Yield the same pictures; those at the beginning are analysed as they pass."""
    for number, picture in enumerate(pictures):
        if number < MOST_FRAMES:
            analysis.add(picture.grey)
        yield picture


def _request(job: Transcoding, index: FrameIndex, planes: Iterable[str] = ()) -> ClipRequest:
    return ClipRequest(index, 0, (whole_cut(len(index), job.window, planes),), most_bits=MOST_BITS)


def _stored(job: Transcoding, index: FrameIndex, made: Path, pictures: Iterator[DecodedPicture]) -> Made:
    """Write a store file, and verify it by reading it back."""
    first, rate = next(pictures), job.frames_per_second
    head = head_of(
        first, index, job.window, video=job.video, fingerprint=job.fingerprint, first=0, count=len(index),
        packing=SIZES[job.size], frames_per_second=0.0 if math.isnan(rate) else rate, stored_index=job.index,
    )  # fmt: skip
    names = planes_of(head, job.planes)
    wanted, got = ({name: xxhash.xxh3_128() for name in ("", *names)} for _ in range(2))
    with StoreWriter(made, head, SIZES[job.size], names) as writer:
        for grey, arrays in write_pictures(writer, head, chain((first,), pictures), names):
            for name, array in (("", grey), *arrays.items()):
                wanted[name].update(np.ascontiguousarray(array).data)
        writer.close(lasting=True)
    with StoreFile(made, job.fingerprint) as stored:
        for picture in stored.pictures(ClipRequest(index, 0, (Cut(len(index), job.window),))):
            got[""].update(np.ascontiguousarray(picture.grey).data)
        for name in names:
            for array in stored.arrays(name):
                got[name].update(array.data)
    if any(wanted[name].digest() != got[name].digest() for name in wanted):
        raise VideoError(os.fspath(job.source), None, "verification: the stored file does not reproduce the frames")
    return Made(fingerprint(made), made.stat().st_size)
