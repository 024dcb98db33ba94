"""The forward-backward check on fields known exactly."""

from __future__ import annotations

import numpy as np

from v2v_server.flow import consistent


def uniform(x: float, y: float, height: int = 40, width: int = 50) -> np.ndarray:
    return np.broadcast_to(np.float32([x, y]), (height, width, 2)).copy()


def test_what_leaves_the_picture_is_invalid() -> None:
    valid = consistent(uniform(5, -3), uniform(-5, 3))
    expected = np.zeros((40, 50), bool)
    expected[3:, :45] = True
    np.testing.assert_array_equal(valid, expected)


def test_the_two_fields_must_agree() -> None:
    # |f + g|^2 = 4 is above 0.01 (25 + 9) + 0.5, and 0.25 is below it.
    assert not consistent(uniform(5, 0), uniform(-3, 0)).any()
    assert consistent(uniform(5, 0), uniform(-4.5, 0))[:, :45].all()
    assert not consistent(uniform(5, 0), uniform(5, 0)).any()


def test_the_opposite_field_is_read_where_the_first_one_leads() -> None:
    """A block moves 8 px right over a still ground: what it uncovers is visible in one picture only."""
    forward, backward = uniform(0, 0), uniform(0, 0)
    forward[10:20, 10:20] = (8, 0)
    backward[10:20, 18:28] = (-8, 0)
    valid = consistent(forward, backward)
    assert valid[10:20, 10:20].all()  # the block
    assert not valid[10:20, 20:28].any()  # ground that the block covers in the later picture
    assert valid[:10].all()
    assert valid[20:].all()
