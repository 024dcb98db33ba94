"""Ask PyTorch for the rank of this process."""

from __future__ import annotations

import torch.distributed


def distributed_rank() -> tuple[int, int] | None:
    """Return (rank, world size) of the default process group; None if there is none."""
    if torch.distributed.is_available() and torch.distributed.is_initialized():
        return torch.distributed.get_rank(), torch.distributed.get_world_size()
    return None
