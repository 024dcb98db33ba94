"""What frames are read from.

Each form of a video is a file here: its name in :data:`PIXEL_KINDS`, and there ``open_pixels(path)``, which returns
None for another form.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from v2v_protocol.errors import UsageError
from v2v_protocol.persisted import Persisted

if TYPE_CHECKING:  # a server's command line, which names the kinds, starts without the decoder
    from v2v_server.video.decode import ClipRequest, DecodedClip, DecodedPicture
    from v2v_server.video.frame_index import FrameIndex
    from v2v_server.video.picture import Signal
    from v2v_server.video.probe import VideoFacts

PIXEL_KINDS: Mapping[str, tuple[str, ...]] = {
    "videos": ("store_file", "video_file"),
    "sequences": ("store_file", "picture_sequence"),
    "photographs": ("photograph",),
}
"""What a video of a corpus is, by ``--videos-kind``: the files here, in the order in which they are asked. The last one
takes any path. It has ``id_of(path)``, the id of the video that a file belongs to, and ``LOOKED_FOR``, for people."""

IMAGE_SUFFIXES = frozenset({".bmp", ".jpeg", ".jpg", ".png", ".tif", ".tiff", ".webp"})
HIGHEST_RATE_HZ = 1e6
LONGEST_PHOTOGRAPH_FRAMES = 2**17


@dataclass(frozen=True, slots=True)
class VideosKind(Persisted):
    """What a video of a corpus is.

    Attributes:
        videos_kind: one of :data:`PIXEL_KINDS`.
        rate: of picture sequences without time stamps, Hz, 0: unknown; of photographs, 0: 60.
        photograph_seconds: for which a photograph is shown, 0: 10.
        picture_bits: that levels of 16-bit pictures in sequences hold, 8 to 15; 0: all 16.

    Raises:
        UsageError: there is no such kind, or it has no such rate or duration.
    """

    videos_kind: str = "videos"
    rate: float = 0.0
    photograph_seconds: float = 0.0
    picture_bits: int = 0

    def __post_init__(self) -> None:
        highest_hz = 0.0 if self.videos_kind == "videos" else HIGHEST_RATE_HZ
        longest = math.inf if self.is_rendered else 0.0
        is_within = 0 <= self.rate <= highest_hz and 0 <= self.photograph_seconds <= longest
        is_within = is_within and (not self.picture_bits or (self.has_parts and 8 <= self.picture_bits <= 15))
        if self.videos_kind not in PIXEL_KINDS or not is_within:
            what = f"--videos-kind {self.videos_kind}, --rate {self.rate:g}"
            what += f", --photograph-seconds {self.photograph_seconds:g}" * (self.photograph_seconds != 0)
            what += f", --picture-bits {self.picture_bits}" * (self.picture_bits != 0)
            raise UsageError(
                f"{what}: choose one of {', '.join(PIXEL_KINDS)}; sequences can have a rate up to "
                f"{HIGHEST_RATE_HZ:g} Hz and 8 to 15 picture bits, and photographs a rate and a duration"
            )
        if self.is_rendered and not 2 <= self.frames <= LONGEST_PHOTOGRAPH_FRAMES:
            raise UsageError(
                f"--photograph-seconds {self.photograph_seconds or 10:g} at --rate {self.rendered_hz:g} gives "
                f"{self.frames} frames: give 2 to {LONGEST_PHOTOGRAPH_FRAMES}"
            )

    @classmethod
    def of(cls, given: Mapping[str, Any]) -> VideosKind:
        """Return the kind of a command's flags; None stands for a default."""
        names = "photograph_seconds", "picture_bits"
        return cls(given["videos_kind"] or "videos", given["rate"] or 0.0, *(given.get(name) or 0 for name in names))

    @property
    def has_parts(self) -> bool:
        """Return whether a video is a folder or an archive of files."""
        return self.videos_kind == "sequences"

    @property
    def is_rendered(self) -> bool:
        """Return whether frames are rendered for each sample, so that a video is no more than a picture."""
        return self.videos_kind == "photographs"

    @property
    def rendered_hz(self) -> float:
        """Return the rate of photographs."""
        return self.rate or 60.0

    @property
    def frames(self) -> int:
        """Return the number of frames of a photograph, those at the beginning and the end included."""
        return 1 + math.floor(min((self.photograph_seconds or 10.0) * self.rendered_hz, 1e15) + 0.5)

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
        is_stored: whether a cache gains nothing: its frames are decoded already, or differ from sample to sample.
    """

    is_stored: bool

    def facts(self) -> VideoFacts:
        """Return what the catalogue needs to know. May read all of the video."""

    def check(self, fingerprint: str) -> object:
        """Check cheaply that this is the catalogued video, or was made from it. What is returned stays equal while the
        file does (:func:`v2v_server.store.verified.read_unchanged`).
        """

    def clips(self, request: ClipRequest) -> tuple[DecodedClip, ...]:
        """Return the cuts of a request, in order, with all that they ask for."""

    def pictures(self, request: ClipRequest) -> Iterator[DecodedPicture]:
        """Yield the pictures of the only cut of a request, in the memory of a few."""


def signal_of(pixels: Pixels, index: FrameIndex) -> Signal:
    """Return what the levels of a video mean, by its first frame, whatever the sample and the bits that are kept."""
    from v2v_server.video.decode import ClipRequest, Cut

    cut = Cut(1, (0, 0, 1, 1))
    (clip,) = pixels.clips(ClipRequest(index, index.first, (cut,), most_bits=16, samples=((0, 0, 0),)))
    return clip.signal._replace(bits=min(clip.signal.bits, index.bits or 16))


def kind_of(id: str) -> str:
    """Return what a catalogued video is, one of :data:`PIXEL_KINDS`."""
    lower = id.lower()
    if lower.endswith(("/", ".zip")):
        return "sequences"
    return "photographs" if lower.endswith(tuple(IMAGE_SUFFIXES)) else "videos"


@contextmanager
def open_pixels(path: Path, kind: str = "videos") -> Iterator[Pixels]:
    """Lend the pixels of a file or folder of this host until the end of the context. Errors: :class:`Pixels`."""
    for form in PIXEL_KINDS[kind]:
        found = import_module(f"{__package__}.{form}").open_pixels(path)
        if found is not None:
            break
    with found as pixels:
        yield pixels
