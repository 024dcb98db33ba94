"""Define the layers of the recurrent reconstruction networks, which process a whole sequence at once.

Only the recurrence itself loops over time. Everything else (convolutions, residual blocks, upsampling, and the half of
every gate convolution that sees the input) has no memory, so it runs once on all T x B frames. The arithmetic is that
of a loop over t, with one large convolution in place of T small ones.

Shapes: a *sequence* is [T*B, C, H, W], time-major (frame t of batch entry b at row t*B + b), so that the frames of one
time step are contiguous in either memory format. Attribute names are those of the published state dicts.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F


class LSTMState(NamedTuple):
    """Hold the memory of a :class:`ConvLSTM`: ``hidden`` in the convolutions' dtype, ``cell`` in float32 or wider."""

    hidden: Tensor
    cell: Tensor


class ConvLayer(nn.Module):
    """Apply a convolution of odd kernel size with "same" padding, optional batch norm, optional ReLU."""

    def __init__(
        self, inputs: int, outputs: int, kernel_size: int, *, stride: int = 1, relu: bool = True, norm: bool = False
    ) -> None:
        super().__init__()
        self.conv2d = nn.Conv2d(inputs, outputs, kernel_size, stride, kernel_size // 2, bias=not norm)
        if norm:
            self.norm_layer = nn.BatchNorm2d(outputs)
        self.norm = norm
        self.relu = relu

    def forward(self, x: Tensor) -> Tensor:
        """Apply the layer to a sequence [T*B, C, H, W]."""
        x = self.conv2d(x)
        if self.norm:
            x = self.norm_layer(x)
        return F.relu(x) if self.relu else x


class UpsampleConvLayer(ConvLayer):
    """Apply bilinear upsampling by 2 (``align_corners=False``), then :class:`ConvLayer`."""

    def forward(self, x: Tensor) -> Tensor:
        """Apply the layer to a sequence [T*B, C, H, W]; the result has [T*B, C', 2 H, 2 W]."""
        return super().forward(F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=False))


class TransposedConvLayer(nn.Module):
    """Apply a transposed convolution that doubles height and width, optional batch norm, ReLU."""

    def __init__(self, inputs: int, outputs: int, kernel_size: int, *, norm: bool = False) -> None:
        super().__init__()
        self.transposed_conv2d = nn.ConvTranspose2d(
            inputs, outputs, kernel_size, stride=2, padding=kernel_size // 2, output_padding=1, bias=not norm
        )
        if norm:
            self.norm_layer = nn.BatchNorm2d(outputs)
        self.norm = norm

    def forward(self, x: Tensor) -> Tensor:
        """Apply the layer to a sequence [T*B, C, H, W]; the result has [T*B, C', 2 H, 2 W]."""
        x = self.transposed_conv2d(x)
        return F.relu(self.norm_layer(x) if self.norm else x)


class ResidualBlock(nn.Module):
    """Compute ReLU(x + conv3(ReLU(conv3(x)))), with optional batch norm after each convolution."""

    def __init__(self, channels: int, *, norm: bool = False) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(channels, channels, 3, padding=1, bias=not norm)
        self.conv2 = nn.Conv2d(channels, channels, 3, padding=1, bias=not norm)
        if norm:
            self.bn1 = nn.BatchNorm2d(channels)
            self.bn2 = nn.BatchNorm2d(channels)
        self.norm = norm

    def forward(self, x: Tensor) -> Tensor:
        """Apply the block to a sequence [T*B, C, H, W]."""
        out = self.conv1(x)
        out = F.relu(self.bn1(out) if self.norm else out)
        out = self.conv2(out)
        return F.relu((self.bn2(out) if self.norm else out) + x)


def _split(weight: Tensor, channels: int) -> tuple[Tensor, Tensor]:
    """Split a convolution's weight into the part for the input and the part for the hidden state.

    Both are made contiguous here, in the memory format of the whole, because otherwise the convolution of every time
    step would copy them.
    """
    last = weight.is_contiguous(memory_format=torch.channels_last) and not weight.is_contiguous()
    memory_format = torch.channels_last if last else torch.contiguous_format
    from_input, from_hidden = torch.split(weight, [weight.shape[1] - channels, channels], dim=1)
    return from_input.contiguous(memory_format=memory_format), from_hidden.contiguous(memory_format=memory_format)


def _by_step(sequence: Tensor, steps: int) -> tuple[Tensor, ...]:
    """Split [T*B, C, H, W] into T views [B, C, H, W]."""
    # One unbind, not T indexings: its gradient is a single stack, theirs would be a sum of T tensors of mostly zeros.
    return torch.unflatten(sequence, 0, (steps, -1)).unbind(0)


class Loop:
    """Let a module compile one iteration of its loop over time, or over refinements of an estimate.

    Compiling one iteration takes seconds; compiling the unrolled loop takes minutes. A subclass implements ``_turn``,
    one iteration.
    """

    training: bool
    _turn: Callable[..., Any]
    _compiled: Callable[..., Any] | None = None

    @property
    def turn(self) -> Callable[..., Any]:
        """Return ``_turn``, or in training its compiled form if :meth:`compile_turn` was called."""
        return self._compiled if self._compiled is not None and self.training else self._turn

    def compile_turn(self) -> None:
        """Compile :attr:`turn` in training. It is compiled when it is first called with tensors of new shapes."""
        self._compiled = torch.compile(self._turn, dynamic=False, fullgraph=True)


