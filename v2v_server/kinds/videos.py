"""A file that is decoded: ``--videos-kind videos``."""

from __future__ import annotations

from dataclasses import dataclass

from v2v_server.kinds.kind import VideosKind

VIDEO_SUFFIXES = frozenset({
    ".3gp", ".avi", ".flv", ".h264", ".h265", ".hevc", ".ivf", ".m2ts", ".m4v", ".mjpeg", ".mjpg", ".mkv", ".mov",
    ".mp4", ".mpeg", ".mpg", ".mts", ".mxf", ".obu", ".ogv", ".ts", ".vob", ".webm", ".wmv", ".y4m",
})  # fmt: skip


@dataclass(frozen=True)
class VideoKind(VideosKind):
    """A video in a file."""

    name = "videos"
    help = "a file"
    forms = "store_file", "video_file"
    looked_for = (
        f"{' '.join(sorted(VIDEO_SUFFIXES))}; with --videos-kind sequences, folders of numbered pictures are videos, "
        "and with --videos-kind photographs, each picture is a scene that moves"
    )
    seeks_by_time = True

    @property
    def in_digest(self) -> str:
        """Return nothing: catalogues named no kind before there was another one."""
        return ""

    def owns(self, id: str) -> bool:
        """Return True, also of a file without a video's ending, which a list may name."""
        return True

    def id_of(self, path: str) -> str:
        """Return the path of a file with a video's ending."""
        _, dot, ending = path.rpartition(".")
        return path if dot and f".{ending.lower()}" in VIDEO_SUFFIXES else ""


KIND = VideoKind()
