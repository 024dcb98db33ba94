"""What frames are read from.

Each form of a video is a file here, with ``open_pixels(path)``, which returns None for another form. A kind of video
(:mod:`v2v_server.kinds`) names those that read it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:  # a command line, which names the kinds, starts without the decoder
    from v2v_server.video.decode import ClipRequest, DecodedClip, DecodedPicture
    from v2v_server.video.frame_index import FrameIndex
    from v2v_server.video.picture import Signal
    from v2v_server.video.probe import VideoFacts

IMAGE_SUFFIXES = frozenset({".bmp", ".jpeg", ".jpg", ".png", ".tif", ".tiff", ".webp"})


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


@contextmanager
def open_pixels(path: Path, forms: Sequence[str]) -> Iterator[Pixels]:
    """Lend the pixels of a file or folder of this host until the end of the context. Errors: :class:`Pixels`.

    Args:
        forms: files of this folder, in the order in which they are asked. The last one takes any path.
    """
    for form in forms:
        found = import_module(f"{__package__}.{form}").open_pixels(path)
        if found is not None:
            break
    with found as pixels:
        yield pixels
