"""A file that is decoded: ``--videos-kind videos``."""

from __future__ import annotations

from dataclasses import dataclass

from v2v_server.kinds.kind import VideosKind

VIDEO_SUFFIXES = (
    ".3gp", ".avi", ".flv", ".h264", ".h265", ".hevc", ".ivf", ".m2ts", ".m4v", ".mjpeg", ".mjpg", ".mkv", ".mov",
    ".mp4", ".mpeg", ".mpg", ".mts", ".mxf", ".obu", ".ogv", ".ts", ".vob", ".webm", ".wmv", ".y4m",
)  # fmt: skip


@dataclass(frozen=True)
class VideoKind(VideosKind):
    """A video in a file."""

    name = "videos"
    help = "a file"
    forms = "store_file", "video_file"
    endings = VIDEO_SUFFIXES
    archive_endings = ".tar", ".zip"
    looked_for = (
        f"{' '.join(VIDEO_SUFFIXES)}, also in .tar and .zip archives; with --videos-kind sequences, folders of "
        "numbered pictures are videos, and with --videos-kind photographs, each picture is a scene that moves"
    )
    seeks_by_time = True

    @property
    def in_digest(self) -> str:
        """Return nothing: catalogues named no kind before there was another one."""
        return ""


KIND = VideoKind()
