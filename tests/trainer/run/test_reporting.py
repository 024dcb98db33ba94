"""What a run says of itself: the meter, the readings that it writes, and a disk that refuses them."""

from __future__ import annotations

import os
import resource
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.trainer.training import ALONE
from trainer.config import TrainConfig
from trainer.run.reporting import METRICS_FILE, Meter, Reporter, read_metrics
from v2v_protocol.errors import UsageError


def test_the_meter_returns_means_and_resets(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [10.0]
    monkeypatch.setattr("time.perf_counter", lambda: now[0])
    meter = Meter(ALONE)
    assert meter.read(0.0) == {}
    for value in (1.0, 2.0, 6.0):
        meter.add({"total": torch.tensor(value), "l1": torch.tensor(-value)})
    now[0] = 16.0
    reading = meter.read(1.5, 0.75)
    assert reading == {
        "total": 3.0, "l1": -3.0, "steps_per_second": 0.5, "data_wait_seconds": 0.5, "transfer_seconds": 0.25,
        "compute_seconds": 1.25,
    }  # fmt: skip
    meter.add({"total": torch.tensor(4.0)})
    now[0] = 17.0
    assert meter.read(2.0, 1.0) == {
        "total": 4.0, "steps_per_second": 1.0, "data_wait_seconds": 0.5, "transfer_seconds": 0.25,
        "compute_seconds": 0.25,
    }  # fmt: skip


@pytest.mark.parametrize("torn", ['{"step": 3, "to', "{", "\0\0\0", "\ufffd"])
def test_a_truncated_last_line_is_ignored(tmp_path: Path, torn: str) -> None:
    path = tmp_path / "m.jsonl"
    path.write_text('{"step": 1}\n{"step": 2}\n' + torn)
    assert read_metrics(path) == [{"step": 1}, {"step": 2}]
    path.write_text('{"step": 1}\n{"step": 2}')
    assert read_metrics(path) == [{"step": 1}, {"step": 2}]
    path.write_text(torn)
    assert read_metrics(path) == []


@pytest.mark.parametrize("damaged", ['{"step": 3, "to', "", "3", '{"epoch": 0}'])
def test_a_malformed_line_is_reported(tmp_path: Path, damaged: str) -> None:
    path = tmp_path / "m.jsonl"
    for after in ("", '{"step": 4}\n', '{"ste'):
        path.write_text(f'{{"step": 1}}\n{damaged}\n{after}')
        with pytest.raises(UsageError, match=r"m\.jsonl, line 2, is no record"):
            read_metrics(path)


READING = {"total": 1.0, "steps_per_second": 1.0, "data_wait_seconds": 0.0}
FULL: dict[str, Callable[[Reporter], object]] = {
    "metrics.jsonl": lambda reporter: reporter.metrics(1, 0, 0.1, READING),
    "config.yaml": lambda reporter: reporter.configuration(TrainConfig()),
    "previews": lambda reporter: reporter.preview(1, [np.zeros((2, 16, 16, 3), np.uint8)], ()),
    "tensorboard": lambda reporter: reporter.held_out(1, {"total": 1.0}),
}


@pytest.mark.parametrize("name", FULL)
@pytest.mark.parametrize("saved", [False, True])
def test_a_full_disk_is_said_in_one_line_with_a_remedy(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, saved: bool
) -> None:
    """No file may grow any more: each write of the reporter is refused, TensorBoard's included."""
    if saved:
        (tmp_path / "last.pt").touch()
    then = f"continue with --resume {tmp_path / 'last.pt'}" if saved else "start the run again"
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    reporter = Reporter(tmp_path, speaks=True)
    if name == "tensorboard":
        (tmp_path / METRICS_FILE).symlink_to("/dev/null")
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, before[1]))
    try:
        with pytest.raises(UsageError) as caught, reporter:
            FULL[name](reporter)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert str(caught.value) == (
        f"{tmp_path / name}: File too large; the checkpoints there are intact. Free space or allow writing, then {then}"
    )
    assert "Traceback" not in capsys.readouterr().err


def test_a_folder_that_becomes_unwritable_is_said(tmp_path: Path) -> None:
    (tmp_path / "tensorboard").touch()
    with pytest.raises(UsageError, match=r"tensorboard: File exists; .* then start the run again"):
        Reporter(tmp_path, speaks=True)
    with pytest.raises(UsageError, match=r"metrics\.jsonl: Not a directory"):
        Reporter(tmp_path / "tensorboard" / "run", speaks=True)


def test_a_full_disk_costs_no_readings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(_descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    path = tmp_path / METRICS_FILE
    path.write_text('{"step": 1}\n{"step": 2}\n{"st')
    old = path.read_bytes()
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(UsageError, match=r"metrics\.jsonl: No space left on device; .* then start the run again"):
        Reporter(tmp_path, speaks=True, step=1)
    assert path.read_bytes() == old
    assert [entry.name for entry in tmp_path.iterdir()] == [METRICS_FILE]
