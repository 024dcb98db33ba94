"""One step's gradients as a CUDA graph: one call queues thousands of kernels.

A graph is a list of kernels with the addresses that they read and write. So each batch is copied to the memory of the
batch with which the graph was recorded, the graph is replayed, and losses and gradients are at the same addresses. The
optimiser and the average of the weights depend on numbers of the host, so they are not in the graph. Flow for the loss
is estimated before it.
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
"""Steps of a new shape that run without a graph, in which libraries choose kernels and allocate memory."""


class Graph(Protocol):
    """Records the work that a block queues, without running it, and replays it."""

    def warming_up(self) -> contextlib.AbstractContextManager[object]:
        """Return a context whose work runs, as a preparation for recording it."""

    def recording(self) -> contextlib.AbstractContextManager[object]:
        """Return a context whose work is recorded."""

    def replay(self) -> None:
        """Queue the recorded work."""


class CudaGraph:
    """PyTorch's, see :class:`Graph`."""

    def __init__(self) -> None:
        self._graph = torch.cuda.CUDAGraph()
        self._stream = torch.cuda.Stream()  # type: ignore[no-untyped-call]

    @contextlib.contextmanager
    def warming_up(self) -> Iterator[None]:
        """Use the stream of the recording: the default stream cannot be recorded."""
        compute = torch.cuda.current_stream()
        self._stream.wait_stream(compute)
        with torch.cuda.stream(self._stream):
            yield
        compute.wait_stream(self._stream)

    def recording(self) -> contextlib.AbstractContextManager[object]:
        """Record this thread alone: others, such as one that page-locks batches, continue."""
        return torch.cuda.graph(self._graph, stream=self._stream, capture_error_mode="thread_local")

    def replay(self) -> None:
        self._graph.replay()


class CapturedGradients:
    """Computes the losses of a batch, and gradients in the parameters, with a graph.

    Args:
        compute: returns the losses of a batch, on the device, and sets the gradients of parameters that have none. It
            copies nothing to the host, and takes random numbers from PyTorch only.
        new_graph: makes an empty graph.
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
        """Return what ``compute`` returns, with the same random numbers."""
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
    """Return what a graph keeps constant: shapes, dtypes, and the numbers of the host."""
    share = None if work.guide is None else work.guide.share
    return share, tuple(work.truth), [(tensor.shape, tensor.dtype) for tensor in _tensors(work)]


def _copied(work: Work) -> Work:
    guide = None if work.guide is None else work.guide._replace(pictures=work.guide.pictures.clone())
    truth = {name: tensor.clone() for name, tensor in work.truth.items()}
    return dataclasses.replace(work, voxels=work.voxels.clone(), truth=truth, guide=guide)
