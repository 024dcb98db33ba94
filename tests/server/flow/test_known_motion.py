"""The truth of the flow bench is true, and so are its error measures."""

from __future__ import annotations

import cv2
import numpy as np

from tests.oracles.known_motion import photograph, scenes
from v2v_server.flow import consistent


def brought(picture: np.ndarray, field: np.ndarray) -> np.ndarray:
    """``picture`` sampled where the field leads."""
    y, x = np.mgrid[: picture.shape[0], : picture.shape[1]].astype(np.float32)
    return cv2.remap(picture, x + field[..., 0], y + field[..., 1], cv2.INTER_CUBIC)


def test_following_the_flow_finds_the_same_picture() -> None:
    for scene in scenes({"coffee": photograph("coffee")}, 100, 160):
        seen = consistent(scene.forward, scene.backward) & ~scene.boundary
        assert seen.mean() > 0.4, scene.name
        for field, source, target in (
            (scene.forward, scene.later, scene.earlier),
            (scene.backward, scene.earlier, scene.later),
        ):
            gap = np.abs(brought(source, field).astype(float) - target)
            seen = consistent(field, scene.backward if field is scene.forward else scene.forward) & ~scene.boundary
            # Rounding, and where there is noise, that of both pictures.
            assert gap[seen].mean() < (3.5 if scene.degradation == "noise" else 1.5), scene.name
