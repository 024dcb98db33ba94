"""What frames are read from.

Each kind is a file here: its name in :data:`KINDS`, and there ``open_pixels(path)``, which returns None for another
kind.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Protocol

from v2v_server.video.collect import ClipRequest, Cut, DecodedPicture
from v2v_server.video.decode import DecodedClip
from v2v_server.video.frame_index import FrameIndex
from v2v_server.video.luma import MOST_BITS, Signal
from v2v_server.video.probe import VideoFacts

KINDS = ("reader", "video_file")
"""Files of the kinds, in the order in which they are asked. The last one takes any file."""


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
    cut = Cut(1, (0, 0, 1, 1))
    return pixels.clips(ClipRequest(index, index.first, (cut,), most_bits=MOST_BITS, samples=((0, 0, 0),)))[0].signal


@contextmanager
def open_pixels(path: Path) -> Iterator[Pixels]:
    """Lend the pixels of a file of this host until the end of the context. Errors: :class:`Pixels`."""
    for kind in KINDS:
        found = import_module(f"{__package__}.{kind}").open_pixels(path)
        if found is not None:
            break
    with found as pixels:
        yield pixels
