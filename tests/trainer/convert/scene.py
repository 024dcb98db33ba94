"""Define a small recording whose voxel grids are known without computation, and its parts as arrays.

Five pictures, 10 ms apart. The events of window w lie at 0, 900, 2700, 4500, 6300, 8100, 9000 us after its picture: the
first and the last fix the span of 9000 us, the five between are at the middle of each fifth.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

WIDTH, HEIGHT = 24, 18
WINDOWS = 4
PERIOD_US = 10_000
START_US = 5_000_000
OFFSETS_US = (0, 900, 2700, 4500, 6300, 8100, 9000)

DISCRETE_BIN = (0, 0, 1, 2, 3, 4, 4)
INTERPOLATED = (
    # share of each event in the five bins: 4 u is 0, 0.4, 1.2, 2, 2.8, 3.6, 4
    (1, 0, 0, 0, 0),
    (0.6, 0.4, 0, 0, 0),
    (0, 0.8, 0.2, 0, 0),
    (0, 0, 1, 0, 0),
    (0, 0, 0.2, 0.8, 0),
    (0, 0, 0, 0.4, 0.6),
    (0, 0, 0, 0, 1),
)


@dataclass(frozen=True, eq=False)
class Scene:
    """Hold events sorted by time, t in us; pictures and their times."""

    t_us: npt.NDArray[np.int64]
    x: npt.NDArray[np.int64]
    y: npt.NDArray[np.int64]
    p: npt.NDArray[np.bool_]
    pictures: npt.NDArray[np.uint8]
    picture_us: npt.NDArray[np.int64]


def polarity(window: int, position: int) -> bool:
    return (window + position) % 3 != 0


def scene() -> Scene:
    """Event ``position`` of window w is at x = 2 position + 1, y = 3 w + 2."""
    rows = [
        (START_US + PERIOD_US * window + offset, 2 * position + 1, 3 * window + 2, polarity(window, position))
        for window in range(WINDOWS)
        for position, offset in enumerate(OFFSETS_US)
    ]
    t, x, y, p = (np.array(column) for column in zip(*rows, strict=True))
    rng = np.random.default_rng(0)
    pictures = rng.integers(0, 256, (WINDOWS + 1, HEIGHT, WIDTH), dtype=np.uint8)
    return Scene(t, x, y, p, pictures, START_US + PERIOD_US * np.arange(WINDOWS + 1))


def expected_voxels(window: int, kind: str) -> npt.NDArray[np.float64]:
    """[5, HEIGHT, WIDTH], by the tables above."""
    grid = np.zeros((5, HEIGHT, WIDTH))
    for position in range(len(OFFSETS_US)):
        sign = 1 if polarity(window, position) else -1
        y, x = 3 * window + 2, 2 * position + 1
        if kind == "discrete":
            grid[DISCRETE_BIN[position], y, x] = sign
        else:
            grid[:, y, x] = sign * np.array(INTERPOLATED[position])
    return grid
