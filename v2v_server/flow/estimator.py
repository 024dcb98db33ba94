"""What every method of optical flow is: a function of two pictures. And what no method is trusted with alone."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
import numpy.typing as npt

from v2v_server.system.opencv import cv2

Picture = npt.NDArray[np.uint8]
"""[h, w] uint8, C-contiguous."""
Field = npt.NDArray[np.float32]
"""[h, w, 2] float32, (x, y), px."""
Estimator = Callable[[Picture, Picture], Field]
"""estimate(A, B): the field on the grid of A that leads to B. The result does not depend on earlier calls."""


def guarded(estimate: Estimator, smallest_side_px: int) -> Estimator:
    """The same estimator, made safe.

    Equal pictures have exactly zero flow, whatever the method makes of them. A picture with a side below
    ``smallest_side_px`` is enlarged by repeating its border: methods fail on such, some by a segmentation fault.
    """

    def safe(first: Picture, second: Picture) -> Field:
        height, width = first.shape
        if np.array_equal(first, second):
            return np.zeros((height, width, 2), np.float32)
        below, right = max(0, smallest_side_px - height), max(0, smallest_side_px - width)
        if below or right:
            first, second = (
                cv2.copyMakeBorder(picture, 0, below, 0, right, cv2.BORDER_REPLICATE).astype(np.uint8, copy=False)
                for picture in (first, second)
            )
        return estimate(first, second)[:height, :width]

    return safe


@contextmanager
def one_thread() -> Iterator[None]:
    """OpenCV with one thread: a server worker is one core's worth of work, and how a picture is divided among threads
    cannot change a result."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)
