"""DeepFlow's variational stage (Weinzaepfel et al., "DeepFlow: Large Displacement Optical Flow with Deep Matching",
ICCV 2013) without deep matching, by OpenCV."""

from __future__ import annotations

from v2v_server.flow.estimator import Estimator, Field, Picture
from v2v_server.system.opencv import cv2

SMALLEST_SIDE_PX = 16


def deepflow() -> Estimator:
    """An estimator with OpenCV's only settings. Slow: for comparison."""
    flow = cv2.optflow.createOptFlow_DeepFlow()

    def estimate(first: Picture, second: Picture) -> Field:
        field: Field = flow.calc(first, second, None)  # type: ignore[call-overload]
        return field

    return estimate
