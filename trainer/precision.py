"""How exactly products are computed: IEEE's float32 for all that is scored, and bfloat16 that adds up in float32.

bfloat16: weights are cast once, and their gradients are not added up in bfloat16.

Autocast by itself has the choice of two evils for a weight that one forward pass uses many times, as a loop over time
or over E-RAFT's updates does. It keeps the cast copy, and then the gradients of all uses are added up in the eight bits
of bfloat16, where a sum stops growing at 256 times what is added. Or it casts anew for every use.
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
"""What autocast computes in bfloat16 from (input, weight, bias)."""


@contextlib.contextmanager
def bfloat16_products(device: torch.device, *, enabled: bool, share: bool = True) -> Iterator[None]:
    """Autocast for one forward pass.

    Args:
        device: where it computes.
        enabled: False leaves everything as it is.
        share: False casts weights for every use: for code that ``torch.compile`` traces, which finds equal casts.
    """
    with contextlib.ExitStack() as stack:
        stack.enter_context(torch.autocast(device.type, torch.bfloat16, enabled=enabled, cache_enabled=False))
        if enabled and share:
            stack.enter_context(_SharedWeights(device.type))
        yield


@contextlib.contextmanager
def ieee_products() -> Iterator[None]:
    """Products of float32 are IEEE's on a GPU, whatever a training outside allows itself ("tf32"): for scores."""
    before = torch.backends.cuda.matmul.allow_tf32, torch.backends.cudnn.allow_tf32
    torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = False
    try:
        yield
    finally:
        torch.backends.cuda.matmul.allow_tf32, torch.backends.cudnn.allow_tf32 = before


class _SharedWeights(TorchFunctionMode):
    """Gives products one cast copy of each weight and bias, and every use of it a gradient in float32."""

    def __init__(self, device: str) -> None:
        super().__init__()
        self._device = device
        self._copies: dict[int, tuple[Tensor, Tensor]] = {}  # by id of the original, which must live as long

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
    """One use of a copy, which is a use of the original for its gradient."""

    @staticmethod
    def forward(_context: Any, _original: Tensor, copy: Tensor) -> Tensor:
        return copy.detach()

    @staticmethod
    def backward(_context: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        return gradients[0].float(), None
