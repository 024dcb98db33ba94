"""Pictures stored as tiles: some columns of a prepared picture, in a track of their own.

A crop of 128 columns out of 596 then costs the decoder the tiles that it touches instead of the whole picture: one,
where tiles overlap by as much. A tile refers to nothing outside itself. A file says in its metadata that its tracks are
tiles.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from av.container import InputContainer

from v2v_protocol.errors import VideoError
from v2v_server.video.frame_index import MOST_TILES, Tile, make_up
from v2v_server.video.orientation import Window
from v2v_server.video.source import picture_tracks

KEY, MARK = "comment", "v2v-prepare: each track holds columns of one picture, from"
"""Key in the metadata of the file, and how its value begins; the first columns of the tracks follow."""

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


def split(width_px: int, tile_px: int, overlap_px: int = 0) -> tuple[Tile, ...]:
    """The tiles of a picture, from left to right: as near ``tile_px`` wide as whole blocks allow.

    Each shares ``overlap_px`` columns with the next, so that a window no wider than that lies in one tile. Empty where
    the picture is not worth cutting (narrower than one and a half tiles less half an overlap), or ``tile_px`` is 0.
    """
    rest, step = width_px - overlap_px, tile_px - overlap_px
    count = min(round(rest / step), MOST_TILES) if tile_px else 0
    if count < 2:
        return ()
    lefts = [_BLOCK_PX * round(rest * number / count / _BLOCK_PX) for number in range(count)]
    rights = [*(left + overlap_px for left in lefts[1:]), width_px]
    return tuple(Tile(left, right - left) for left, right in zip(lefts, rights, strict=True))


def parts(window: Window, tiles: Sequence[Tile], core_left_px: int | None = None) -> list[Part]:
    """The parts that make up a window of the whole picture, from left to right: no more than it takes.

    Where tiles overlap, two of them hold a column, each with its own error of the codec.

    Args:
        window: inside the picture.
        tiles: that make up the picture.
        core_left_px: a column of the window; a window that begins there is made of these parts too, whatever lies to
            its left here. None: there is no such window.
    """
    top, left, height, width = window
    found: list[Part] = []
    at, core, end = left, left if core_left_px is None else core_left_px, left + width
    while at < end:
        track = max(number for number, tile in enumerate(tiles) if tile.left_px <= at < tile.right_px)
        last = min(end if at >= core else core, tiles[track].right_px)
        begin = at
        if found and found[-1].track == track:
            begin = found.pop().left + left
        found.append(Part(track, (top, begin - tiles[track].left_px, height, last - begin), begin - left))
        at = last
    return found


def columns(picture: npt.NDArray[np.uint8], tiles: Sequence[Tile]) -> list[npt.NDArray[np.uint8]]:
    """A picture [h, w] as views of its tiles [h, width]; itself alone where there are none."""
    return [picture[:, tile.left_px : tile.right_px] for tile in tiles] or [picture]


def note(tiles: Sequence[Tile]) -> str:
    """What the metadata of a file say under :data:`KEY`."""
    return " ".join([MARK, *(str(tile.left_px) for tile in tiles)])


def tiles_of(path: str | os.PathLike[str], container: InputContainer) -> tuple[Tile, ...]:
    """The tiles of an open file; empty for a file that holds pictures as usual.

    Raises:
        VideoError: the file calls its tracks tiles, and they do not fit together.
    """
    text = container.metadata.get(KEY, "")
    if not text.startswith(MARK):
        return ()
    forms = [
        (track.codec_context.name, track.codec_context.height, track.codec_context.width)
        if track.codec_context
        else ("unknown", 0, 0)
        for track in picture_tracks(container)
    ]
    lefts = [int(word) for word in text[len(MARK) :].split() if re.fullmatch("[0-9]{1,5}", word)]
    tiles = tuple(Tile(left, width) for left, (_, _, width) in zip(lefts, forms, strict=False))
    alike = len({form[:2] for form in forms}) == 1 and len(forms) == len(lefts)
    if not (alike and 2 <= len(forms) <= MOST_TILES and make_up(tiles, tiles[-1].right_px)):
        tracks = ", ".join(f"{codec} of {width}x{height} px" for codec, height, width in forms)
        raise VideoError(
            os.fspath(path), None, f"calls its tracks columns of one picture, from {lefts} on, but they are {tracks}"
        )
    return tiles
