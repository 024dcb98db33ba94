"""Export the weights of a checkpoint to a small file for v2v-eval and ``network.weights``.

    python -m trainer.run.export runs/firenet-cpu/last.pt firenet.pt

If the run has averaged weights, it exports these. The weights of several checkpoints, of runs that began with the same
weights, are averaged (Wortsman et al., "Model soups", ICML 2022).
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from trainer.run.checkpoint import load_checkpoint, save_atomically
from v2v_protocol.command import Parser, run_command
from v2v_protocol.errors import UsageError


def export(checkpoints: Sequence[Path], file: Path) -> int:
    """Write ``file``; return the number of steps that its weights were trained for, in all runs.

    Raises:
        UsageError: no such checkpoint, not one of a training run, or of another network than the first; or ``file``
            cannot be written.
    """
    if file.resolve() in {checkpoint.resolve() for checkpoint in checkpoints}:
        raise UsageError(f"{file}: it is one of the checkpoints; give another FILE")
    steps, networks, weights = 0, [], []
    for checkpoint in checkpoints:
        found = load_checkpoint(checkpoint)
        steps += found.step
        networks.append({key: found.config["network"][key] for key in ("name", "options")})
        weights.append(found.ema or found.model)
        if networks[-1] != networks[0]:
            raise UsageError(f"{checkpoint} is of {networks[-1]}, {checkpoints[0]} of {networks[0]}: give one network")
    state = {name: _mean([each[name] for each in weights]) for name in weights[0]}
    try:
        save_atomically(file, {"state_dict": state, "config": {"network": networks[0]}})
    except OSError as error:
        raise UsageError(f"{file}: {error.strerror or error}; give another FILE, or free space there") from error
    return steps


def _mean(tensors: Sequence[Tensor]) -> Tensor:
    if len(tensors) == 1 or not tensors[0].is_floating_point():
        return tensors[0]  # a counter has no average
    return torch.stack([tensor.double() for tensor in tensors]).mean(0).to(tensors[0].dtype)


def _run(asked: argparse.Namespace) -> int:
    steps = export(asked.checkpoints, asked.file)
    print(f"{asked.file}: {asked.file.stat().st_size / 1e3:.0f} kB, trained for {steps} steps")
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    name = "python -m trainer.run.export"
    said = "Write the weights of a checkpoint alone, or the mean of several."
    parser = Parser(name, "CHECKPOINT... FILE", said, [f"{name} last.pt firenet.pt", f"{name} a.pt b.pt mean.pt"])
    parser.add_argument("checkpoints", type=Path, nargs="+")
    parser.add_argument("file", type=Path)
    return run_command(parser, _run, arguments)


if __name__ == "__main__":
    sys.exit(main())
