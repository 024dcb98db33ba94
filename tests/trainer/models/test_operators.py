"""Compare the operators of HyperE2VID, ET-Net and E-RAFT with slow float64 versions of their equations."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch

from tests.trainer.models import numpy_networks as oracle
from trainer.models import ERAFT
from trainer.models.etnet import HEADS, _Layer, _Positions
from trainer.models.hypere2vid import ATOMS, DynamicDecoder, bases, fourier_bessel
from trainer.models.raft import LEVELS, convex_upsampling, correlation_pyramid, forward_splat, look_up

RNG = np.random.default_rng(0)


def tensor(array: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(array))


def test_dynamic_convolution_has_a_kernel_of_its_own_at_every_pixel() -> None:
    decoder = DynamicDecoder(5, 3, 4).double()
    x, coefficients = RNG.standard_normal((2, 3, 4, 6)), RNG.standard_normal((2, ATOMS, 12, 4, 6))
    functions = bases().double()
    weights = decoder.dynamic_conv.compositional_coefficients.detach().numpy()[..., 0, 0]
    atoms = np.einsum("bmkhw,kl->bmlhw", coefficients, functions.numpy()).reshape(2, ATOMS, 5, 5, 4, 6)
    padded = np.pad(x, ((0, 0), (0, 0), (2, 2), (2, 2)))
    expected = np.zeros((2, 4, 4, 6))
    for b, row, column in np.ndindex(2, 4, 6):
        near = padded[b, :, row : row + 5, column : column + 5]
        features = np.array(
            [[(near[c] * atoms[b, m, :, :, row, column]).sum() for m in range(ATOMS)] for c in range(3)]
        )
        expected[b, :, row, column] = weights @ features.ravel()  # channel c, atom m at c * 6 + m
    with torch.no_grad():
        found = decoder.dynamic_conv(tensor(x), tensor(coefficients), functions)
    np.testing.assert_allclose(found.numpy(), expected, rtol=0, atol=1e-12)


def test_the_fixed_functions_are_waves_on_a_disc() -> None:
    """Zeros of J0, J1 (two functions), J2 (two), J0: by their symmetry under a quarter turn."""
    for reach, bandwidth in ((1, 2.0), (2, 1.5)):
        every = fourier_bessel(reach, bandwidth)
        assert 6 <= len(every) <= (2 * reach + 1) ** 2 - 1
        assert (every**2).sum(axis=(1, 2)).mean() == pytest.approx(1)
        flat, first, second, third, fourth, ring = every[:6]
        for radial in (flat, ring):
            np.testing.assert_allclose(np.rot90(radial), radial, atol=1e-12)
        assert (flat >= 0).all()  # 0 in the corners, which are outside the disc
        for wave in (first, second):
            np.testing.assert_allclose(np.rot90(wave, 2), -wave, atol=1e-12)
        for wave in (third, fourth):
            np.testing.assert_allclose(np.rot90(wave), -wave, atol=1e-12)
        # cos of the angle from the axis of rows: it changes with the row alone along the middle column.
        np.testing.assert_allclose(first[reach], 0, atol=1e-12)
        assert first[-1, reach] > 0
        assert second[reach, -1] > 0
    table = bases().numpy().reshape(12, 5, 5)
    assert (table[:6, [0, -1]] == 0).all()
    np.testing.assert_allclose(table[6:], every[:6], rtol=1e-6)


def attention(q: np.ndarray, k: np.ndarray, weights: oracle.Weights, name: str) -> np.ndarray:
    """Token by token; [L, C] and [M, C] -> [L, C]."""
    channels = q.shape[1]
    parts = zip(
        np.split(weights[f"{name}.in_proj_weight"], 3),
        np.split(weights[f"{name}.in_proj_bias"], 3),
        (q, k, k),
        strict=True,
    )
    q, k, v = (x @ weight.T + bias for weight, bias, x in parts)
    width, mixed = channels // HEADS, np.zeros_like(q)
    for head in range(HEADS):
        part = slice(head * width, (head + 1) * width)
        for token in range(len(q)):
            score = np.exp(k[:, part] @ q[token, part] / np.sqrt(width))
            mixed[token, part] = score / score.sum() @ v[:, part]
    return mixed @ weights[f"{name}.out_proj.weight"].T + weights[f"{name}.out_proj.bias"]


def layer_norm(x: np.ndarray, weights: oracle.Weights, name: str) -> np.ndarray:
    centred = x - x.mean(axis=1, keepdims=True)
    normed = centred / np.sqrt((centred**2).mean(axis=1, keepdims=True) + 1e-5)
    return normed * weights[f"{name}.weight"] + weights[f"{name}.bias"]


@pytest.mark.parametrize("cross", [False, True])
def test_a_transformer_layer(cross: bool) -> None:
    layer = _Layer(16, cross=cross).eval()
    w = oracle.random_weights(layer, seed=4)
    x, memory = RNG.standard_normal((5, 2, 16)), RNG.standard_normal((7, 2, 16))
    with torch.no_grad():
        found = layer(tensor(x), tensor(memory) if cross else None).numpy()
    for index in range(2):
        y = x[:, index]
        normed = layer_norm(y, w, "norm1")
        y = y + attention(normed, normed, w, "self_attn")
        if cross:
            other = layer_norm(memory[:, index], w, "norm22")
            y = y + attention(layer_norm(y, w, "norm21"), other, w, "cross_attn")
        hidden = oracle.relu(
            layer_norm(y, w, "norm3" if cross else "norm2") @ w["linear1.weight"].T + w["linear1.bias"]
        )
        y = y + hidden @ w["linear2.weight"].T + w["linear2.bias"]
        np.testing.assert_allclose(found[:, index], y, rtol=0, atol=1e-10)


def test_positions_are_waves_of_the_raster_index() -> None:
    table = _Positions(8).pos_table[0].double().numpy()
    for place, channel in ((0, 0), (0, 1), (3, 0), (3, 5), (9599, 6), (19_999, 7)):
        angle = place / 10_000 ** (2 * (channel // 2) / 8)
        assert table[place, channel] == pytest.approx(np.cos(angle) if channel % 2 else np.sin(angle), abs=1e-6)


def test_convex_upsampling() -> None:
    flow, logits = RNG.standard_normal((2, 2, 3, 4)), RNG.standard_normal((2, 576, 3, 4))
    expected = np.zeros((2, 2, 24, 32))
    padded = np.pad(8 * flow, ((0, 0), (0, 0), (1, 1), (1, 1)))
    for b, row, column in np.ndindex(2, 24, 32):
        y, x = row // 8, column // 8
        share = np.exp(logits[b].reshape(9, 8, 8, 3, 4)[:, row % 8, column % 8, y, x])
        near = padded[b, :, y : y + 3, x : x + 3].reshape(2, 9)
        expected[b, :, row, column] = near @ (share / share.sum())
    np.testing.assert_allclose(convex_upsampling(tensor(flow), tensor(logits)).numpy(), expected, rtol=0, atol=1e-12)


def bilinear(plane: np.ndarray, x: float, y: float) -> float:
    """0 outside."""
    left, top = int(np.floor(x)), int(np.floor(y))
    return sum(
        (1 - abs(x - c)) * (1 - abs(y - r)) * plane[r, c]
        for r, c in ((top, left), (top, left + 1), (top + 1, left), (top + 1, left + 1))
        if 0 <= r < plane.shape[0] and 0 <= c < plane.shape[1]
    )


def test_correlations_are_looked_up_around_where_the_flow_points() -> None:
    """This includes a coarsest plane that is one pixel high."""
    height, width, radius = 8, 11, 2
    one, other = RNG.standard_normal((2, 1, 6, height, width))
    flow = 3 * RNG.standard_normal((1, 2, height, width))
    grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)))[None]
    pyramid = correlation_pyramid(tensor(one), tensor(other))
    found = look_up(pyramid, tensor(grid + flow), radius).numpy()[0]
    for row, column in ((0, 0), (3, 5), (7, 10)):
        plane = np.einsum("c,chw->hw", one[0, :, row, column], other[0]) / np.sqrt(6)
        expected = []
        for level in range(LEVELS):
            x, y = (grid + flow)[0, :, row, column] / 2**level
            steps = range(-radius, radius + 1)
            expected += [bilinear(plane, x + dx, y + dy) for dx in steps for dy in steps]  # y varies faster
            h, w = plane.shape[0] // 2, plane.shape[1] // 2
            plane = plane[: 2 * h, : 2 * w].reshape(h, 2, w, 2).mean(axis=(1, 3))
        np.testing.assert_allclose(found[:, row, column], expected, rtol=0, atol=1e-10)


def test_splatting() -> None:
    """As in the published code, each vector is added to the four pixels around its end, then divided by the weights."""
    flow = 2 * RNG.standard_normal((2, 2, 5, 7))
    flow[0, :, 2, 3] = (1.0, -1.0)  # ends on a pixel
    expected = np.zeros_like(flow)
    for b in range(2):
        weights = np.zeros((5, 7))
        for row, column in np.ndindex(5, 7):
            x, y = column + flow[b, 0, row, column], row + flow[b, 1, row, column]
            for r, c in np.ndindex(5, 7):
                weight = max(0, 1 - abs(x - c)) * max(0, 1 - abs(y - r))
                weights[r, c] += weight
                expected[b, :, r, c] += weight * flow[b, :, row, column]
        expected[b] /= np.where(weights > 0, weights, 1)
    np.testing.assert_allclose(forward_splat(tensor(flow)).numpy(), expected, rtol=0, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("by_window", [False, True])
def test_batch_norm_of_the_context_is_that_of_one_window_only_if_asked(by_window: bool) -> None:
    """In training the result equals that of a loop over windows."""
    torch.manual_seed(0)
    network = ERAFT(bins=2, context_by_window=by_window, warm_start=False).train()
    looped = copy.deepcopy(network)
    voxels = torch.randint(-3, 4, (2, 4, 2, 64, 64)).float()
    with torch.no_grad():
        whole, _ = network(voxels)
        parts = [looped(voxels[:, step : step + 2])[0] for step in range(3)]
    assert torch.allclose(torch.cat(parts, dim=2), whole, rtol=0, atol=1e-3) == by_window
    statistics = [dict(each.named_buffers())["raft.context_encoder.layer1.0.convnormrelu1.1.running_mean"]
                  for each in (network, looped)]  # fmt: skip
    assert torch.allclose(*statistics, rtol=0, atol=1e-5) == by_window
