"""Record the output of torchvision's RAFT for the pictures of ``raft_pairs.py``, so that tests do not need torchvision.

    python -m tests.trainer.models.record_raft raft-small_princeton.pth tests/trainer/raft_torchvision.npz

torchvision's compiled part needs a CUDA build of torch; its models do not. Recorded with torchvision 0.28.0.
"""

from __future__ import annotations

import sys

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from tests.trainer.models.raft_pairs import SAMPLED, formula_weights, pictures


def torchvision_networks() -> dict[str, torch.nn.Module]:
    """Return torchvision's two networks, without weights."""
    library = torch.library.Library("torchvision", "DEF")
    for operator in ("nms", "qnms"):
        library.define(f"{operator}(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
    from torchvision.models import optical_flow  # type: ignore[import-not-found]

    return {
        "small": optical_flow.raft_small(weights=None).eval(),
        "large": optical_flow.raft_large(weights=None).eval(),
    }


@torch.no_grad()
def flow(network: torch.nn.Module, first: Tensor, second: Tensor) -> np.ndarray:
    """Return the last prediction, cropped to the pictures' size and subsampled."""
    height, width = first.shape[2:]

    def prepared(frames: Tensor) -> Tensor:
        frames = (2 * frames - 1).repeat(1, 3, 1, 1)
        return functional.pad(frames, (0, -width % 8, 0, -height % 8), value=0.0)

    last: Tensor = network(prepared(first), prepared(second))[-1]
    return last[:, :, :height, :width][SAMPLED].numpy()


def main(weights: str, out: str) -> None:
    networks = torchvision_networks()
    first, second = pictures()
    recorded = {}
    for name, network in networks.items():
        network.load_state_dict(formula_weights(network.state_dict()))
        recorded[f"{name}_formula"] = flow(network, first, second)
    # The authors' entries stand in the same order as torchvision's.
    published = torch.load(weights, map_location="cpu", weights_only=True)
    small = networks["small"]
    small.load_state_dict(dict(zip(small.state_dict(), published.values(), strict=True)))
    recorded["small_published"] = flow(small, first, second)
    np.savez_compressed(out, **recorded)
    for name, value in recorded.items():
        print(name, value.shape, float(np.abs(value).max()))


if __name__ == "__main__":
    main(*sys.argv[1:])
