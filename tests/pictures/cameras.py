"""Cameras of known events, for the tests of this folder."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from tests.protocol.test_sample import PARAMS, PROVENANCE
from v2v_pictures.camera import Camera
from v2v_pictures.canvas import Canvas


def camera(
    voxels: npt.NDArray[Any],
    *,
    pauses: tuple[tuple[int, int], ...] = (),
    flow: npt.NDArray[Any] | None = None,
    lead: int = 0,
) -> Camera:
    provenance = dataclasses.replace(PROVENANCE, params=dataclasses.replace(PARAMS, pauses=pauses))
    count, height, width = len(voxels), *voxels.shape[2:]
    frames = np.full((count - lead, 1, height, width), 90, np.uint8)
    arrays = {"voxels": voxels, "frames": frames} | ({} if flow is None else {"flow": flow})
    return Camera.of(arrays, provenance, "paper")


def has(image: npt.NDArray[np.uint8], colour: tuple[int, ...]) -> int:
    return int((image == colour).all(axis=-1).sum())


def without_noise(shown: Camera, quiet: npt.NDArray[Any]) -> Camera:
    return dataclasses.replace(shown, quiet=dataclasses.replace(shown, voxels=quiet).rates)


def record_texts(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return a list that collects every text drawn from now on."""
    written: list[str] = []
    write = Canvas.text

    def listen(page: Canvas, x: float, y: float, text: str, **style: Any) -> float:
        written.append(text)
        return write(page, x, y, text, **style)

    monkeypatch.setattr(Canvas, "text", listen)
    return written
