"""Export a network: its weights alone, for v2v-eval and ``network.weights``, or as ONNX, for other runtimes.

    v2v-train export runs/firenet-cpu/last.pt firenet.pt
    v2v-train export --onnx --size 346x260 firenet.pt firenet.onnx

If the run has averaged weights, it exports these.
"""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils import _pytree

from trainer.models import VoxelNetwork
from trainer.run.checkpoint import load_checkpoint, save_atomically
from trainer.weights import load_network
from v2v_protocol.command import Parser, run_command
from v2v_protocol.errors import UsageError
from v2v_protocol.write_aside import write_aside_and_rename
from v2v_recordings.items import SensorSize

ONNX_NETWORKS = ("firenet", "e2vid", "evflownet")
"""Networks whose export is compared with PyTorch."""


def export(checkpoint: Path, file: Path) -> int:
    """Write ``file``; return the number of steps that its weights were trained for.

    Raises:
        UsageError: no such checkpoint, or not one of a training run; or ``file`` cannot be written.
    """
    found = load_checkpoint(checkpoint)
    network = {key: found.config["network"][key] for key in ("name", "options")}
    try:
        save_atomically(file, {"state_dict": found.ema or found.model, "config": {"network": network}})
    except OSError as error:
        raise UsageError(f"{file}: {error.strerror or error}; give another FILE, or free space there") from error
    return found.step


class _OneGrid(nn.Module):
    """Map a voxel grid and the memory, tensor by tensor, to the output and the memory after it."""

    def __init__(self, network: VoxelNetwork, memory: _pytree.TreeSpec) -> None:
        super().__init__()
        self.network = network
        self._memory = memory

    def forward(self, voxels: Tensor, *state: Tensor) -> tuple[Tensor, ...]:
        outputs, after = self.network(voxels[:, None], _pytree.tree_unflatten(state, self._memory))
        return (outputs[:, 0], *_pytree.tree_leaves(after))


def export_onnx(weights: Path, file: Path, size: SensorSize) -> list[str]:
    """Write a network as ONNX, for one voxel grid at a time; return the names of its inputs.

    Inputs are ``voxels``, float32 [1, bins, H, W], not normalised, and the memory, ``state_0`` and on, zeros at the
    start of a sequence. Outputs are ``picture``, [1, 1, H, W], nominally in 0 .. 1, or ``flow``, [1, 2, H, W], px; and
    the memory after the grid, ``next_0`` and on, in the order of the inputs.

    Args:
        weights: a checkpoint, or any file of weights that ``v2v-eval`` takes.
        size: of the voxel grids; it is fixed in the file.

    Raises:
        UsageError: the file holds none of :data:`ONNX_NETWORKS`, a package is missing, or ``file`` cannot be written.
    """
    try:
        network, name = load_network(weights, ema=True)
    except UsageError:
        network, name = load_network(weights)
    if name not in ONNX_NETWORKS:
        raise UsageError(f"{weights}: --onnx exports {', '.join(ONNX_NETWORKS)}, and this is {name}")
    voxels = torch.zeros(1, network.bins, size.height, size.width)
    with torch.no_grad():
        leaves, memory = _pytree.tree_flatten(network(voxels[:, None])[1])
    inputs = ["voxels", *(f"state_{number}" for number in range(len(leaves)))]
    outputs = ["flow" if network.task == "flow" else "picture", *(f"next_{number}" for number in range(len(leaves)))]
    logging.getLogger("torch.onnx").setLevel(
        logging.ERROR
    )  # it warns that torchvision is missing, which no layer needs
    given: Any = (voxels, *map(torch.zeros_like, leaves))
    try:
        program = torch.onnx.export(
            _OneGrid(network, memory).eval(),
            given,
            input_names=inputs,
            output_names=outputs,
            dynamo=True,
            verbose=False,
        )
        assert program is not None
        with write_aside_and_rename(file) as partial:
            program.save(partial)
    except ImportError as error:
        raise UsageError(f"--onnx needs two packages: pip install onnx onnxscript ({error})") from error
    except OSError as error:
        raise UsageError(f"{file}: {error.strerror or error}; give another FILE, or free space there") from error
    return inputs


def _run(asked: argparse.Namespace) -> int:
    if asked.file.resolve() == asked.checkpoint.resolve():
        raise UsageError(f"{asked.file}: it is the checkpoint; give another FILE")
    if asked.onnx:
        names = export_onnx(asked.checkpoint, asked.file, SensorSize.parse(asked.size))
        said = f"one voxel grid of {asked.size} at a time; inputs {', '.join(names)}"
    else:
        said = f"trained for {export(asked.checkpoint, asked.file)} steps"
    print(f"{asked.file}: {asked.file.stat().st_size / 1e3:.0f} kB, {said}")
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line."""
    name = "v2v-train export"
    said = "Write the weights of a checkpoint alone, or its network as ONNX."
    examples = [f"{name} runs/e2vid/last.pt e2vid.pt", f"{name} --onnx --size 346x260 e2vid.pt e2vid.onnx"]
    parser = Parser(name, "CHECKPOINT FILE [flags]", said, examples)
    parser.add_argument("checkpoint", type=Path, help="of v2v-train; with --onnx, any file of weights")
    parser.add_argument("file", type=Path, help="file to write")
    parser.add_argument("--onnx", action="store_true", help=f"write ONNX, of {', '.join(ONNX_NETWORKS)}")
    parser.add_argument(
        "--size", default="346x260", metavar="WxH", help="size of the voxel grids of --onnx, px (default 346x260)"
    )
    return run_command(parser, _run, arguments)


if __name__ == "__main__":
    sys.exit(main())
