"""One step's gradients as a CUDA graph: thousands of kernels are queued by one call instead of one by one.

A graph is a list of kernels with the addresses that they read and write. So a batch is copied to the place of the one
that the graph was recorded with, the graph is replayed, and losses and gradients lie where they lay then. What depends
on numbers of the host is not in it: the optimiser, whose rate changes, and the average of the weights. Flow that the
loss needs is estimated before, and not in it either.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Iterator, Mapping
from typing import Protocol

import torch
from torch import Tensor

from trainer.tasks import Work

WARM_UP_STEPS = 3
"""Steps of a new shape that run as without a graph: libraries choose their kernels and take their memory then."""


class Graph(Protocol):
    """Records what a block queues, without doing it, and does it again and again."""

    def warming_up(self) -> contextlib.AbstractContextManager[object]:
        """A block that does its work, as a preparation for recording it."""

    def recording(self) -> contextlib.AbstractContextManager[object]:
        """A block whose work is recorded."""

    def replay(self) -> None:
        """Queues it."""


class CudaGraph:
    """PyTorch's, see :class:`Graph`."""

    def __init__(self) -> None:
        self._graph = torch.cuda.CUDAGraph()
        self._stream = torch.cuda.Stream()  # type: ignore[no-untyped-call]

    @contextlib.contextmanager
    def warming_up(self) -> Iterator[None]:
        """On a stream of its own, as recording does: the default one cannot be recorded."""
        compute = torch.cuda.current_stream()
        self._stream.wait_stream(compute)
        with torch.cuda.stream(self._stream):
            yield
        compute.wait_stream(self._stream)

    def recording(self) -> contextlib.AbstractContextManager[object]:
        """Other threads, such as one that takes page-locked memory for batches, may go on."""
        return torch.cuda.graph(self._graph, stream=self._stream, capture_error_mode="thread_local")

    def replay(self) -> None:
        self._graph.replay()


class CapturedGradients:
    """Losses of a batch, and gradients in the parameters, from a graph.

    Args:
        compute: from a batch to its losses, all on the device, with gradients beside them; begins with parameters
            without gradients. It reads nothing of the device, and no random numbers but PyTorch's.
        new_graph: makes an empty one.
    """

    def __init__(
        self, compute: Callable[[Work], Mapping[str, Tensor]], new_graph: Callable[[], Graph] = CudaGraph
    ) -> None:
        self._compute = compute
        self._new_graph = new_graph
        self._graph: Graph | None = None
        self._signature: object = None
        self._seen = 0
        self._work: Work | None = None
        self._losses: Mapping[str, Tensor] = {}

    def __call__(self, work: Work) -> dict[str, Tensor]:
        """As ``compute``, and the random numbers are those that it would have drawn."""
        if self._graph is None or _signature(work) != self._signature:
            self._graph, self._signature, self._seen, self._work = self._new_graph(), _signature(work), 0, None
        self._seen += 1
        if self._seen <= WARM_UP_STEPS:
            with self._graph.warming_up():
                return dict(self._compute(work))
        if self._work is None:
            self._work = _copied(work)
            with self._graph.recording():
                self._losses = self._compute(self._work)
        else:
            for mine, theirs in zip(_tensors(self._work), _tensors(work), strict=True):
                mine.copy_(theirs)
        self._graph.replay()
        return {name: value.clone() for name, value in self._losses.items()}


def _tensors(work: Work) -> list[Tensor]:
    guide = [] if work.guide is None else [work.guide.pictures]
    return [work.voxels, *work.truth.values(), *guide]


def _signature(work: Work) -> object:
    """What a graph holds fast: shapes, kinds, and the numbers of the host."""
    share = None if work.guide is None else work.guide.share
    return share, tuple(work.truth), [(tensor.shape, tensor.dtype) for tensor in _tensors(work)]


def _copied(work: Work) -> Work:
    guide = None if work.guide is None else work.guide._replace(pictures=work.guide.pictures.clone())
    truth = {name: tensor.clone() for name, tensor in work.truth.items()}
    return dataclasses.replace(work, voxels=work.voxels.clone(), truth=truth, guide=guide)
