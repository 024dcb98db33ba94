"""What frames are read from.

Each form of a video is a file here: its name in :data:`PIXEL_KINDS`, and there ``open_pixels(path)``, which returns
None for another form.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from v2v_protocol.errors import UsageError

if TYPE_CHECKING:  # a server's command line, which names the kinds, starts without the decoder
    from v2v_server.video.decode import ClipRequest, DecodedClip, DecodedPicture
    from v2v_server.video.frame_index import FrameIndex
    from v2v_server.video.picture import Signal
    from v2v_server.video.probe import VideoFacts

PIXEL_KINDS: Mapping[str, tuple[str, ...]] = {
    "videos": ("store_file", "video_file"),
    "sequences": ("store_file", "picture_sequence"),
}
"""What a video of a corpus is, by ``--videos-kind``: the files here, in the order in which they are asked. The last one
takes any path. It has ``id_of(path)``, the id of the video that a file belongs to, and ``LOOKED_FOR``, for people."""

HIGHEST_RATE_HZ = 1e6


@dataclass(frozen=True, slots=True)
class VideosKind:
    """What a video of a corpus is.

    Attributes:
        videos_kind: one of :data:`PIXEL_KINDS`.
        rate: of picture sequences without time stamps, Hz; 0: unknown.

    Raises:
        UsageError: there is no such kind, or it has no such rate.
    """

    videos_kind: str = "videos"
    rate: float = 0.0

    def __post_init__(self) -> None:
        if self.videos_kind not in PIXEL_KINDS or not 0 <= self.rate <= (HIGHEST_RATE_HZ if self.has_parts else 0):
            what = f"--videos-kind {self.videos_kind}, --rate {self.rate:g}"
            raise UsageError(
                f"{what}: choose one of {', '.join(PIXEL_KINDS)}; sequences can have a rate up to "
                f"{HIGHEST_RATE_HZ:g} Hz"
            )

    @classmethod
    def of(cls, given: Mapping[str, Any]) -> VideosKind:
        """Return the kind of a command's flags; None stands for a default."""
        return cls(given["videos_kind"] or "videos", given["rate"] or 0.0)

    @property
    def has_parts(self) -> bool:
        """Return whether a video is a folder or an archive of files."""
        return self.videos_kind == "sequences"

    @property
    def form(self) -> Any:
        """Return the file that defines the kind, the last of its :data:`PIXEL_KINDS`."""
        return import_module(f"{__package__}.{PIXEL_KINDS[self.videos_kind][-1]}")


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


def signal_of(pixels: Pixels, index: FrameIndex) -> Signal:
    """Return what the levels of a video mean, by its first frame, whatever the sample."""
    from v2v_server.video.decode import ClipRequest, Cut
    from v2v_server.video.picture import MOST_BITS

    cut = Cut(1, (0, 0, 1, 1))
    return pixels.clips(ClipRequest(index, index.first, (cut,), most_bits=MOST_BITS, samples=((0, 0, 0),)))[0].signal


def kind_of(id: str) -> str:
    """Return what a catalogued video is, one of :data:`PIXEL_KINDS`."""
    return "sequences" if id.lower().endswith(("/", ".zip")) else "videos"


@contextmanager
def open_pixels(path: Path, kind: str = "videos") -> Iterator[Pixels]:
    """Lend the pixels of a file or folder of this host until the end of the context. Errors: :class:`Pixels`."""
    for form in PIXEL_KINDS[kind]:
        found = import_module(f"{__package__}.{form}").open_pixels(path)
        if found is not None:
            break
    with found as pixels:
        yield pixels
