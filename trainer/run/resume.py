"""Which run a checkpoint belongs to, and which folder a run may write to."""

from __future__ import annotations

import tempfile
from pathlib import Path

from trainer.config import TrainConfig, differences
from trainer.run.checkpoint import Checkpoint
from trainer.run.distributed import on_gpu
from v2v_protocol.errors import UsageError

LAST = "last.pt"

MAY_DIFFER = (
    *("stream.address", "stream.videos", "stream.list", "stream.workers"),
    *("stream.loader_workers", "stream.timeout_seconds"),
    *("loss.lpips_backbone", "loss.lpips_heads", "loss.raft_weights", "network.weights", "compute.seed"),
)
"""Where things lie and how fast they come. What the videos hold is compared by the stream itself."""

MAY_CHANGE = ("run.", "compute.", "stream.batch_size")
"""Said aloud, but allowed: how long to train and on what. Losses are then no longer those of an uninterrupted run."""


def require_same_run(checkpoint: Checkpoint, config: TrainConfig) -> list[str]:
    """
    Returns:
        what differs although it may, one line each.

    Raises:
        UsageError: a setting that would make it another run differs; the message names all of them with both values.
    """
    changed = differences(checkpoint.config, config.to_dict())
    shown = {
        key: f"{key}: {old!r} -> {new!r}" for key, (old, new) in changed.items() if key not in (*MAY_DIFFER, "run.out")
    }
    refused = [text for key, text in shown.items() if not key.startswith(MAY_CHANGE)]
    if refused:
        raise UsageError(
            f"--resume: the checkpoint is of another run ({'; '.join(refused)}). Give its settings, or start a new run "
            "from its weights with network.weights"
        )
    drawn = ["cuda" if gpu else "cpu" for gpu in (checkpoint.rng["cuda"], on_gpu(config.compute.device))]
    return [*shown.values(), *([f"random generator: {drawn[0]} -> {drawn[1]}"] if drawn[0] != drawn[1] else [])]


def require_fresh(out: Path) -> None:
    """
    Raises:
        UsageError: the folder holds a run, which a new one would write over; or it may not be entered.
    """
    try:
        holds_run = (out / LAST).exists()
    except OSError as error:
        raise _unusable(out, error) from error
    if holds_run:
        raise UsageError(f"{out} holds a run: go on with --resume {out / LAST}, or give another folder with --out")


def require_writable(out: Path) -> None:
    """Makes the folder where it is missing, before anything is started for nothing.

    Raises:
        UsageError: it cannot be made, or nothing can be written there.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=out):
            pass
    except OSError as error:
        raise _unusable(out, error) from error


def _unusable(out: Path, error: OSError) -> UsageError:
    return UsageError(f"run.out = {out}: {error.strerror}; give another folder with --out")
