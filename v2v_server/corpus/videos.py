"""The videos of a snapshot, in columns; an entry is made when it is looked at."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import overload

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import UsageError
from v2v_server.corpus.index.columns import CHUNK, Records
from v2v_server.corpus.index.runs import CutVideos, Runs
from v2v_server.video.rows import Rows

Thresholds = tuple[float | None, float | None]
NO_THRESHOLDS: Thresholds = (None, None)


@dataclass(frozen=True, slots=True)
class VideoEntry:
    """A video that can be used.

    Attributes:
        id: relative POSIX path; its name for ever.
        fingerprint: see :mod:`v2v_server.video.fingerprint`.
        frames: how many frames there are to decode.
        width_px, height_px: size of the upright picture, before ``rows``.
        frames_per_second: average rate; NaN where unknown.
        codec: FFmpeg's name of the format.
        threshold_pos, threshold_neg: contrast thresholds that the list file states, log units; None without.
        runs: (first frame, frame after the last) of each stretch without a cut and with something to see; None where
            the catalogue was opened without ``scene``.
    """

    id: str
    fingerprint: str
    frames: int
    width_px: int
    height_px: int
    frames_per_second: float
    codec: str
    threshold_pos: float | None = None
    threshold_neg: float | None = None
    runs: Runs | None = None


class Videos(Sequence[VideoEntry]):
    """The usable ones among records, by id.

    Args:
        records: sorted by id.
        places: [V] of the usable ones, rising.
        thresholds: (positive, negative) of those that have some, by number of the video.
        cut: the videos whose one run is not the whole of them; None where runs are not known.

    Attributes:
        frames, width_px, height_px: [V] of each.
        interlaced: [V], 1 where it is.
        cut: as given.
    """

    def __init__(
        self,
        records: Records,
        places: npt.NDArray[np.intp],
        thresholds: Mapping[int, Thresholds],
        cut: CutVideos | None = None,
    ) -> None:
        self._records, self._thresholds, self.cut = records, thresholds, cut
        self._places = None if len(places) == len(records) else places
        usable = slice(None) if self._places is None else self._places
        self.frames, self.interlaced = records.frames[usable], records.interlaced[usable]
        self.width_px, self.height_px = records.width_px[usable], records.height_px[usable]
        self._frames_per_second = records.frames_per_second[usable]

    def find(self, id: str) -> int | None:
        """The number of the video of that id; None if there is none."""
        place = self._records.ids.find(id)
        if place is None or self._places is None:
            return place
        number = int(self._places.searchsorted(place))
        return number if number < len(self._places) and self._places[number] == place else None

    def fingerprint(self, number: int) -> str:
        """Of that video."""
        return self._records.fingerprints[self._place(number)]

    def digest(self, rows: Rows) -> str:
        """32 hexadecimal digits that name these videos with these rows.

        Fingerprints cover the track and its orientation.
        """
        sha = hashlib.sha256(f"v2v catalogue 2\n{rows}\n".encode())
        for start in range(0, len(self), CHUNK):
            numbers = range(start, min(start + CHUNK, len(self)))
            first, last = self._place(numbers[0]), self._place(numbers[-1])
            texts = [texts.part(first, last + 1) for texts in (self._records.ids, self._records.fingerprints)]
            if self._places is not None:
                those = (self._places[start : numbers.stop] - first).tolist()
                texts = [[part[at] for at in those] for part in texts]
            columns = (self.frames, self.width_px, self.height_px, self._frames_per_second)
            values = [column[start : numbers.stop].tolist() for column in columns]
            lines = []
            for number, id, mark, frames, width, height, rate in zip(numbers, *texts, *values, strict=True):
                pos, neg = self._thresholds.get(number, NO_THRESHOLDS)
                lines.append(f"{id}\0{mark}\0{frames}\0{width}\0{height}\0{rate}\0{pos}\0{neg}\n")
            sha.update("".join(lines).encode())
        return sha.hexdigest()[:32]

    def _place(self, number: int) -> int:
        return number if self._places is None else int(self._places[number])

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
        number = at + len(self) if at < 0 else at
        if not 0 <= number < len(self):
            raise IndexError(f"video {at} of {len(self)}")
        record = self._records[self._place(number)]
        pos, neg = self._thresholds.get(number, NO_THRESHOLDS)
        runs = None if self.cut is None else self.cut.runs(number)
        if runs is None and self.cut is not None:
            runs = ((0, record.frames),)
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
            runs=runs,
        )


@dataclass(frozen=True, slots=True)
class CorpusFacts:
    """What is known of a corpus in memory: no part of it reads the index on disk.

    Attributes:
        videos: the videos that can be used, by id.
        rows: the usable rows of each picture.
        digest: names this snapshot.
        scene_digest: names this snapshot together with the statistics of its videos; None without them.
    """

    videos: Sequence[VideoEntry]
    rows: Rows
    digest: str
    scene_digest: str | None

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
