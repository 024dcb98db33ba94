"""Representations of other networks, each against its plain definition."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from v2v_client.representations import event_count_image, exponential_surface, normalised, stacked_histogram


@pytest.fixture
def counts() -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(1).integers(0, 128, (3, 4, 2, 5, 6, 7)).astype(np.int8))


def test_a_stacked_histogram_has_the_negative_bins_first(counts: torch.Tensor) -> None:
    stacked = stacked_histogram(counts)
    assert stacked.shape == (3, 4, 10, 6, 7)
    assert stacked.data_ptr() == counts.data_ptr()
    for place in range(10):
        assert torch.equal(stacked[:, :, place], counts[:, :, place // 5, place % 5])
    assert torch.equal(stacked_histogram(counts, cutoff=10), stacked.clamp(max=10))


def test_an_event_count_image_does_not_wrap(counts: torch.Tensor) -> None:
    image = event_count_image(counts)
    assert image.dtype == torch.int32
    np.testing.assert_array_equal(image.numpy(), counts.numpy().astype(int).sum(axis=3))
    assert event_count_image(counts.float()).dtype == torch.float32


def test_normalised_voxels_have_mean_0_and_deviation_1_where_they_are_not_zero() -> None:
    voxels = np.random.default_rng(2).integers(-3, 4, (2, 3, 5, 6, 7)).astype(np.int8)
    voxels[1, 1], voxels[1, 2] = 0, 4
    got = normalised(torch.from_numpy(voxels)).numpy()
    for grid, result in zip(voxels.reshape(6, -1), got.reshape(6, -1), strict=True):
        rest = grid[grid != 0].astype(float)
        expected = np.zeros(grid.shape)
        if rest.size and rest.std() > 0:
            expected[grid != 0] = (rest - rest.mean()) / rest.std()
        np.testing.assert_allclose(result, expected, atol=1e-5)


@pytest.mark.parametrize("shape", [(5, 9, 7), (5, 64, 64)])
def test_equal_voxels_that_are_not_whole_become_0(shape: tuple[int, int, int]) -> None:
    assert not normalised(torch.full(shape, 0.1)).any()


def test_an_exponential_surface_by_hand() -> None:
    """1 at an event, 1/e after a time constant, 0 where there was none."""
    ages = torch.tensor([0.0, 0.05, 0.1, torch.inf], dtype=torch.float16).reshape(2, 1, 1, 2)
    found = exponential_surface(ages, 0.05)
    assert found.dtype == torch.float32
    assert found.shape == ages.shape
    torch.testing.assert_close(found.flatten(), torch.tensor([1.0, 0.36788, 0.13534, 0.0]), rtol=1e-3, atol=0.0)
