"""Test the colour wheel: direction is hue, length is saturation."""

from __future__ import annotations

import numpy as np
import pytest

from v2v_pictures.colours import draw_flow, draw_wheel

RED = (255, 0, 0)


def one(x: float, y: float, largest: float = 1.0) -> tuple[int, ...]:
    return tuple(int(value) for value in draw_flow(np.array([x, y], np.float32).reshape(2, 1, 1), largest)[0, 0])


def test_directions_have_their_colours() -> None:
    """Right is red, down yellow, left between cyan and blue, up violet."""
    directions = ((1, 0), (0, 1), (-1, 0), (0, -1))
    assert [one(*each) for each in directions] == [RED, (255, 234, 0), (0, 197, 255), (103, 0, 255)]


def test_length_is_saturation_and_longer_is_darker() -> None:
    assert one(0, 0) == (255, 255, 255)
    assert one(0.5, 0) == (255, 128, 128)
    assert one(2, 0) == (191, 0, 0)
    greens = [one(length, 0)[1] for length in np.linspace(0, 1, 11)]
    assert greens == sorted(greens, reverse=True)


def test_full_colour_is_the_longest_or_one_pixel() -> None:
    field = np.zeros((2, 1, 2), np.float16)
    field[0, 0] = (8.0, 4.0)
    assert tuple(draw_flow(field)[0, 0]) == RED
    assert tuple(draw_flow(field)[0, 1]) == (255, 128, 128)
    assert tuple(draw_flow(field / np.float16(80))[0, 0]) != RED
    assert draw_flow(np.zeros((2, 0, 5))).shape == (0, 5, 3)


def test_hue_is_continuous() -> None:
    angles = np.linspace(0, 2 * np.pi, 721)
    ring = draw_flow(np.stack([np.cos(angles), np.sin(angles)])[:, None], 1.0)[0].astype(int)
    assert np.abs(np.diff(ring, axis=0)).max() < 20
    assert np.abs(ring[0] - ring[-1]).max() <= 1


@pytest.mark.parametrize("radius", [1, 40])
def test_the_wheel_shows_the_flow_that_leads_to_each_pixel(radius: int) -> None:
    wheel = draw_wheel(radius)
    assert wheel.shape == (2 * radius + 1, 2 * radius + 1, 3)
    assert tuple(wheel[radius, radius]) == (255, 255, 255)
    assert tuple(wheel[radius, -1]) == RED
    assert tuple(wheel[0, 0]) == (255, 255, 255)
    assert tuple(wheel[-1, radius]) == one(0, 1)
