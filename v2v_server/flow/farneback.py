"""Polynomial expansion, by OpenCV.

Farneback, "Two-Frame Motion Estimation Based on Polynomial Expansion", SCIA 2003.
"""

from __future__ import annotations

from v2v_server.flow.estimator import Estimator, Field, Picture
from v2v_server.system.opencv import cv2

SMALLEST_SIDE_PX = 16


def farneback() -> Estimator:
    """An estimator with OpenCV's usual settings: 5 levels, a window of 15 pixels, 3 iterations."""

    def estimate(first: Picture, second: Picture) -> Field:
        field: Field = cv2.calcOpticalFlowFarneback(  # type: ignore[call-overload]
            first, second, None, pyr_scale=0.5, levels=5, winsize=15, iterations=3, poly_n=5, poly_sigma=1.2, flags=0
        )
        return field

    return estimate
