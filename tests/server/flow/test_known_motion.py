"""The truth of the flow bench is true, and so are its error measures."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from bench.accuracy import flow as benchmark
from tests.oracles.known_motion import Scene, photograph, scenes
from v2v_server.flow import consistent

TEXTURES = {name: photograph(name) for name in ("coffee", "camera", "chelsea")}


@pytest.fixture(scope="module")
def made() -> list[Scene]:
    return scenes(TEXTURES, 100, 160)


def brought(picture: np.ndarray, field: np.ndarray) -> np.ndarray:
    """``picture`` sampled where the field leads."""
    y, x = np.mgrid[: picture.shape[0], : picture.shape[1]].astype(np.float32)
    return cv2.remap(picture, x + field[..., 0], y + field[..., 1], cv2.INTER_CUBIC)


def test_following_the_flow_finds_the_same_picture(made: list[Scene]) -> None:
    for scene in made:
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


def test_errors_are_those_of_the_methods_and_bars_can_be_missed(made: list[Scene]) -> None:
    pairs = scenes(TEXTURES, benchmark.HEIGHT_PX, benchmark.WIDTH_PX, every=12)
    records = [record for name in ("zero", "auto") for record in benchmark.accuracy(name, pairs)]
    error = {(item["method"], item["context"], item["picture"]): item["error_mean_px"] for item in records}
    assert len(error) == len(records) == 10
    assert error["auto", "whole", "180x596"] < 0.5 * error["zero", "whole", "180x596"]
    length = np.concatenate([np.linalg.norm(pair.forward, axis=-1).ravel() for pair in pairs])
    assert error["zero", "whole", "180x596"] == pytest.approx(length.mean(), rel=1e-5)
    assert benchmark.missed(records) == []
    assert len(benchmark.missed([{**item, "pan_zoom_error_median_px": 0.25} for item in records])) == 1
