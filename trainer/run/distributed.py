"""Ranks of one training run: started by torchrun, or one alone.

A process group of two backends: NCCL moves gradients between GPUs, gloo moves the small words that only the CPU knows
(does any rank want to stop?), so that agreeing never waits for a GPU.
"""

from __future__ import annotations

import gc
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from typing import Any

import torch
import torch.distributed.nn.functional  # before there is a group: its functions keep the one of then as their default
from torch import Tensor, distributed

from v2v_protocol.errors import UsageError


@dataclass(frozen=True, slots=True)
class Ranks:
    """This process among its siblings.

    Attributes:
        rank, world_size: which of how many.
        device: what this rank computes on.
        hosts: on how many machines they run.
    """

    rank: int
    world_size: int
    device: torch.device
    hosts: int = 1

    @property
    def first(self) -> bool:
        """The rank that writes files and speaks."""
        return self.rank == 0

    def any(self, wish: bool) -> bool:
        """Whether any rank wishes it; all must ask."""
        if self.world_size == 1:
            return wish
        votes = torch.tensor([int(wish)])
        distributed.all_reduce(votes, distributed.ReduceOp.MAX)
        return bool(votes.item())

    def mean(self, values: Tensor) -> Tensor:
        """The mean over the ranks; all must ask."""
        if self.world_size == 1:
            return values
        values = values.clone()
        distributed.all_reduce(values)
        return values / self.world_size

    def from_first(self, value: Any) -> Any:
        """What the first rank gave (a plain value); all must ask."""
        if self.world_size == 1:
            return value
        carrier = [value]
        distributed.broadcast_object_list(carrier, src=0, device=torch.device("cpu"))
        return carrier[0]

    def gather(self, value: Any) -> list[Any]:
        """Return the values (plain ones) of all ranks, in their order; all ranks call it."""
        if self.world_size == 1:
            return [value]
        values: list[Any] = [None] * self.world_size
        distributed.all_gather_object(values, value)
        return values

    def copy_from_first(self, tensors: Iterable[Tensor]) -> None:
        """Overwrite tensors with those of the first rank; all ranks call it with equally many of equal shapes."""
        if self.world_size > 1:
            for tensor in tensors:
                dense = tensor.contiguous()  # exchanges refuse other memory formats
                distributed.broadcast(dense, src=0)
                tensor.copy_(dense)


def on_gpu(device: str) -> bool:
    """Whether ``compute.device`` = ``device`` is a GPU here."""
    return device != "cpu" and torch.cuda.is_available() and torch.cuda.device_count() > 0


@contextmanager
def ranks(device: str, timeout_seconds: float) -> Iterator[Ranks]:
    """This process's place, from the variables that torchrun sets.

    Whatever knows the group (a DistributedDataParallel above all) must be out of scope at the end of the block: the
    group ends with the last that knows it, not before.

    Args:
        device: "auto", "cpu" or "cuda".
        timeout_seconds: time that a rank waits for the others in one exchange before it raises.

    Raises:
        UsageError: "cuda" without a GPU, or more ranks on this host than GPUs.
    """
    with_gpu = on_gpu(device)
    if device == "cuda" and not with_gpu:
        raise UsageError("compute.device = cuda: PyTorch sees no GPU here; give cpu or auto")
    gpus = torch.cuda.device_count() if with_gpu else 0
    world_size = int(os.environ.get("WORLD_SIZE", "1"))
    local_rank = int(os.environ.get("LOCAL_RANK", "0"))
    here = int(os.environ.get("LOCAL_WORLD_SIZE", str(world_size)))
    if with_gpu and here > gpus:
        raise UsageError(f"{here} ranks on this host, but {gpus} GPUs: start one rank per GPU, or compute.device=cpu")
    mine = torch.device("cuda", local_rank) if with_gpu else torch.device("cpu")
    if with_gpu:
        torch.cuda.set_device(mine)
    if world_size == 1:
        yield Ranks(0, 1, mine)
        return
    distributed.init_process_group(
        "cpu:gloo,cuda:nccl" if with_gpu else "gloo", timeout=timedelta(seconds=timeout_seconds)
    )
    yield Ranks(distributed.get_rank(), world_size, mine, hosts=-(-world_size // here))
    # The group's threads free the tensors of the last exchange, for which they need the interpreter. One that is late
    # and finds it ending aborts the process ("terminate called without an active exception"). So the group must be
    # gone, and its threads joined, before that: models lie in reference cycles, which only a collection ends.
    gc.collect()
    # Not on the way out of an error: NCCL would wait for ranks that wait for this one, and nobody would read the error.
    # A process that ends leaves the group by itself, at worst by the abort of above, after its error was said.
    distributed.destroy_process_group()
