"""The methods by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType

import numpy as np

from v2v_protocol.errors import UsageError
from v2v_server.flow import deepflow, dis, farneback, sparse
from v2v_server.flow.estimator import Estimator, Field, Picture, guarded


@dataclass(frozen=True, slots=True)
class Method:
    """One way to estimate flow.

    Attributes:
        create: makes an estimator; it holds buffers, so each thread needs its own.
        smallest_side_px: pictures with a smaller side are enlarged first.
    """

    create: Callable[[], Estimator]
    smallest_side_px: int = 1

    def estimator(self) -> Estimator:
        """A new estimator, guarded."""
        return guarded(self.create(), self.smallest_side_px)


def _zero() -> Estimator:
    def estimate(first: Picture, second: Picture) -> Field:
        return np.zeros((*first.shape, 2), np.float32)

    return estimate


def _dis(preset: int, finest_scale: int, patch_stride_px: int | None = None, refinements: int | None = None) -> Method:
    return Method(partial(dis.dis, preset, finest_scale, patch_stride_px, refinements), dis.SMALLEST_SIDE_PX)


METHODS: Mapping[str, Method] = MappingProxyType(
    {
        "zero": Method(_zero),
        "dis-ultrafast": _dis(dis.ULTRAFAST, 2),
        "dis-ultrafast-1": _dis(dis.ULTRAFAST, 1),
        "dis-fast": _dis(dis.FAST, 2),
        "dis-fast-lean": _dis(dis.FAST, 2, None, 3),
        "dis-fast-1": _dis(dis.FAST, 1),
        "dis-fast-1-stride-6": _dis(dis.FAST, 1, 6),
        "dis-medium": _dis(dis.MEDIUM, 1),
        "dis-medium-0": _dis(dis.MEDIUM, 0),
        "farneback": Method(farneback.farneback, farneback.SMALLEST_SIDE_PX),
        "sparse-to-dense": Method(sparse.sparse_to_dense, sparse.SMALLEST_SIDE_PX),
        "deepflow": Method(deepflow.deepflow, deepflow.SMALLEST_SIDE_PX),
    }
)
"""Every method. The number behind a preset of dense inverse search is its finest scale where that is not OpenCV's."""


def method(name: str) -> Method:
    """The method of that name.

    Raises:
        UsageError: no such method; the message lists them.
    """
    if name not in METHODS:
        raise UsageError(f"flow method {name!r}: choose one of {', '.join(METHODS)}")
    return METHODS[name]
