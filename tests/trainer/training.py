"""A run of a few thousand multiplications a step, for tests of the loop."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from torch import Tensor

from trainer.run.reporting import METRICS_FILE, read_metrics
from trainer.train import main

SMALL: dict[str, Any] = {
    "network": {"name": "firenet", "options": {"base_channels": 2}},
    "stream": {
        "batch_size": 4,
        "recipe": {"voxels_per_clip": 3, "bins": 2, "crop_height_px": 16, "crop_width_px": 20},
        "timeout_seconds": 60,
    },
    "optimizer": {
        "learning_rate": 0.01,
        "learning_rate_decay": 0.5,
        "clip_gradient_norm": 0.3,
        "ema_decay": 0.9,
    },
    "compute": {"device": "cpu", "threads": 1},
    "run": {"epochs": 100, "log_every": 1, "save_every": 1000, "judge_every": 0, "preview_every": 0},
}
"""With 23 sequences: 5 batches an epoch, 3 samples dropped."""

OF_THE_CLOCK = ("steps_per_second", "data_wait_seconds", "transfer_seconds", "compute_seconds")


def configured(folder: Path) -> str:
    """The file of that configuration."""
    path = folder / "small.yaml"
    path.write_text(yaml.safe_dump(SMALL), encoding="utf-8")
    return str(path)


def arguments(folder: Path, address: str, out: str, resume: str | None = None, **settings: Any) -> list[str]:
    """A command line; settings as section__key=value."""
    changes = [f"{key.replace('__', '.')}={json.dumps(value)}" for key, value in settings.items()]
    return [
        *(configured(folder), "--connect", address, "--out", str(folder / out)),
        *(text for change in changes for text in ("--set", change)),
        *(("--resume", str(folder / resume)) if resume else ()),
    ]


def trained(folder: Path, address: str, out: str, resume: str | None = None, **settings: Any) -> Path:
    """Trains in this process, to the end; returns the folder of the run."""
    assert main(arguments(folder, address, out, resume, **settings)) == 0
    return folder / out


def losses(out: Path) -> list[dict[str, Any]]:
    """What every reading said, apart from the time it took."""
    return [
        {name: value for name, value in record.items() if name not in OF_THE_CLOCK}
        for record in read_metrics(out / METRICS_FILE)
        if "total" in record
    ]


def refused(folder: Path, address: str, capsys: pytest.CaptureFixture[str], **settings: object) -> str:
    """Train and be refused with status 2; return what was said."""
    assert main(arguments(folder, address, "run", **settings)) == 2  # type: ignore[arg-type]
    return capsys.readouterr().err


def same(left: object, right: object) -> bool:
    """Equal to the last bit, tensors included."""
    if isinstance(left, Tensor) and isinstance(right, Tensor):
        return torch.equal(left, right)
    if isinstance(left, dict) and isinstance(right, dict):
        return left.keys() == right.keys() and all(same(left[key], right[key]) for key in left)
    if isinstance(left, list | tuple) and isinstance(right, list | tuple):
        return len(left) == len(right) and all(map(same, left, right))
    return left == right
