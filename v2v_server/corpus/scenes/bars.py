"""Letterbox and pillarbox bars: dark rows and columns at the sides of the picture that show nothing."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from v2v_server.corpus.scenes.scene import NO_BARS, Sides

_DARKEST_PICTURE = 32
"""Grey level up to which a side may be a bar."""
_NOISE_LEVELS = 6
_FIRST_LINES = 16
"""Most pictures have no bars, which these lines tell."""
_EDGE_PX = 8
"""Coded with few bits, this part of a bar beside the picture is not flat."""
_LEAST_PX = 4
_LEAST_FLAT_PX = 2
_MOST_SPREAD_PX = 2
_LEAST_SHARE = 50
"""Thinner ones than 1/50 of the picture's side do not count."""


def bars_of(picture: npt.NDArray[np.uint8]) -> Sides:
    """Return the bars of a picture at the top, bottom, left and right, in pixels.

    A row or column belongs to a bar if at most 1/50 of its pixels differ by more than 6 grey levels from the median of
    the outermost one, and so do all rows or columns outside of it. The bar then ends at the largest step nearby.

    Args:
        picture: [H, W] uint8.
    """
    return Sides(_depth(picture), _depth(picture[::-1]), _depth(picture.T), _depth(picture.T[::-1]))


def _depth(lines: npt.NDArray[np.uint8]) -> int:
    level = int(np.sort(lines[0])[lines.shape[1] // 2])
    if level > _DARKEST_PICTURE:
        return 0
    flat = _flat(lines[:_FIRST_LINES], level)
    if flat == _FIRST_LINES:
        flat = _flat(lines, level)
    around = lines[max(0, flat - 1) : flat + _EDGE_PX].astype(np.int16)
    if len(around) < 2 or flat < _LEAST_FLAT_PX:
        return flat
    steps = np.abs(np.diff(around, axis=0)).sum(axis=1, dtype=np.int64)
    return flat + int(steps.argmax())


def _flat(lines: npt.NDArray[np.uint8], level: int) -> int:
    # Levels 0 .. 38 suffice, and stay in uint8.
    different = (lines > level + _NOISE_LEVELS) | (lines < max(0, level - _NOISE_LEVELS))
    is_picture = different.sum(axis=1) > lines.shape[1] // 50
    return int(is_picture.argmax()) if is_picture.any() else len(lines)


def common_bars(found: Sequence[Sides], height: int, width: int) -> Sides:
    """Return the bars that half of the pictures have, and three quarters at least half as deep.

    Where they differ from picture to picture it is dark content, not a bar. Coded with few bits, a bar is less deep in
    some pictures.

    Args:
        found: of each picture.
        height, width: of the pictures.
    """
    if not found:
        return NO_BARS
    depths = []
    for side in map(sorted, zip(*found, strict=True)):
        middle = side[len(found) // 2]
        alike = sum(abs(depth - middle) <= _MOST_SPREAD_PX for depth in side)
        depths.append(middle if 2 * alike >= len(found) and 2 * side[len(found) // 4] >= middle else 0)
    if depths[0] + depths[1] >= height or depths[2] + depths[3] >= width:
        return NO_BARS  # flat pictures
    sizes = height, height, width, width
    least = [max(_LEAST_PX, size // _LEAST_SHARE) for size in sizes]
    return Sides(*(depth if depth >= limit else 0 for depth, limit in zip(depths, least, strict=True)))
