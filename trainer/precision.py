"""The precision of products: IEEE float32 for scores, and bfloat16 whose gradients are summed in float32.

A loop over time, or over E-RAFT's updates, uses a weight many times in one forward pass. Autocast offers two ways, both
bad. With its cache, it sums the gradients of all uses in the eight bits of bfloat16, where a sum stops growing at 256
times the summand. Without it, it casts the weight for every use. Here each weight is cast once, and its gradients are
summed in float32.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F
from torch.overrides import TorchFunctionMode

_PRODUCTS = frozenset({F.conv1d, F.conv2d, F.conv_transpose2d, F.linear})
"""Functions of (input, weight, bias) that autocast computes in bfloat16."""


@contextlib.contextmanager
def bfloat16_products(device: torch.device, *, enabled: bool, share: bool = True) -> Iterator[None]:
    """Run one forward pass under autocast.

    Args:
        enabled: False changes nothing.
        share: False casts weights for every use: for code that ``torch.compile`` traces, which merges equal casts.
    """
    with contextlib.ExitStack() as stack:
        stack.enter_context(torch.autocast(device.type, torch.bfloat16, enabled=enabled, cache_enabled=False))
        if enabled and share:
            stack.enter_context(_SharedWeights(device.type))
        yield


@contextlib.contextmanager
def ieee_products() -> Iterator[None]:
    """Compute float32 products as IEEE on a GPU, also within a training with "tf32": for scores."""
    before = torch.backends.cuda.matmul.allow_tf32, torch.backends.cudnn.allow_tf32
    torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = False
    try:
        yield
    finally:
        torch.backends.cuda.matmul.allow_tf32, torch.backends.cudnn.allow_tf32 = before


class _SharedWeights(TorchFunctionMode):
    """Casts each weight and bias once for all products, and gives each use a float32 gradient."""

    def __init__(self, device: str) -> None:
        super().__init__()
        self._device = device
        self._copies: dict[int, tuple[Tensor, Tensor]] = {}  # by id of the original, which is kept alive

    def __torch_function__(
        self,
        function: Callable[..., Any],
        _types: Sequence[type],
        arguments: Sequence[Any] = (),
        named: Mapping[str, Any] | None = None,
    ) -> Any:
        if function in _PRODUCTS and torch.is_autocast_enabled(self._device):
            arguments = [arguments[0], *(self._lowered(each) for each in arguments[1:])]
            named = {name: self._lowered(each) for name, each in (named or {}).items()}
        return function(*arguments, **(named or {}))

    def _lowered(self, value: Any) -> Any:
        if not isinstance(value, Tensor) or value.dtype != torch.float32:
            return value
        if id(value) not in self._copies:
            self._copies[id(value)] = value, value.detach().to(torch.bfloat16)
        return _Use.apply(value, self._copies[id(value)][1])  # type: ignore[no-untyped-call]


class _Use(torch.autograd.Function):
    """One use of a cast copy, whose gradient goes to the original."""

    @staticmethod
    def forward(_context: Any, _original: Tensor, copy: Tensor) -> Tensor:
        return copy.detach()

    @staticmethod
    def backward(_context: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        return gradients[0].float(), None
