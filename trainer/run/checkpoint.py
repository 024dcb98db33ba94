"""Checkpoints of a training run: all that determines its next losses, readable without executing code.

A checkpoint holds tensors and plain values only, so it loads with ``weights_only=True``: state dicts of the network and
the optimiser (never the object), the position in the stream after the last batch trained on (``Batch.resume_state``),
the counters and the configuration.

Writing is atomic: a reader, or the next start after a power cut, sees the whole old file or the whole new one. This
module also checks that a checkpoint belongs to a run, and that a run may write to a folder.
"""

from __future__ import annotations

import dataclasses
import os
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from trainer.config import TrainConfig, differences
from trainer.unpickle import read_torch_file
from v2v_protocol.errors import UsageError
from v2v_protocol.write_aside import make_output_folder, write_aside_and_rename

FORMAT = 2
LAST = "last.pt"
BEST = "best.pt"

MAY_DIFFER = (
    *("stream.address", "stream.videos", "stream.list", "stream.workers"),
    *("stream.loader_workers", "stream.timeout_seconds"),
    *("loss.lpips_backbone", "loss.lpips_heads", "loss.raft_weights", "network.weights", "compute.seed"),
)
"""Keys of places and of speed. The stream itself compares the content of the videos."""

MAY_CHANGE = ("run.", "compute.", "stream.batch_size")
"""Keys of length and device: a change is allowed and reported. It may change the losses."""


@dataclass(frozen=True)
class Checkpoint:
    """The state of a training run between two steps.

    Attributes:
        step: optimiser steps taken so far, over all epochs.
        epoch: the epoch that the next batch belongs to.
        model: state dict of the network itself (unwrapped: not of DistributedDataParallel).
        optimizer: its state dict.
        ema: state dict of the averaged network, or None without one.
        stream: ``resume_state`` of the last batch trained on; None before the first.
        config: configuration of the run as plain values.
    """

    step: int
    epoch: int
    model: Mapping[str, Tensor]
    optimizer: Mapping[str, Any]
    ema: Mapping[str, Tensor] | None
    stream: Mapping[str, Any] | None
    config: Mapping[str, Any]


