"""Sparse to dense: pyramidal Lucas-Kanade on a grid of points, then edge-aware interpolation (Revaud et al.,
"EpicFlow", CVPR 2015), both by OpenCV.

OpenCV's own calcOpticalFlowSparseToDense joins the two with a fixed number of neighbours, and dies of a segmentation
fault where fewer points than that were tracked: on small pictures, and on large ones without texture. Here the
neighbours are never more than the points.
"""

from __future__ import annotations

import numpy as np

from v2v_server.flow.estimator import Estimator, Field, Picture
from v2v_server.system.opencv import cv2

SMALLEST_SIDE_PX = 64
_GRID_STEP_PX = 8
_WINDOW_PX = (21, 21)
_NEIGHBOURS = 128
_FEWEST_POINTS = 32
"""With fewer tracked points than this their mean displacement stands for all: there is nothing to interpolate."""


def sparse_to_dense() -> Estimator:
    """An estimator with the settings of OpenCV's function of that name."""

    def estimate(first: Picture, second: Picture) -> Field:
        height, width = first.shape
        rows, columns = np.mgrid[0:height:_GRID_STEP_PX, 0:width:_GRID_STEP_PX]
        points = np.stack([columns.ravel(), rows.ravel()], axis=1).astype(np.float32)
        moved, tracked, _ = cv2.calcOpticalFlowPyrLK(first, second, points, points.copy(), winSize=_WINDOW_PX)
        good = tracked.ravel() == 1
        points, moved = points[good], moved[good]
        if len(points) < _FEWEST_POINTS:
            mean = (moved - points).mean(axis=0) if len(points) else np.zeros(2, np.float32)
            return np.full((height, width, 2), mean, np.float32)
        interpolate = cv2.ximgproc.createEdgeAwareInterpolator()
        interpolate.setK(min(_NEIGHBOURS, len(points)))
        interpolate.setUsePostProcessing(True)
        field: Field = interpolate.interpolate(  # type: ignore[assignment]
            cv2.cvtColor(first, cv2.COLOR_GRAY2BGR), points, cv2.cvtColor(second, cv2.COLOR_GRAY2BGR), moved
        )
        return field

    return estimate