class ConvLSTM(Loop, nn.Module):
    """Apply a convolutional LSTM: kernel 3, hidden channels = input channels; gate order in, forget, out, candidate.

    c_t = sigmoid(f) c_(t-1) + sigmoid(i) tanh(g),    h_t = sigmoid(o) tanh(c_t)     (Shi et al. 2015, no peepholes)
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.channels = channels
        self.Gates = nn.Conv2d(2 * channels, 4 * channels, 3, padding=1)

    def forward(self, x: Tensor, state: LSTMState | None, steps: int) -> tuple[Tensor, LSTMState]:
        """Run the recurrence over a sequence.

        Args:
            x: sequence [T*B, C, H, W].
            state: memory before the first step, each [B, C, H, W]; None means zeros.
            steps: T.

        Returns:
            The hidden states [T*B, C, H, W], and the memory after the last step.
        """
        to_input, to_hidden = _split(self.Gates.weight, self.channels)
        from_input = _by_step(F.conv2d(x, to_input, self.Gates.bias, padding=1), steps)
        hiddens: list[Tensor] = []
        for gates in from_input:
            state = LSTMState(*self.turn(gates, state, to_hidden))
            hiddens.append(state.hidden)
        assert state is not None
        return torch.cat(hiddens), state

    @staticmethod
    def _turn(gates: Tensor, state: LSTMState | None, to_hidden: Tensor) -> tuple[Tensor, Tensor]:
        if state is not None:
            gates = gates + F.conv2d(state.hidden, to_hidden, padding=1)
        channels = gates.shape[1] // 4
        switches, candidate = torch.split(gates, [3 * channels, channels], dim=1)
        admit, keep, emit = switches.sigmoid().chunk(3, dim=1)
        # In float32 even under autocast: the cell is a running sum, and a bfloat16 sum loses small increments.
        cell = (admit * candidate.tanh()).to(torch.promote_types(gates.dtype, torch.float32))
        if state is not None:
            cell = cell + keep * state.cell
        return (emit * cell.tanh()).to(gates.dtype), cell


class ConvGRU(Loop, nn.Module):
    """Apply a convolutional GRU: kernel 3, hidden channels = input channels (Ballas et al. 2016).

    u, r = sigmoid(conv([x, h])),    n = tanh(conv([x, r h])),    h' = (1 - u) h + u n
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.channels = channels
        self.reset_gate = nn.Conv2d(2 * channels, channels, 3, padding=1)
        self.update_gate = nn.Conv2d(2 * channels, channels, 3, padding=1)
        self.out_gate = nn.Conv2d(2 * channels, channels, 3, padding=1)
        for gate in (self.reset_gate, self.update_gate, self.out_gate):
            nn.init.orthogonal_(gate.weight)
            nn.init.zeros_(gate.bias)  # type: ignore[arg-type]

    def forward(self, x: Tensor, state: Tensor | None, steps: int) -> tuple[Tensor, Tensor]:
        """Run the recurrence as :meth:`ConvLSTM.forward`. The state is the hidden state alone, in float32 or wider."""
        gates = (self.update_gate, self.reset_gate, self.out_gate)
        to_input, to_hidden = zip(*(_split(gate.weight, self.channels) for gate in gates), strict=True)
        bias = torch.cat([gate.bias for gate in gates])  # type: ignore[misc]
        to_switches = torch.cat(to_hidden[:2])
        from_input = _by_step(F.conv2d(x, torch.cat(to_input), bias, padding=1), steps)
        hiddens: list[Tensor] = []
        for now in from_input:
            state = self.turn(now, state, to_switches, to_hidden[2])
            hiddens.append(state.to(now.dtype))
        assert state is not None
        return torch.cat(hiddens), state

    @staticmethod
    def _turn(now: Tensor, state: Tensor | None, to_switches: Tensor, to_candidate: Tensor) -> Tensor:
        channels = now.shape[1] // 3
        switches, candidate = torch.split(now, [2 * channels, channels], dim=1)
        if state is not None:
            switches = switches + F.conv2d(state.to(now.dtype), to_switches, padding=1)
        update, reset = switches.sigmoid().chunk(2, dim=1)
        if state is not None:
            candidate = candidate + F.conv2d((state * reset).to(now.dtype), to_candidate, padding=1)
        target = candidate.tanh().to(torch.promote_types(now.dtype, torch.float32))
        return update * target if state is None else state + update * (target - state)


class RecurrentLayer(nn.Module):
    """Apply a layer without memory, then a recurrent one."""

    def __init__(self, conv: nn.Module, recurrent_block: nn.Module) -> None:
        super().__init__()
        self.conv = conv
        self.recurrent_block = recurrent_block

    def forward(self, x: Tensor, state: Any, steps: int) -> tuple[Tensor, Any]:
        """Run both layers as :meth:`ConvLSTM.forward`, with the state of the recurrent block."""
        hiddens, state = self.recurrent_block(self.conv(x), state, steps)
        return hiddens, state
