"""A prepared folder: the files that v2v-prepare made, under the ids of their sources, and the manifest that lists them.

The manifest has one JSON object per line. The first line describes the folder; every other line describes one video,
failed ones included. Lines are only appended. An unfinished last line, which a killed process leaves, is ignored. Of
two lines with the same id the later one counts.

The folder serves the corpus of the latest run that wrote a first line. Files of videos of earlier runs that this corpus
lacks (a list left them out, or their folder could not be read) are not served; a later run can use them.
"""

from __future__ import annotations

import json
import os
import sys
from base64 import b64decode
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, TypeAlias

from v2v_protocol.errors import CorpusError, ProtocolError, UsageError, system_errors
from v2v_protocol.persisted import Limits, Persisted, later, parse_json
from v2v_protocol.programs import printable
from v2v_protocol.write_aside import write_aside_and_rename
from v2v_server.corpus.scenes.scene import Scene
from v2v_server.corpus.sources.folder import Folder, locate
from v2v_server.corpus.sources.source import MANIFEST_NAME, UNPRINTABLE, SourceOptions, VideoSource
from v2v_server.store.format import SIZES
from v2v_server.video.frame_index import LARGEST_FRAMES, LARGEST_INDEXED_SIDE_PX
from v2v_server.video.rows import Rows

MANIFEST_VERSION = 2
ABSENT = "no prepared file"
"""Codec of a video that has none."""
_OF_EARLIER = frozenset({"codec", "quality", "gop", "psnr_db", "worst_psnr_db", "fingerprint"})
"""Fields of earlier releases, whose files say the same themselves, or could be lossy."""
NO_LOSSY = "which this release does not serve: re-encode the videos with ffmpeg, and serve them as videos"
_Bytes: TypeAlias = Annotated[int, Limits(0, 2**63 - 1)]
_Side: TypeAlias = Annotated[int, Limits(0, LARGEST_INDEXED_SIDE_PX)]


