"""Reimplement the networks and losses in float64 NumPy, one picture and one time step at a time.

Tests compare the trainer with these. They follow the equations and key lists and share no code with the trainer.
Pictures are [C, H, W].
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt
import torch

Array = npt.NDArray[np.float64]
Weights = Mapping[str, Array]


def counts(shape: tuple[int, ...], seed: int = 0) -> npt.NDArray[np.int8]:
    """Return signed event counts, mostly 0, as in the stream."""
    rng = np.random.default_rng(seed)
    return (rng.integers(-3, 4, shape) * (rng.random(shape) < 0.3)).astype(np.int8)


def random_weights(network: torch.nn.Module, seed: int) -> dict[str, Array]:
    """Draw weights of an initialised network's scale, key by key, and load them into ``network`` in float64."""
    rng = np.random.default_rng(seed)
    state = {}
    for name, tensor in network.state_dict().items():
        fan_in = max(1, int(np.prod(tensor.shape[1:])))
        state[name] = rng.standard_normal(tuple(tensor.shape)) * (1.4 / np.sqrt(fan_in) if tensor.ndim > 1 else 0.1)
    network.double().load_state_dict({name: torch.from_numpy(array) for name, array in state.items()})
    return state


def relu(x: Array) -> Array:
    return np.maximum(x, 0)


def sigmoid(x: Array) -> Array:
    return 1 / (1 + np.exp(-x))


def conv(x: Array, weights: Weights, name: str, *, stride: int = 1, padding: int | None = None) -> Array:
    """Cross-correlation with ``name.weight`` [O, C, k, k] and ``name.bias``; "same" padding unless told otherwise."""
    kernel = weights[f"{name}.weight"]
    size = kernel.shape[-1]
    pad = size // 2 if padding is None else padding
    windows = np.lib.stride_tricks.sliding_window_view(
        np.pad(x, ((0, 0), (pad, pad), (pad, pad))), (size, size), (1, 2)
    )
    out = np.tensordot(kernel, windows[:, ::stride, ::stride], axes=([1, 2, 3], [0, 3, 4]))
    return out + weights[f"{name}.bias"][:, None, None]


def upsample(x: Array) -> Array:
    """Twice the size, bilinear, half-pixel centres: each new pixel is 3/4 of the nearer and 1/4 of the next."""
    for axis in (1, 2):
        x = np.moveaxis(x, axis, 0)
        before, after = np.concatenate([x[:1], x[:-1]]), np.concatenate([x[1:], x[-1:]])
        x = np.stack([0.75 * x + 0.25 * before, 0.75 * x + 0.25 * after], axis=1).reshape(-1, *x.shape[1:])
        x = np.moveaxis(x, 0, axis)
    return x


def conv_lstm(x: Array, hidden: Array, cell: Array, weights: Weights, name: str) -> tuple[Array, Array]:
    admit, keep, emit, candidate = np.split(conv(np.concatenate([x, hidden]), weights, f"{name}.Gates"), 4)
    cell = sigmoid(keep) * cell + sigmoid(admit) * np.tanh(candidate)
    return sigmoid(emit) * np.tanh(cell), cell


def conv_gru(x: Array, hidden: Array, weights: Weights, name: str) -> Array:
    both = np.concatenate([x, hidden])
    update = sigmoid(conv(both, weights, f"{name}.update_gate"))
    reset = sigmoid(conv(both, weights, f"{name}.reset_gate"))
    candidate = np.tanh(conv(np.concatenate([x, hidden * reset]), weights, f"{name}.out_gate"))
    return (1 - update) * hidden + update * candidate


def residual(x: Array, weights: Weights, name: str) -> Array:
    return relu(x + conv(relu(conv(x, weights, f"{name}.conv1")), weights, f"{name}.conv2"))


def e2vid(voxels: Array, weights: Weights, *, encoders: int = 3) -> Array:
    """[T, bins, H, W] -> [T, 1, H, W], zero state at the start."""
    height, width = voxels.shape[-2:]
    voxels = np.pad(voxels, ((0, 0), (0, 0), (0, -height % 16), (0, -width % 16)))
    u = "unetrecurrent"
    states: list[tuple[Array, Array] | None] = [None] * encoders
    pictures = []
    for voxel in voxels:
        head = x = relu(conv(voxel, weights, f"{u}.head.conv2d"))
        skips = []
        for i in range(encoders):
            x = relu(conv(x, weights, f"{u}.encoders.{i}.conv.conv2d", stride=2))
            hidden, cell = states[i] or (np.zeros_like(x), np.zeros_like(x))
            x, cell = conv_lstm(x, hidden, cell, weights, f"{u}.encoders.{i}.recurrent_block")
            states[i] = (x, cell)
            skips.append(x)
        for i in range(2):
            x = residual(x, weights, f"{u}.resblocks.{i}")
        for i in range(encoders):
            x = relu(conv(upsample(x + skips[encoders - 1 - i]), weights, f"{u}.decoders.{i}.conv2d"))
        pictures.append(conv(x + head, weights, f"{u}.pred.conv2d"))
    return np.stack(pictures)[..., :height, :width]


