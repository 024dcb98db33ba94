"""Pictures stored as tiles: columns of a prepared picture, side by side, each in a track of its own.

A crop of 128 columns out of 596 then costs the decoder the tiles that it touches instead of the whole picture, and a
tile refers to nothing outside itself. A file says that its tracks are tiles in its metadata; its index says how wide
they are.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from av.container import InputContainer

from v2v_protocol.errors import VideoError
from v2v_server.video.index import MOST_TILES
from v2v_server.video.orientation import Window
from v2v_server.video.source import picture_tracks

MARK = ("comment", "v2v-prepare: the tracks are columns of one picture, from left to right")
"""Key and value in the metadata of the file."""

NARROWEST_PX = 64
_BLOCK_PX = 16  # codecs work in blocks of so many columns: a tile that ends within one pays for the whole


@dataclass(frozen=True, slots=True)
class Part:
    """What a window takes of one tile.

    Attributes:
        track: number of the tile, from the left.
        window: in the tile's own picture.
        left: first column of the asked window that it fills.
    """

    track: int
    window: Window
    left: int


def split(width_px: int, tile_px: int) -> tuple[int, ...]:
    """The widths of the tiles of a picture, from left to right: as near ``tile_px`` as whole blocks allow.

    Empty where the picture is not worth cutting (narrower than one and a half tiles), or ``tile_px`` is 0.
    """
    count = min(round(width_px / tile_px), MOST_TILES) if tile_px else 0
    if count < 2:
        return ()
    edges = [_BLOCK_PX * round(width_px * number / count / _BLOCK_PX) for number in range(count)] + [width_px]
    return tuple(right - left for left, right in itertools.pairwise(edges))


def parts(window: Window, widths: Sequence[int]) -> list[Part]:
    """The parts that make up a window of the whole picture, from left to right."""
    top, left, height, width = window
    found, begin = [], 0
    for track, size in enumerate(widths):
        first, last = max(left, begin), min(left + width, begin + size)
        if first < last:
            found.append(Part(track, (top, first - begin, height, last - first), first - left))
        begin += size
    return found


def columns(picture: npt.NDArray[np.uint8], widths: Sequence[int]) -> list[npt.NDArray[np.uint8]]:
    """A picture [h, w] as its tiles [h, width]; itself alone where there are no widths."""
    return np.split(picture, np.cumsum(widths)[:-1].tolist(), axis=1) if widths else [picture]


def widths_of(path: str | os.PathLike[str], container: InputContainer) -> tuple[int, ...]:
    """The widths of the tiles of an open file; empty for a file that holds pictures as usual.

    Raises:
        VideoError: the file calls its tracks tiles, and they do not fit together.
    """
    key, value = MARK
    if container.metadata.get(key) != value:
        return ()
    forms = [
        (track.codec_context.name, track.codec_context.height, track.codec_context.width)
        if track.codec_context
        else ("unknown", 0, 0)
        for track in picture_tracks(container)
    ]
    widths = tuple(width for _, _, width in forms)
    if not 2 <= len(forms) <= MOST_TILES or len({form[:2] for form in forms}) != 1 or not all(widths):
        tracks = ", ".join(f"{codec} of {width}x{height} px" for codec, height, width in forms)
        raise VideoError(os.fspath(path), None, f"calls its tracks tiles of one picture, but they are {tracks}")
    return widths
