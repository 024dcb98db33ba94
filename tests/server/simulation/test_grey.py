"""Frames of every usual kind are simulated as their grey levels."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from v2v_protocol.errors import UsageError
from v2v_server.simulation import simulate
from v2v_server.simulation.clip import grey_levels

COLOUR = np.random.default_rng(3).integers(0, 256, (6, 8, 9, 3), np.uint8)
GREY = np.floor(COLOUR @ np.array([0.299, 0.587, 0.114]) + 0.5 + 1e-9).astype(np.uint8)


@pytest.mark.parametrize(
    "frames",
    [
        GREY[..., None],
        GREY[:, None],
        GREY / 255,
        (GREY / 255).astype(np.float32),
        COLOUR,
        np.moveaxis(COLOUR, 3, 1),
        torch.from_numpy(GREY),
        torch.from_numpy(GREY).float()[:, None] / 255,
        torch.from_numpy(np.moveaxis(COLOUR, 3, 1).copy()),
    ],
    ids=lambda frames: f"{type(frames).__name__}-{frames.dtype}-{'x'.join(map(str, frames.shape))}",
)
def test_every_kind_gives_the_same_events(frames: Any) -> None:
    np.testing.assert_array_equal(grey_levels(frames), GREY)
    made = simulate(frames, threshold_pos=0.2).voxels
    assert made.any()
    np.testing.assert_array_equal(made, simulate(GREY, threshold_pos=0.2).voxels)


def test_colours_in_floating_point_are_rounded_once() -> None:
    np.testing.assert_array_equal(grey_levels(COLOUR / 255), GREY)


def test_grey_levels_are_not_copied() -> None:
    assert grey_levels(GREY) is GREY


@pytest.mark.parametrize(
    ("frames", "message"),
    [
        (GREY.astype(np.int16), "uint8 or floating"),
        (GREY[0], "uint8 or floating"),
        (np.zeros((6, 8, 9, 4), np.uint8), "uint8 or floating"),
        (np.full((6, 8, 9), 1.5), "outside 0 .. 1"),
        (np.full((6, 8, 9), np.nan, np.float32), "NaN"),
        (GREY * 1.0, "outside 0 .. 1"),
        (torch.zeros((6, 8, 9), requires_grad=True), "requires grad"),
    ],
)
def test_frames_that_say_nothing_definite_are_refused(frames: Any, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        simulate(frames, threshold_pos=0.2)
