"""The manifest of a prepared folder: what was made of which source video, and how.

The file has one JSON object per line. The first line describes the folder; every other line describes one video, failed
ones included. Lines are only appended. An unfinished last line, which a killed process leaves, is ignored. Of two lines
with the same id the later one counts.

The folder serves the corpus of the latest run that wrote a first line. Videos of earlier runs that this corpus lacks
(a list left them out, or their folder could not be read) are set aside: they are not served, but their lines stay, so
that a later run can use them without preparing them again.
"""

from __future__ import annotations

import json
import os
import sys
from base64 import b64decode
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from types import TracebackType
from typing import Annotated, Any, TypeAlias

from v2v_protocol.errors import CorpusError, ProtocolError, UsageError
from v2v_protocol.persisted import Limits, Persisted, later, parse_json
from v2v_protocol.programs import printable
from v2v_protocol.write_aside import write_aside_and_rename
from v2v_server.corpus.index.file import IndexRow
from v2v_server.corpus.scenes.scene import Scene
from v2v_server.corpus.sources.names import UNPRINTABLE
from v2v_server.store.packing import SIZES
from v2v_server.store.reader import STORE_FORMAT
from v2v_server.video.frame_index import LARGEST_FRAMES, LARGEST_SIDE_PX
from v2v_server.video.rows import Rows

MANIFEST_NAME = "v2v-prepared.jsonl"
MANIFEST_VERSION = 2
_OF_LOSSY = frozenset({"codec", "quality", "gop", "psnr_db", "worst_psnr_db"})
"""Fields of releases that could also prepare lossy files."""
NO_LOSSY = "which this release does not serve: re-encode the videos with ffmpeg, and serve them as videos"
_Bytes: TypeAlias = Annotated[int, Limits(0, 2**63 - 1)]
_Side: TypeAlias = Annotated[int, Limits(0, LARGEST_SIDE_PX)]


@dataclass(frozen=True, slots=True)
class Header(Persisted):
    """What holds for the whole folder.

    Attributes:
        rows: rows of the source's pictures that it holds, canonical.
        size: how its files are packed, a key of :data:`v2v_server.store.packing.SIZES`.
        videos: how many videos the source corpus has; the folder is finished when it has a record of each. Those
            that are set aside do not count.
        source: name of the source folder, for people.
        source_digest: digest of the source's catalogue with these rows.
        version: of this format.
    """

    rows: str
    size: str
    videos: Annotated[int, Limits(1, 2**63 - 1)]
    source: str
    source_digest: str
    version: int = MANIFEST_VERSION

    def __post_init__(self) -> None:
        if self.size not in SIZES:
            raise UsageError(f"size {self.size!r:.80}: this program reads {', '.join(SIZES)}")
        Rows.parse(self.rows)

    @property
    def settings(self) -> str:
        """Return what all files of a folder have in common."""
        return f"rows {self.rows}, size {self.size}"


@dataclass(frozen=True, slots=True)
class PreparedVideo(Persisted):
    """What was made of one video.

    Attributes:
        id: of the source, and the path of the prepared file below the folder.
        source_fingerprint, source_bytes: of the source file.
        frames, frames_per_second: of the source (None where unknown), and so of the prepared file.
        height_px, width_px: of the source's picture, of which the file keeps some rows.
        fingerprint, bytes: of the prepared file; "" and 0 with a problem.
        problem: why there is no prepared file; None if there is one.
        remark: of the source, see :class:`v2v_server.video.probe.VideoFacts`.
        scene: statistics of the source's frames, base64 of ``Scene.to_bytes()``; "" where they were not asked for.
    """

    id: str
    source_fingerprint: str
    source_bytes: _Bytes
    frames: Annotated[int, Limits(1, LARGEST_FRAMES)]
    frames_per_second: Annotated[float, Limits(0, sys.float_info.max)] | None
    height_px: _Side
    width_px: _Side
    fingerprint: str = ""
    bytes: _Bytes = 0
    problem: str | None = None
    scene: str = ""
    remark: str = later("")


@dataclass(frozen=True, slots=True)
class Manifest:
    """A manifest as read.

    Attributes:
        root: the prepared folder.
        header: see :class:`Header`.
        videos: by id.
        aside: by id, those of earlier runs that the last one was not asked for; no corpus has them.
    """

    root: Path
    header: Header
    videos: dict[str, PreparedVideo]
    aside: dict[str, PreparedVideo] = field(default_factory=dict)

    def served_rows(self, rows: Rows | None) -> Rows:
        """Return the rows that a corpus of this folder may use.

        A folder that stores all rows may be served with any rows, another one only with its stored rows.

        Args:
            rows: the requested rows.

        Raises:
            CorpusError: the folder is not finished, or lacks requested rows.
        """
        if len(self.videos) != self.header.videos:
            raise CorpusError(
                f"{self.root}: {len(self.videos)} of {self.header.videos} videos are prepared; run v2v-prepare again "
                "to finish (what is done is kept)"
            )
        asked = None if rows is None or str(rows) == "full" else rows
        kept = Rows.parse(self.header.rows)
        if asked is not None and kept == Rows():
            return asked
        if asked is not None and asked != kept:
            raise CorpusError(
                f"{self.root}: rows {rows} asked for, but this prepared folder holds rows {self.header.rows} of its "
                "source only; leave --rows out, or serve the source"
            )
        return kept

    def wanted(self, listed: Iterable[str] | None, refused: dict[str, str]) -> tuple[str, ...]:
        """Return the ids that a corpus of this folder has, without files that the manifest does not know.

        Args:
            listed: the ids that a list file names; None takes all.
            refused: receives, by id, why one cannot be taken in.
        """
        wanted = sorted(self.videos) if listed is None else list(listed)
        for id in wanted:
            if id in self.aside:
                refused[id] = "is prepared, but the last v2v-prepare was not asked for it; run it once for all of them"
            elif id not in self.videos:
                refused[id] = "is not in the prepared folder's manifest: the source had no such usable video"
        return tuple(id for id in wanted if id not in refused)

    def describes(self, record: IndexRow) -> bool:
        """Return whether the probed file is the prepared one.

        It may be damaged since: it says itself what it was made of, and each of its blocks is checked when it is read.
        The source itself will do in its place.
        """
        video = self.videos[record.id]
        is_either = record.codec == STORE_FORMAT or record.fingerprint == video.source_fingerprint
        return record.problem is None and record.frames == video.frames and is_either

    def as_source(self, record: IndexRow) -> IndexRow:
        """Return the record of a prepared file with the facts that have to agree with its source.

        This includes videos without a usable file: the sequences of the others keep their places only if the source's
        frames are counted.
        """
        video = self.videos[record.id]
        return replace(
            record,
            fingerprint=video.source_fingerprint,
            frames=video.frames,
            height_px=video.height_px,
            width_px=video.width_px,
            frames_per_second=video.frames_per_second,
            remark=video.remark,
            problem=None,
        )


