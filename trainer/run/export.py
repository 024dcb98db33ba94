"""Export the weights of a checkpoint to a small file for v2v-eval and ``network.weights``.

    python -m trainer.run.export runs/firenet-cpu/last.pt firenet.pt

If the run has averaged weights, it exports these.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from trainer.run.checkpoint import load_checkpoint, save_atomically
from v2v_protocol.command import Parser, run_command
from v2v_protocol.errors import UsageError


def export(checkpoint: Path, file: Path) -> int:
    """Write ``file``; return the number of steps that its weights were trained for.

    Raises:
        UsageError: no such checkpoint, or not one of a training run; or ``file`` cannot be written.
    """
    if file.resolve() == checkpoint.resolve():
        raise UsageError(f"{file}: it is the checkpoint; give another FILE")
    found = load_checkpoint(checkpoint)
    network = {key: found.config["network"][key] for key in ("name", "options")}
    try:
        save_atomically(file, {"state_dict": found.ema or found.model, "config": {"network": network}})
    except OSError as error:
        raise UsageError(f"{file}: {error.strerror or error}; give another FILE, or free space there") from error
    return found.step


def _run(asked: argparse.Namespace) -> int:
    steps = export(asked.checkpoint, asked.file)
    print(f"{asked.file}: {asked.file.stat().st_size / 1e3:.0f} kB, trained for {steps} steps")
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    name = "python -m trainer.run.export"
    said = "Write the weights of a checkpoint alone."
    parser = Parser(name, "CHECKPOINT FILE", said, [f"{name} last.pt firenet.pt"])
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("file", type=Path)
    return run_command(parser, _run, arguments)


if __name__ == "__main__":
    sys.exit(main())
