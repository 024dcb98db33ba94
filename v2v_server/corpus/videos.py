"""The videos of a snapshot in columns; an entry is made when it is read."""

from __future__ import annotations

import hashlib
import math
from bisect import bisect_left
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import overload

from v2v_protocol.errors import UsageError, VideoError
from v2v_protocol.persisted import FloatOrNaN, Persisted
from v2v_protocol.sample import ARRAYS, sidecar_endings
from v2v_server.corpus.index.columns import CHUNK, NO_STRINGS, VideoTable
from v2v_server.corpus.scenes.pieces import SplitVideos
from v2v_server.corpus.sidecars import Sidecars
from v2v_server.corpus.sources.source import VideoSource
from v2v_server.store.planes import PLANES
from v2v_server.store.reader import StoreFile
from v2v_server.video.rows import Rows

Thresholds = tuple[float | None, float | None]
NO_THRESHOLDS: Thresholds = (None, None)


@dataclass(frozen=True, slots=True)
class VideoEntry(Persisted):
    """A video that can be used.

    Attributes:
        id: relative POSIX path, the video's permanent name.
        fingerprint: see :mod:`v2v_server.video.fingerprint`.
        frames: number of frames to decode.
        width_px, height_px: size of the upright picture, before ``rows``.
        frames_per_second: average rate; NaN where unknown.
        codec: FFmpeg's name of the format.
        threshold_pos, threshold_neg: contrast thresholds that the list file states, log units; None without.
        pieces: its pieces, see :func:`v2v_server.corpus.scenes.pieces.encoded_pieces`; None where the catalogue was
            opened without ``scene``.
        remark: what of it is not served, or served with wrong grey levels (:class:`v2v_server.video.probe.VideoFacts`).
    """

    id: str
    fingerprint: str
    frames: int
    width_px: int
    height_px: int
    frames_per_second: FloatOrNaN
    codec: str
    threshold_pos: float | None = None
    threshold_neg: float | None = None
    pieces: bytes | None = None
    remark: str = ""


class Videos(Sequence[VideoEntry]):
    """The videos of a snapshot by id: facts in memory, looked up by number without reading the index.

    Args:
        table: the usable rows, sorted by id.
        thresholds: (positive, negative) of videos that have some, by number.
        split: the videos that are divided into pieces; None where that is unknown.

    Attributes:
        ids, fingerprints, frames, frames_per_second, width_px, height_px, interlaced, remark: columns, one value for
            each video.
        split: as given.
    """

    def __init__(
        self, table: VideoTable, thresholds: Mapping[int, Thresholds], split: SplitVideos | None = None
    ) -> None:
        self._table = replace(table, summaries=NO_STRINGS)  # tens of MB that only ``split`` is made of
        self._thresholds, self.split = thresholds, split
        self.ids, self.fingerprints, self.frames = table.ids, table.fingerprints, table.frames
        self.frames_per_second = table.frames_per_second
        self.width_px, self.height_px, self.interlaced = table.width_px, table.height_px, table.interlaced
        self.remark = table.remark

    def find(self, id: str) -> int | None:
        """Return the number of the video with an id; None if there is none."""
        return self.ids.find(id)

    def shape(self, id: str) -> tuple[int, int, int]:
        """Return number of frames, height and width (px) of the video with an id of these."""
        number = bisect_left(self.ids, id)
        return int(self.frames[number]), int(self.height_px[number]), int(self.width_px[number])

    def digest(self, rows: Rows) -> str:
        """Return 32 hexadecimal digits that name these videos with these rows.

        Fingerprints cover the track and its orientation.
        """
        sha = hashlib.sha256(f"v2v catalogue 2\n{rows}\n".encode())
        pos, neg = NO_THRESHOLDS
        none, limits = f"{pos}\0{neg}", {number: f"{pos}\0{neg}" for number, (pos, neg) in self._thresholds.items()}
        table = self._table
        numbers = table.frames, table.width_px, table.height_px, table.frames_per_second
        for start in range(0, len(self), CHUNK):
            those = slice(start, start + CHUNK)
            columns = table.ids[those], table.fingerprints[those], *(column[those].tolist() for column in numbers)
            lines = [
                f"{id}\0{fingerprint}\0{frames}\0{width}\0{height}\0{rate}\0{limits.get(number, none)}\n"
                for number, (id, fingerprint, frames, width, height, rate) in enumerate(
                    zip(*columns, strict=True), start
                )
            ]
            sha.update("".join(lines).encode())
        return sha.hexdigest()[:32]

    def __len__(self) -> int:
        return len(self.frames)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Videos) and len(self) == len(other) and all(map(VideoEntry.__eq__, self, other))

    __hash__ = None  # type: ignore[assignment]

    def __iter__(self) -> Iterator[VideoEntry]:
        return map(self.__getitem__, range(len(self)))

    @overload
    def __getitem__(self, at: int) -> VideoEntry: ...

    @overload
    def __getitem__(self, at: slice) -> tuple[VideoEntry, ...]: ...

    def __getitem__(self, at: int | slice) -> VideoEntry | tuple[VideoEntry, ...]:
        if isinstance(at, slice):
            return tuple(self[number] for number in range(*at.indices(len(self))))
        number = range(len(self))[at]
        record = self._table.row(number)
        pos, neg = self._thresholds.get(number, NO_THRESHOLDS)
        return VideoEntry(
            id=record.id,
            fingerprint=record.fingerprint,
            frames=record.frames,
            width_px=record.width_px,
            height_px=record.height_px,
            frames_per_second=math.nan if record.frames_per_second is None else record.frames_per_second,
            codec=record.codec,
            threshold_pos=pos,
            threshold_neg=neg,
            pieces=None if self.split is None else self.split.encoded(number),
            remark=record.remark,
        )


