"""A video in a file, decoded by FFmpeg."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace

from v2v_server.store.planes.motion import by_cut, watch_motion
from v2v_server.video.decode import ClipRequest, DecodedClip, DecodedPicture, Way, decode_cuts, stream_pictures
from v2v_server.video.fingerprint import check_fingerprint
from v2v_server.video.probe import VideoFacts, probe


class VideoFile:
    """:class:`v2v_server.store.pixels.Pixels` of a file, which is opened by each call."""

    is_stored = False
    ways: Sequence[Way] = ()

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self._path = path

    def facts(self) -> VideoFacts:
        """Probe the file, see :func:`v2v_server.video.probe.probe`."""
        return probe(self._path)

    def check(self, fingerprint: str) -> None:
        """Compare size, head and tail."""
        check_fingerprint(self._path, fingerprint)

    def clips(self, request: ClipRequest) -> tuple[DecodedClip, ...]:
        """Decode, see :func:`v2v_server.video.decode.decode_cuts`."""
        if all(cut.cells is None for cut in request.cuts):
            return decode_cuts(self._path, request, ways=self.ways)
        watch, found = watch_motion(request)
        clips = decode_cuts(self._path, request, watch, self.ways)
        motion = by_cut(request, found[-1])
        return tuple(replace(clip, motion=of_cut) for clip, of_cut in zip(clips, motion, strict=True))

    def pictures(self, request: ClipRequest) -> Iterator[DecodedPicture]:
        """Decode one by one, see :func:`v2v_server.video.decode.stream_pictures`."""
        return stream_pictures(self._path, request, self.ways)


def open_pixels(path: str | os.PathLike[str]) -> AbstractContextManager[VideoFile]:
    """Return the video file."""
    return nullcontext(VideoFile(path))
