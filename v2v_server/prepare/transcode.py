"""Convert one video to its prepared form: decode, write under a temporary name, verify, rename.

A file is verified by reading all of it back: it has to give the exact frames that were decoded. The statistics of its
scene are computed on the way.
"""

from __future__ import annotations

import hashlib
import math
import os
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import xxhash

from v2v_protocol.errors import VideoError
from v2v_protocol.persisted import Persisted
from v2v_protocol.write_aside import write_aside_and_rename
from v2v_server.corpus.manifest import prepared_name
from v2v_server.corpus.scenes.analysis import SceneAnalysis
from v2v_server.corpus.scenes.scene import MOST_ANALYSED_FRAMES, Scene
from v2v_server.corpus.videos import VideoEntry
from v2v_server.store.format import SIZES
from v2v_server.store.pixels import kind_of, open_pixels
from v2v_server.store.planes import whole_cut
from v2v_server.store.store_file import StoreFile, write_store
from v2v_server.video.collect import ClipRequest, Cut
from v2v_server.video.frame_index import FrameIndex
from v2v_server.video.luma import MOST_BITS
from v2v_server.video.orientation import PixelRect

PARTIAL_SUFFIX = ".v2v-partial"
_Hashes = defaultdict[str, xxhash.xxh3_128]
"""Of the arrays of all frames of a file, by plane; "" is the luma."""


@dataclass(frozen=True, slots=True)
class Transcoding(Persisted):
    """One video to prepare.

    Attributes:
        video: as catalogued.
        source: its file.
        size: how the file is packed, a key of :data:`v2v_server.store.format.SIZES`.
        root: the folder to write to, resolved.
        stands: whether the target is this already, and only its statistics are wanted.
        scene: whether to compute the scene statistics.
        planes: names of the planes to store beside the luma, of :data:`v2v_server.store.planes.OPTIONAL`.
        window: the part of its upright pictures to store. Window and index are filled in when the job is due.
        index: its ``FrameIndex.to_bytes()``.
    """

    video: VideoEntry
    source: Path
    size: str
    root: Path
    stands: bool = False
    scene: bool = False
    planes: tuple[str, ...] = ()
    window: PixelRect = (0, 0, 0, 0)
    index: bytes = b""

    @property
    def target(self) -> Path:
        """Return the file to write; its folder is created if missing."""
        return self.root / prepared_name(self.video.id)


@dataclass(frozen=True, slots=True)
class Made(Persisted):
    """A prepared and verified file.

    Attributes:
        bytes: its size.
        scene: statistics of its frames; None if they were not requested.
    """

    bytes: int
    scene: Scene | None = None


def transcode(job: Transcoding) -> Made:
    """Write the prepared file, and read it back. Its final name holds either the complete, verified file or the earlier
    one.

    Raises:
        VideoError: the source is not the catalogued file, a frame of it does not decode, or the written file does not
            give the same frames.
        OSError: the target cannot be written.
    """
    if job.stands:
        return _read_back(job, job.target)
    index = FrameIndex.from_bytes(job.index)
    if not job.target.parent.resolve().is_relative_to(job.root):
        raise VideoError(os.fspath(job.source), None, f"{job.target.parent} is a link out of the destination")
    job.target.parent.mkdir(parents=True, exist_ok=True)
    # Hidden, so that no catalogue includes it; hashed, so that the suffix fits even with the longest names.
    name = hashlib.sha256(os.fsencode(job.target.name)).hexdigest()[:16]
    hidden = job.target.with_name(f".{name}{PARTIAL_SUFFIX}")
    cut, rate = whole_cut(len(index), job.window, job.planes), job.video.frames_per_second
    written = _Hashes(xxhash.xxh3_128)
    with (
        open_pixels(job.source, kind_of(job.video.id)) as source,
        write_aside_and_rename(job.target, partial=hidden) as path,
    ):
        source.check(job.video.fingerprint)
        write_store(
            path, source.pictures(ClipRequest(index, 0, (cut,), most_bits=MOST_BITS)), index, job.window, 0,
            len(index), video=job.video.id, fingerprint=job.video.fingerprint, packing=SIZES[job.size],
            planes=job.planes, frames_per_second=0.0 if math.isnan(rate) else rate, stored_index=job.index,
            lasting=True, see=partial(_add, written),
        )  # fmt: skip
        return _read_back(job, path, written)


def _add(hashes: _Hashes, arrays: Mapping[str, npt.NDArray[Any]]) -> None:
    """Add what there is of the next frame."""
    for name, array in arrays.items():
        hashes[name].update(np.ascontiguousarray(array).data)


def _read_back(job: Transcoding, path: Path, written: _Hashes | None = None) -> Made:
    """Read a store file: for its statistics, and all of it if it is to be compared with what was written."""
    index, analysis, read = FrameIndex.from_bytes(job.index), SceneAnalysis(), _Hashes(xxhash.xxh3_128)
    with StoreFile(path, job.video.fingerprint) as stored:
        count = min(len(index), MOST_ANALYSED_FRAMES) if written is None else len(index)
        for number, picture in enumerate(stored.pictures(ClipRequest(index, 0, (Cut(count, job.window),)))):
            _add(read, {"": picture.grey})
            if job.scene and number < MOST_ANALYSED_FRAMES:
                analysis.add(picture.grey)
        for name in filter(None, written or ()):
            for array in stored.arrays(name):
                _add(read, {name: array})
    if written is not None and any(read[name].digest() != each.digest() for name, each in written.items()):
        raise VideoError(os.fspath(job.source), None, "verification: the stored file does not reproduce the frames")
    return Made(path.stat().st_size, analysis.scene() if job.scene else None)
