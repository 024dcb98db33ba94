"""Letterbox and pillarbox bars: dark rows and columns at the sides of the picture that show nothing."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from v2v_server.defects.defect import Sides

_DARKEST_PICTURE = 32
"""Grey level up to which a side may be a bar."""
_NOISE_LEVELS = 6
_EDGE_PX = 8
"""Coded with few bits, this part of a bar beside the picture is not flat."""
_LEAST_PX = 4
_LEAST_FLAT_PX = 2
_MOST_SPREAD_PX = 2
_LEAST_SHARE = 50
"""Thinner ones than 1/50 of the picture's side do not count."""


def bars_of(picture: npt.NDArray[np.uint8]) -> tuple[int, int, int, int]:
    """Return the bars of a picture at the top, bottom, left and right, in pixels.

    A row or column belongs to a bar if at most 1/50 of its pixels differ by more than 6 grey levels from the median of
    the outermost one, and so do all rows or columns outside of it. The bar then ends at the largest step nearby.

    Args:
        picture: [H, W] uint8.
    """
    return _depth(picture), _depth(picture[::-1]), _depth(picture.T), _depth(picture.T[::-1])


def _depth(lines: npt.NDArray[np.uint8]) -> int:
    level = int(np.sort(lines[0])[lines.shape[1] // 2])
    if level > _DARKEST_PICTURE:
        return 0
    # Levels 0 .. 38 suffice, and stay in uint8.
    different = (lines > level + _NOISE_LEVELS) | (lines < max(0, level - _NOISE_LEVELS))
    is_picture = different.sum(axis=1) > lines.shape[1] // 50
    flat = int(is_picture.argmax()) if is_picture.any() else len(lines)
    around = lines[max(0, flat - 1) : flat + _EDGE_PX].astype(np.int16)
    if len(around) < 2 or flat < _LEAST_FLAT_PX:
        return flat
    steps = np.abs(np.diff(around, axis=0)).sum(axis=1, dtype=np.int64)
    return flat + int(steps.argmax())


def common_bars(found: Sequence[tuple[int, int, int, int]], height: int, width: int) -> Sides | None:
    """Return the bars that three quarters of the pictures have; None without any.

    Where they differ from picture to picture it is dark content, not a bar.

    Args:
        found: of each picture.
        height, width: of the pictures.
    """
    if not found:
        return None
    depths = []
    for side in map(sorted, zip(*found, strict=True)):
        depth, middle = side[len(found) // 4], side[len(found) // 2]
        depths.append(depth if middle - depth <= _MOST_SPREAD_PX else 0)
    if depths[0] + depths[1] >= height or depths[2] + depths[3] >= width:
        return None  # flat pictures
    sizes = height, height, width, width
    sides = Sides(
        *(
            depth if depth >= max(_LEAST_PX, size // _LEAST_SHARE) else 0
            for depth, size in zip(depths, sizes, strict=True)
        )
    )
    return None if sides == Sides(0, 0, 0, 0) else sides