def _plain(value: Any, place: str) -> Any:
    """Return ``value`` with every mapping as a dict, and check that it is readable without code.

    Raises:
        UsageError: a part of it is neither a tensor nor a plain value.
    """
    if isinstance(value, Mapping):
        return {key: _plain(item, f"{place}[{key!r}]") for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        items = [_plain(item, f"{place}[{index}]") for index, item in enumerate(value)]
        return tuple(items) if isinstance(value, tuple) else items
    if value is None or type(value) in (str, int, float, bool, bytes) or isinstance(value, Tensor):
        return value
    raise UsageError(f"checkpoint {place} is a {type(value).__name__}: only tensors and plain values are kept")


def save_checkpoint(path: str | Path, checkpoint: Checkpoint) -> None:
    """Write a checkpoint with :func:`save_atomically`.

    Raises:
        UsageError: a part of it is neither a tensor nor a plain value.
        OSError: it cannot be written; an earlier file is intact.
    """
    content = {"format": FORMAT}
    for item in dataclasses.fields(checkpoint):
        content[item.name] = _plain(getattr(checkpoint, item.name), item.name)
    save_atomically(Path(path), content)


def save_atomically(path: Path, content: Mapping[str, Any]) -> None:
    """Write a file with ``torch.save``, and replace ``path`` only when all of it is on the disk.

    Raises:
        OSError: it cannot be written; an earlier file is intact.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with write_aside_and_rename(path, durable=True) as partial, partial.open("wb") as file:
        try:
            torch.save(content, file)
        except RuntimeError as error:
            # PyTorch closes its archive while it handles the OSError, and raises that bytes are missing.
            if isinstance(error.__context__, OSError):
                raise error.__context__ from None
            raise


def load_checkpoint(path: str | Path) -> Checkpoint:
    """Read what :func:`save_checkpoint` wrote, with all tensors on the CPU.

    Raises:
        UsageError: no such file, damaged, not a checkpoint of a training run, or of a newer release.
    """
    content = read_torch_file(path, plain=True)
    names = [item.name for item in dataclasses.fields(Checkpoint)]
    if not isinstance(content, dict) or not {"format", *names} <= content.keys():
        raise UsageError(f"{path} is no checkpoint of a training run (for weights alone use read_weights)")
    if content["format"] != FORMAT:
        raise UsageError(f"{path} has checkpoint format {content['format']}, this release reads {FORMAT}")
    return Checkpoint(**{name: content[name] for name in names})


def epoch_name(epoch: int) -> str:
    """File of the checkpoint after an epoch."""
    return f"epoch-{epoch:04d}.pt"


def prune_epochs(out: Path, keep: int) -> None:
    """Remove the oldest checkpoints of epochs in the folder of a run, except the last ``keep``."""
    # By number: from 10,000 on, names have more than four digits.
    for path in sorted(out.glob("epoch-*.pt"), key=lambda path: (len(path.name), path.name))[:-keep]:
        path.unlink(missing_ok=True)


def numerics_of(checkpoint: Checkpoint) -> dict[str, Any]:
    """Return the precision and memory format of a run, for a configuration that says nothing of them.

    A checkpoint of a release that had no such key was computed in IEEE float32.
    """
    compute = {"precision": "float32", "channels_last": False} | dict(checkpoint.config.get("compute", {}))
    return {"compute": {key: compute[key] for key in ("precision", "channels_last")}}


def require_same_run(checkpoint: Checkpoint, config: TrainConfig) -> list[str]:
    """Check that a configuration continues the run of a checkpoint.

    Returns:
        The differences that are allowed, one line each.

    Raises:
        UsageError: a setting differs that makes it another run; the message names all of these with both values.
    """
    # A key that is newer than the checkpoint had its default in that run.
    saved = {
        section: {**dataclasses.asdict(type(getattr(config, section))()), **checkpoint.config.get(section, {})}
        for section in config.to_dict()
    }
    changed = differences(saved, config.to_dict())
    shown = {
        key: f"{key}: {old!r} -> {new!r}" for key, (old, new) in changed.items() if key not in (*MAY_DIFFER, "run.out")
    }
    refused = [text for key, text in shown.items() if not key.startswith(MAY_CHANGE)]
    if refused:
        raise UsageError(
            f"--resume: the checkpoint is of another run ({'; '.join(refused)}). Give its settings, or start a new run "
            "from its weights with network.weights"
        )
    return list(shown.values())


def require_fresh(out: Path) -> None:
    """Check that a new run would not overwrite another one.

    Raises:
        UsageError: the folder holds a run, or cannot be entered.
    """
    try:
        holds_run = (out / LAST).exists()
    except OSError as error:
        raise _unusable(out, error) from error
    if holds_run:
        raise UsageError(f"{out} holds a run: continue with --resume {out / LAST}, or give another folder with --out")


def require_writable(out: Path) -> None:
    """Create the folder of a run if it is missing, and check that it is writable.

    Raises:
        UsageError: it cannot be created or written.
    """
    try:
        make_output_folder(out)
        with tempfile.TemporaryFile(dir=out):
            pass
    except OSError as error:
        raise _unusable(out, error) from error


def unwritable(out: Path, name: str, error: OSError) -> UsageError:
    """Return the error to raise when the file or folder ``name`` of the run in ``out`` cannot be written."""
    last = out / LAST
    then = f"continue with --resume {last}" if os.path.exists(last) else "start the run again"
    return UsageError(
        f"{out / name}: {error.strerror or error}; the checkpoints there are intact. Free space or allow writing, "
        f"then {then}"
    )


def _unusable(out: Path, error: OSError) -> UsageError:
    return UsageError(f"run.out = {out}: {error.strerror}; give another folder with --out")