def firenet(voxels: Array, weights: Weights) -> Array:
    """[T, bins, H, W] -> [T, 1, H, W], zero state at the start."""
    first = second = np.zeros((16, *voxels.shape[-2:]))
    pictures = []
    for voxel in voxels:
        x = relu(conv(voxel, weights, "net.head.conv.conv2d"))
        first = conv_gru(x, first, weights, "net.head.recurrent_block")
        x = residual(first, weights, "net.resblocks.0.conv")
        second = conv_gru(x, second, weights, "net.resblocks.0.recurrent_block")
        x = residual(second, weights, "net.resblocks.1")
        pictures.append(conv(x, weights, "net.pred.conv2d"))
    return np.stack(pictures)


def max_pool(x: Array, size: int, *, ceil: bool = False) -> Array:
    """Stride 2, no padding; ``ceil`` also takes a last window that hangs over the edge."""
    channels, *sides = x.shape
    counts = [int(np.ceil((side - size) / 2) if ceil else (side - size) // 2) + 1 for side in sides]
    out = np.empty((channels, *counts))
    for row in range(counts[0]):
        for column in range(counts[1]):
            out[:, row, column] = x[:, 2 * row : 2 * row + size, 2 * column : 2 * column + size].max(axis=(1, 2))
    return out


def vgg_taps(x: Array, w: Weights) -> list[Array]:
    taps, position = [], 0
    for stage, convolutions in enumerate((2, 2, 3, 3, 3)):
        if stage:
            x = max_pool(x, 2)
            position += 1
        for _ in range(convolutions):
            x = relu(conv(x, w, str(position)))
            position += 2
        taps.append(x)
    return taps


def alex_taps(x: Array, w: Weights) -> list[Array]:
    one = relu(conv(x, w, "0", stride=4, padding=2))
    two = relu(conv(max_pool(one, 3), w, "3"))
    three = relu(conv(max_pool(two, 3), w, "6"))
    four = relu(conv(three, w, "8"))
    return [one, two, three, four, relu(conv(four, w, "10"))]


def squeeze_taps(x: Array, w: Weights) -> list[Array]:
    def fire(x: Array, name: str) -> Array:
        x = relu(conv(x, w, f"{name}.squeeze"))
        return relu(np.concatenate([conv(x, w, f"{name}.expand1x1"), conv(x, w, f"{name}.expand3x3")]))

    taps = [relu(conv(x, w, "0", stride=2, padding=0))]
    taps.append(fire(fire(max_pool(taps[-1], 3, ceil=True), "3"), "4"))
    taps.append(fire(fire(max_pool(taps[-1], 3, ceil=True), "6"), "7"))
    taps.append(fire(max_pool(taps[-1], 3, ceil=True), "9"))
    for name in ("10", "11", "12"):
        taps.append(fire(taps[-1], name))
    return taps


TAPS = {"vgg": vgg_taps, "alex": alex_taps, "squeeze": squeeze_taps}


def lpips(net: str, first: Array, second: Array, backbone: Weights, heads: list[Array]) -> float:
    """LPIPS v0.1 of two pictures [1, H, W] in 0 .. 1; ``heads`` [C] per layer."""

    def taps(picture: Array) -> list[Array]:
        shift = np.array([-0.030, -0.088, -0.188])[:, None, None]
        scale = np.array([0.458, 0.448, 0.450])[:, None, None]
        return TAPS[net]((np.repeat(2 * picture - 1, 3, axis=0) - shift) / scale, backbone)

    def unit(features: Array) -> Array:
        return features / (np.sqrt((features**2).sum(axis=0)) + 1e-10)

    return float(
        sum(
            np.tensordot(head, (unit(a) - unit(b)) ** 2, axes=1).mean()
            for a, b, head in zip(taps(first), taps(second), heads, strict=True)
        )
    )


def warp(picture: Array, displacement: Array) -> Array:
    """[H, W] sampled at x + displacement(x), bilinear, 0 outside; pixel by pixel."""
    height, width = picture.shape
    out = np.zeros_like(picture)
    for row in range(height):
        for column in range(width):
            x, y = column + displacement[0, row, column], row + displacement[1, row, column]
            left, top = int(np.floor(x)), int(np.floor(y))
            for r, c in ((top, left), (top, left + 1), (top + 1, left), (top + 1, left + 1)):
                if 0 <= r < height and 0 <= c < width:
                    out[row, column] += (1 - abs(x - c)) * (1 - abs(y - r)) * picture[r, c]
    return out


def temporal_step(
    predicted: tuple[Array, Array], true: tuple[Array, Array], displacement: Array, *, as_published: bool
) -> float:
    """The loss of one step; pictures [H, W] of (t-1, t), displacement [2, H, W] on the grid of t."""
    height, width = true[0].shape
    y, x = np.mgrid[0:height, 0:width] + displacement[::-1]
    mask = np.exp(-50 * (true[1] - warp(true[0], displacement)) ** 2)
    if as_published:
        before = warp(np.clip(predicted[0], 0, 255), displacement)
    else:
        before = warp(predicted[0], displacement)
        mask = mask * ((x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1))
    return float((mask * abs(predicted[1] - before) / (abs(predicted[1]) + abs(before) + 1e-5)).mean())