def read_manifest(root: Path) -> Manifest:
    """Read the manifest in a folder.

    Raises:
        CorpusError: it cannot be read, or is no manifest of this version.
    """
    path = root / MANIFEST_NAME
    try:
        lines = path.read_bytes().split(b"\n")
    except OSError as error:
        raise CorpusError(f"{path}: cannot be read: {error.strerror or error}") from error
    lines.pop()  # empty behind the last line's end; else the beginning of a line whose writer was killed
    if not lines:
        raise CorpusError(f"{path}: holds no whole line; prepare another folder")
    videos: dict[str, PreparedVideo] = {}
    aside: dict[str, PreparedVideo] = {}
    for number, line in enumerate(lines, 1):
        try:
            if number == 1:
                header = _header(line)
            else:
                video, is_aside = _video(line)
                for records in (videos, aside):
                    records.pop(video.id, None)
                (aside if is_aside else videos)[video.id] = video
        except (ValueError, ProtocolError, UsageError) as error:
            remedy = "" if NO_LOSSY in str(error) else "; prepare another folder"
            raise CorpusError(f"{path}, line {number}: {error}{remedy}") from error
    return Manifest(root, header, videos, aside)


def _header(line: bytes) -> Header:
    data = _object(line)
    if data.get("version") != MANIFEST_VERSION:
        raise ValueError(f"format version {data.get('version')!r}; this program reads {MANIFEST_VERSION}")
    if (codec := data.get("codec", "lossless")) != "lossless":
        raise ValueError(f"the folder was prepared with --codec {codec!r:.80}, {NO_LOSSY}")
    return Header.from_dict(_without_lossy(data))


def _video(line: bytes) -> tuple[PreparedVideo, bool]:
    """Read the line of a video: return its record, and whether the video is set aside."""
    data = _object(line)
    aside = data.pop("aside", False) is True
    video = PreparedVideo.from_dict(_without_lossy(data))
    path = PurePosixPath(video.id)
    if printable(video.id) != video.id:
        raise ValueError(f"id {printable(video.id)}: {UNPRINTABLE}")
    if path.is_absolute() or ".." in path.parts:
        raise ValueError(f"id {video.id!r} leads out of the folder")
    if video.scene:
        scene = b64decode(video.scene, validate=True)
        if not Scene.is_encoding(scene):  # of another release: it counts as not asked for
            return replace(video, scene=""), aside
        Scene.from_bytes(scene)
    return video, aside


def _object(line: bytes) -> dict[str, Any]:
    data = parse_json(line)
    if not isinstance(data, dict):
        raise ValueError("is not a JSON object")
    return data


def _without_lossy(data: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in data.items() if name not in _OF_LOSSY}


class ManifestWriter:
    """Writes a manifest: first afresh and in one piece, then line by line.

    Args:
        root: the prepared folder.
        header: its first line.
        videos: what is known already.
        aside: what is known of videos that the corpus does not have.

    Raises:
        OSError: the folder cannot be written to.
    """

    def __init__(
        self, root: Path, header: Header, videos: Iterable[PreparedVideo], aside: Iterable[PreparedVideo] = ()
    ) -> None:
        path = root / MANIFEST_NAME
        aside_path = path.with_name(f".{MANIFEST_NAME}.new")  # one name, so that killed runs leave one file at most
        with write_aside_and_rename(path, partial=aside_path, durable=True) as fresh, fresh.open("wb") as file:
            file.write(_line(header))
            file.writelines(map(_line, videos))
            file.writelines(_line(video, aside=True) for video in aside)
        self._file = path.open("ab")

    def add(self, video: PreparedVideo) -> None:
        """Append one record, and make sure that it stays."""
        self._file.write(_line(video))
        self._file.flush()
        os.fsync(self._file.fileno())

    def __enter__(self) -> ManifestWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()


def _line(item: Header | PreparedVideo, aside: bool = False) -> bytes:
    values = item.to_dict() | ({"aside": True} if aside else {})
    return json.dumps(values, allow_nan=False).encode() + b"\n"