_ASKED = 16
"""Prepared files that are checked for their planes."""


def missing_arrays(source: VideoSource, ids: Sequence[str]) -> dict[str, str]:
    """Return the arrays that need a plane which some prepared files lack, with the remedy.

    Some files of this host are read, evenly spaced.
    """
    some = ids[:: max(1, len(ids) // _ASKED)]
    return {
        plane.serves: f"the plane {name}, which these prepared videos do not have: {plane.remedy}"
        for name, plane in PLANES.items()
        if plane.serves in ARRAYS and not (source.is_local and all(_has_plane(source, id, name) for id in some))
    }


def _has_plane(source: VideoSource, id: str, name: str) -> bool:
    try:
        with source.open_pixels(id, "") as pixels:
            return isinstance(pixels, StoreFile) and name in pixels.planes
    except VideoError:  # making a sample says why
        return True


@dataclass(frozen=True, slots=True)
class CorpusFacts:
    """Facts about a corpus, all in memory: using them never reads the index on disk.

    Attributes:
        videos: the videos that can be used, by id.
        rows: the usable rows of each picture.
        digest: names this snapshot.
        scene_digest: names this snapshot together with the statistics of its videos; None without them.
        sidecars: the files beside the videos, by ending.
        missing: arrays that cannot be made from the prepared videos, with the remedy.
    """

    videos: Sequence[VideoEntry]
    rows: Rows
    digest: str
    scene_digest: str | None
    sidecars: Mapping[str, Sidecars] = field(default_factory=dict)
    missing: Mapping[str, str] = field(default_factory=dict)

    def require_arrays(self, arrays: tuple[str, ...]) -> None:
        """Check that the videos have what these arrays are made from.

        Raises:
            UsageError: they do not.
        """
        for name in arrays:
            if name in self.missing:
                raise UsageError(
                    f"arrays: {name} needs {self.missing[name]}, or serve the videos that they were prepared from"
                )

    def sidecars_of(self, video: str, arrays: tuple[str, ...]) -> dict[str, str]:
        """Return the fingerprints of a video's sidecars that these arrays are made from, by ending."""
        found = {ending: self.sidecars[ending].fingerprints.get(video) for ending in sidecar_endings(arrays)}
        return {ending: fingerprint for ending, fingerprint in found.items() if fingerprint is not None}

    def sidecars_digest(self, arrays: tuple[str, ...]) -> str:
        """Return a name of all sidecars that these arrays are made from; "" if they are made from none."""
        digests = [self.sidecars[ending].digest for ending in sidecar_endings(arrays)]
        return hashlib.sha256("\n".join(digests).encode()).hexdigest()[:32] if digests else ""

    def digest_under(self, scene: str) -> str:
        """Return the digest that names this snapshot in samples of a spec.

        Args:
            scene: of the spec; with "off" the statistics do not count.

        Raises:
            UsageError: "auto", and the catalogue was opened without ``scene``.
        """
        if scene == "off":
            return self.digest
        if self.scene_digest is None:
            raise UsageError(
                f'scene = "{scene}" needs statistics of the videos, which this catalogue was opened without: start the '
                "server with --scene auto"
            )
        return self.scene_digest
