"""Flow methods beside the exact flow of worlds, and networks that learn from either and see the same otherwise."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch

from bench.accuracy.flow import LENGTHS_PX, beside_worlds
from bench.accuracy.learn_flow import ESTIMATED, EXACT, MARGIN_PX, SETTINGS, SIDE_PX, arms, judge, learn
from tests.oracles.known_motion import photograph
from trainer.config_file import load_config
from v2v_client import Batch

CONFIG = load_config("evflownet-worlds", [*SETTINGS, "network.options.base_channels=2"])
WIDE_PX = SIDE_PX + 2 * MARGIN_PX


def batch(seed: int, right_px: int) -> Batch:
    """Return two clips of random events, of a picture that moves to the right; their flow is random, as a marker."""
    random, grey = torch.Generator().manual_seed(seed), photograph("camera")
    frames = [grey[100 : 100 + WIDE_PX, 200 - step * right_px :][:, :WIDE_PX] for step in range(2)]
    flow = torch.randn((2, 1, 2, WIDE_PX, WIDE_PX), generator=random).half()
    arrays = {
        "voxels": torch.randint(-2, 3, (2, 1, 5, WIDE_PX, WIDE_PX), generator=random, dtype=torch.int8),
        "frames": torch.from_numpy(np.stack([frames, frames])[:, :, None]),
        "flow": flow if right_px else torch.zeros_like(flow),
        "flow_valid": torch.ones((2, 1, 1, WIDE_PX, WIDE_PX), dtype=torch.uint8),
    }
    return Batch(arrays, (0, 1), 0, (), {}, 0.0, 0.0, 2, CONFIG.stream.resolved_recipe)


@pytest.mark.slow
def test_no_flow_at_all_is_wrong_by_the_length_of_the_exact_flow() -> None:
    records = {record["where"]: record for record in beside_worlds(("zero",), 3)}
    assert abs(sum(record["share"] for record in records.values()) - 1.0) < 1e-6
    for low, high in itertools.pairwise(LENGTHS_PX[1:]):
        record = records.get(f"{low:g} to {high:g} px")
        assert record is None or low <= record["error_median_px"] < high


def test_the_arms_differ_in_nothing_but_the_flow() -> None:
    given, inner = batch(0, right_px=3), slice(MARGIN_PX, MARGIN_PX + SIDE_PX)
    exact, estimated = (arms(given)[arm].arrays for arm in (EXACT, ESTIMATED))
    for name, array in given.arrays.items():
        assert torch.equal(exact[name], array[..., inner, inner])
        assert torch.equal(estimated[name], exact[name]) or name in ("flow", "flow_valid")
    right, down = estimated["flow"][0, 0].float()
    assert abs(float(right.median()) - 3) < 0.1
    assert abs(float(down.median())) < 0.1


@pytest.mark.slow
def test_equal_flow_makes_equal_networks() -> None:
    for right_px in (0, 3):
        [(steps, networks)] = learn((batch(seed, right_px) for seed in range(9)), CONFIG, (3,))
        mine, other = (network.state_dict() for network in networks.values())
        assert steps == 3
        assert all(torch.equal(mine[key], other[key]) for key in mine) == (right_px == 0)


def test_no_motion_is_wrong_by_the_length_of_the_exact_flow() -> None:
    errors, length, visible = judge([batch(0, right_px=3)], {})
    assert np.array_equal(errors["no motion"], length)
    assert visible.all()
    assert length.shape == (2, 1, SIDE_PX, SIDE_PX)