@dataclass(frozen=True, slots=True)
class Header(Persisted):
    """What holds for the whole folder.

    Attributes:
        rows: rows of the source's pictures that it holds, canonical.
        size: how its files are packed, a key of :data:`v2v_server.store.format.SIZES`.
        videos: how many videos the source corpus has; the folder is finished when it has a record of each.
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
        id: of the source; :func:`prepared_name` gives the path of the prepared file.
        source_fingerprint, source_bytes: of the source file.
        frames, frames_per_second: of the source (None where unknown), and so of the prepared file.
        height_px, width_px: of the source's picture, of which the file keeps some rows.
        bytes: size of the prepared file; 0 with a problem.
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
    bytes: _Bytes = 0
    problem: str | None = None
    scene: str = ""
    remark: str = later("")


def prepared_name(id: str) -> str:
    """Return the path of a prepared file below its folder."""
    return f"{id[:-1]}.v2v" if id.endswith("/") else id


@dataclass(frozen=True, slots=True)
class Manifest:
    """A manifest as read.

    Attributes:
        header: see :class:`Header`.
        videos: by id.
    """

    header: Header
    videos: dict[str, PreparedVideo]


def read_manifest(root: Path) -> Manifest:
    """Read the manifest in a folder.

    Raises:
        CorpusError: it cannot be read, or is no manifest of this version.
    """
    path = root / MANIFEST_NAME
    with system_errors(CorpusError, f"{path}: cannot be read"):
        lines = path.read_bytes().split(b"\n")
    lines.pop()  # empty behind the last line's end; else the beginning of a line whose writer was killed
    if not lines:
        raise CorpusError(f"{path}: holds no whole line; prepare another folder")
    videos: dict[str, PreparedVideo] = {}
    for number, line in enumerate(lines, 1):
        try:
            data = parse_json(line)
            if not isinstance(data, dict):
                raise ValueError("is not a JSON object")
            if number == 1:
                header = _header(data)
            elif (video := _video(data)) is not None:
                videos[video.id] = video
        except (ValueError, ProtocolError, UsageError) as error:
            remedy = "" if NO_LOSSY in str(error) else "; prepare another folder"
            raise CorpusError(f"{path}, line {number}: {error}{remedy}") from error
    return Manifest(header, videos)


def _header(data: dict[str, Any]) -> Header:
    if data.get("version") != MANIFEST_VERSION:
        raise ValueError(f"format version {data.get('version')!r}; this program reads {MANIFEST_VERSION}")
    if (codec := data.get("codec", "lossless")) != "lossless":
        raise ValueError(f"the folder was prepared with --codec {codec!r:.80}, {NO_LOSSY}")
    return Header.from_dict(_known(data))


def _video(data: dict[str, Any]) -> PreparedVideo | None:
    """Return the record of a video; None if an earlier release set the video aside."""
    if data.pop("aside", False) is True:
        return None
    video = PreparedVideo.from_dict(_known(data))
    path = PurePosixPath(video.id)
    if printable(video.id) != video.id:
        raise ValueError(f"id {printable(video.id)}: {UNPRINTABLE}")
    if path.is_absolute() or ".." in path.parts:
        raise ValueError(f"id {video.id!r} leads out of the folder")
    if video.scene:
        scene = b64decode(video.scene, validate=True)
        if not Scene.is_encoding(scene):  # of another release: it counts as not asked for
            return replace(video, scene="")
        Scene.from_bytes(scene)
    return video


def _known(data: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in data.items() if name not in _OF_EARLIER}


@contextmanager
def write_manifest(
    root: Path, header: Header, videos: Iterable[PreparedVideo]
) -> Iterator[Callable[[PreparedVideo], None]]:
    """Write a manifest: the known records in one go; yield what appends one more, and waits until it is on disk.

    Args:
        root: the prepared folder.
        header: its first line.
        videos: what is known already.

    Raises:
        OSError: the folder cannot be written to.
    """
    path = root / MANIFEST_NAME
    aside = path.with_name(f".{MANIFEST_NAME}.new")  # one name, so that killed runs leave one file at most
    with write_aside_and_rename(path, partial=aside, durable=True) as fresh, fresh.open("wb") as file:
        file.write(_line(header))
        file.writelines(map(_line, videos))
    with path.open("ab") as file:

        def add(video: PreparedVideo) -> None:
            file.write(_line(video))
            file.flush()
            os.fsync(file.fileno())

        yield add


def _line(item: Header | PreparedVideo) -> bytes:
    values = item.to_dict()
    return json.dumps(values, allow_nan=False).encode() + b"\n"


class Prepared(Folder):
    """A folder with a manifest, which says what its files are."""

    @cached_property
    def manifest(self) -> Manifest:
        """Return the manifest; only the process that lists the videos reads it.

        Raises:
            CorpusError: it cannot be read, or makes no sense.
        """
        return read_manifest(self.folder)

    def videos(self, refused: dict[str, str], left_out: Counter[str]) -> Iterator[str]:
        """List the videos of the manifest; other files are passed over."""
        known = self.manifest.videos
        for id in sorted(known) if (listed := self.listed()) is None else [entry.id for entry in listed]:
            if id in known:
                yield id
            else:
                refused[id] = (
                    "is not in the prepared folder's manifest: the source had no such usable video, or the last "
                    "v2v-prepare was not asked for it; run it once for all of them"
                )

    def path_of(self, id: str) -> str:
        """Return the path of the prepared file."""
        return f"{self.name}/{prepared_name(id)}"


def manifest_of(source: VideoSource) -> Manifest | None:
    """Return the manifest of a prepared folder; None for any other source. Raises: see :attr:`Prepared.manifest`."""
    return source.manifest if isinstance(source, Prepared) else None


def rows_of(source: VideoSource, asked: Rows | None) -> Rows:
    """Return which rows of the pictures may be used.

    A prepared folder that stores all rows may be served with any rows, another one only with its stored rows.

    Args:
        source: where the videos come from.
        asked: rows that the user asks for; None: all that there are.

    Raises:
        CorpusError: the folder is not finished, or lacks requested rows.
    """
    if (manifest := manifest_of(source)) is None:
        return asked or Rows()
    header, done = manifest.header, len(manifest.videos)
    if done != header.videos:
        raise CorpusError(
            f"{source}: {done} of {header.videos} videos are prepared; run v2v-prepare again to finish (what is done "
            "is kept)"
        )
    kept = Rows.parse(header.rows)
    if asked is None or asked == Rows():
        return kept
    if kept not in (Rows(), asked):
        raise CorpusError(
            f"{source}: rows {asked} asked for, but this prepared folder holds rows {header.rows} of its source "
            "only; leave --rows out, or serve the source"
        )
    return asked


def open_source(name: str, options: SourceOptions) -> Prepared | None:
    """Open a prepared folder; None for any other.

    Raises:
        CorpusError: the folder is a part of a prepared one.
        OSError: this user may not look at it.
    """
    root, listed = locate(name, options)
    for folder in root.parents:
        if (folder / MANIFEST_NAME).exists():
            raise CorpusError(
                f"{root} lies in the prepared folder {folder}, where its manifest is: name that folder, and restrict "
                "it by a list file"
            )
    return Prepared(root, listed) if (root / MANIFEST_NAME).exists() else None
