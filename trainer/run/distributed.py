"""Ranks of one training run: started by torchrun, or a single one.

The process group has two backends: NCCL exchanges gradients between GPUs, gloo exchanges what only the CPU knows (does
any rank want to stop?), so that agreeing never waits for a GPU.
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
import torch.distributed.nn.functional  # before a group exists: its functions keep the group of that time as default
from torch import Tensor, distributed

from v2v_protocol.errors import UsageError


@dataclass(frozen=True, slots=True)
class Ranks:
    """This rank and the number of ranks.

    Attributes:
        device: what this rank computes on.
        hosts: number of machines with ranks.
    """

    rank: int
    world_size: int
    device: torch.device
    hosts: int = 1

    @property
    def first(self) -> bool:
        """Return whether this rank writes files and prints."""
        return self.rank == 0

    def any(self, wish: bool) -> bool:
        """Return whether ``wish`` is true on any rank; all ranks call it."""
        if self.world_size == 1:
            return wish
        votes = torch.tensor([int(wish)])
        distributed.all_reduce(votes, distributed.ReduceOp.MAX)
        return bool(votes.item())

    def mean(self, values: Tensor) -> Tensor:
        """Return the mean over the ranks of tensors [...] of equal shape; all ranks call it."""
        if self.world_size == 1:
            return values
        values = values.clone()
        distributed.all_reduce(values)
        return values / self.world_size

    def from_first(self, value: Any) -> Any:
        """Return the value (a plain one) of the first rank; all ranks call it."""
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
        """Overwrite tensors [...] with those of the first rank; all ranks call it with equally many of equal shapes."""
        if self.world_size > 1:
            for tensor in tensors:
                dense = tensor.contiguous()  # exchanges refuse other memory formats
                distributed.broadcast(dense, src=0)
                tensor.copy_(dense)


def on_gpu(device: str) -> bool:
    """Return whether ``compute.device`` = ``device`` is a GPU here."""
    return device != "cpu" and torch.cuda.is_available() and torch.cuda.device_count() > 0


@contextmanager
def ranks(device: str, timeout_seconds: float) -> Iterator[Ranks]:
    """Yield this process's rank, from the variables that torchrun sets.

    All references to the group, such as a DistributedDataParallel, must be out of scope at the end of the block,
    because they keep it alive.

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
    # The group's threads need the interpreter to free the tensors of the last exchange. A thread that does so while the
    # interpreter exits aborts the process ("terminate called without an active exception"). So the group must be gone,
    # and its threads joined, before that. Models are in reference cycles, which only a collection frees.
    gc.collect()
    # Not after an error: NCCL would wait for ranks that wait for this one, before the error is printed. A process that
    # exits leaves the group by itself, at worst with the abort above, after its error is printed.
    distributed.destroy_process_group()
