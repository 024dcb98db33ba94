"""What frames are read from.

Each form of a video is a file here: its name in :data:`KINDS`, and there ``open_pixels(path)``, which returns None for
another form.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from v2v_protocol.command import flag_of
from v2v_protocol.errors import UsageError
from v2v_protocol.settings import check_settings, number, settings_of, word

if TYPE_CHECKING:  # a server's command line, which reads the settings, starts without the decoder
    from v2v_server.video.collect import ClipRequest, DecodedPicture
    from v2v_server.video.decode import DecodedClip
    from v2v_server.video.frame_index import FrameIndex
    from v2v_server.video.luma import Signal
    from v2v_server.video.probe import VideoFacts

KINDS: Mapping[str, tuple[str, ...]] = {
    "videos": ("reader", "video_file"),
    "sequences": ("reader", "picture_sequence"),
}
"""What a video of a corpus is, by ``--videos-kind``: the files here, in the order in which they are asked. The last one
takes any path. It has ``id_of(path)``, the id of the video that a file belongs to, and ``LOOKED_FOR``, for people."""


@dataclass(frozen=True, slots=True)
class VideosKind:
    """What a video of a corpus is, and the settings of that kind.

    Raises:
        UsageError: there is no such kind, or a setting is malformed or belongs to another kind.
    """

    videos_kind: str = word(
        "videos",
        KINDS,
        "what a video is: videos is a file; sequences is a folder, or a zip archive, of numbered pictures",
        group="Videos",
    )
    rate: float = number(
        0.0, 0.001, 1e6, "rate of picture sequences without time stamps; 0: unknown", unit="Hz", metavar="N", off=True
    )

    def __post_init__(self) -> None:
        check_settings(self, flag_of)
        if self.rate and not self.has_parts:
            raise UsageError(f"--rate {self.rate:g}: {self.videos_kind} state their rate; it is for picture sequences")

    @classmethod
    def of(cls, given: Mapping[str, Any]) -> VideosKind:
        """Return the kind of a command's flags; a flag that is missing or None has its default."""
        return cls(**{name: given[name] for name in settings_of(VideosKind) if given.get(name) is not None})

    @property
    def has_parts(self) -> bool:
        """Return whether a video is a folder or an archive of files."""
        return self.videos_kind == "sequences"

    @property
    def form(self) -> Any:
        """Return the file that defines the kind, the last of its :data:`KINDS`."""
        return import_module(f"{__package__}.{KINDS[self.videos_kind][-1]}")


VIDEOS = VideosKind()


class Pixels(Protocol):
    """The frames of one video.

    All methods fail alike: VideoUnreadable, with VideoGone and VideoDenied, if the system reports an error, which may
    pass; VideoChanged if it is another video by now; any other VideoError if its content is damaged or not supported,
    with the ordinal of the first frame that cannot be delivered as its ``frame``; UsageError if a request lies outside
    of its index or picture. A frame is delivered exactly, or not at all.

    Attributes:
        is_stored: whether its frames are decoded already, so that a cache gains nothing.
    """

    is_stored: bool

    def facts(self) -> VideoFacts:
        """Return what the catalogue needs to know. May read all of the video."""

    def check(self, fingerprint: str) -> None:
        """Check cheaply that this is the catalogued video, or was made from it."""

    def clips(self, request: ClipRequest) -> tuple[DecodedClip, ...]:
        """Return the cuts of a request, in order, with all that they ask for."""

    def pictures(self, request: ClipRequest) -> Iterator[DecodedPicture]:
        """Yield the pictures of the only cut of a request, in the memory of a few."""

    def signal(self, index: FrameIndex) -> Signal:
        """Return what the levels mean, by the first frame."""


def kind_of(id: str) -> str:
    """Return what a catalogued video is, one of :data:`KINDS`."""
    return "sequences" if id.lower().endswith(("/", ".zip")) else "videos"


@contextmanager
def open_pixels(path: Path, kind: str = "videos") -> Iterator[Pixels]:
    """Lend the pixels of a file or folder of this host until the end of the context. Errors: :class:`Pixels`."""
    for form in KINDS[kind]:
        found = import_module(f"{__package__}.{form}").open_pixels(path)
        if found is not None:
            break
    with found as pixels:
        yield pixels
