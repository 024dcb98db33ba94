"""The weights of a checkpoint alone, to be given to others: a small file that v2v-eval and ``network.weights`` take.

    python -m trainer.run.export runs/firenet-cpu/last.pt firenet.pt

The averaged weights where the run has them.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import torch

from trainer.run.checkpoint import load_checkpoint, replacing
from v2v_protocol.command import Parser, run_command


def export(checkpoint: Path, file: Path) -> int:
    """Writes ``file``; returns the steps that its weights were trained for.

    Raises:
        UsageError: no such checkpoint, or none of a training run.
        OSError: the disk refused.
    """
    found = load_checkpoint(checkpoint)
    network = {key: found.config["network"][key] for key in ("name", "options")}
    with replacing(file) as out:
        torch.save({"state_dict": dict(found.ema or found.model), "config": {"network": network}}, out)
    return found.step


def _run(asked: argparse.Namespace) -> int:
    steps = export(asked.checkpoint, asked.file)
    print(f"{asked.file}: {asked.file.stat().st_size / 1e3:.0f} kB, trained for {steps} steps")
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line."""
    name = "python -m trainer.run.export"
    parser = Parser(name, "CHECKPOINT FILE", "Write the weights of a checkpoint alone.", [f"{name} last.pt firenet.pt"])
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("file", type=Path)
    return run_command(parser, _run, arguments)


if __name__ == "__main__":
    sys.exit(main())
