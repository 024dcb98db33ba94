"""Checkpoints of a run: atomic, complete, plain, checked."""

from __future__ import annotations

import dataclasses
import os
import resource
import struct
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.trainer.run.test_checkpoint import same, small
from trainer.config import TrainConfig
from trainer.run.checkpoint import Checkpoint, load_checkpoint, require_same_run, save_checkpoint
from trainer.weights import load_into, read_weights
from v2v_protocol.errors import UsageError


class Run:
    """A training run in small, with a stream position."""

    def __init__(self) -> None:
        self.model = small()
        self.optimizer = torch.optim.Adam(self.model.parameters(), lr=1e-2, amsgrad=True)
        self.position = 0

    def train(self, steps: int) -> list[float]:
        losses = []
        for _ in range(steps):
            voxels = (torch.arange(2560.0).view(1, 2, 5, 16, 16) + self.position).sin()
            loss = (self.model.forward_sequence(voxels) - 0.5).square().mean()
            self.optimizer.zero_grad()
            loss.backward()
            self.optimizer.step()
            self.position += 1
            losses.append(loss.item())
        return losses

    def checkpoint(self) -> Checkpoint:
        return Checkpoint(
            step=self.position,
            epoch=1,
            model=self.model.state_dict(),
            optimizer=self.optimizer.state_dict(),
            ema=None,
            stream={
                "version": 1,
                "stream": {"spec": {"seed": 2**64 - 1}, "list": ["a", 0.5, None]},
                "at": self.position,
            },
            config={"batch_size": 12, "network": {"name": "e2vid"}},
        )

    def restore(self, checkpoint: Checkpoint) -> None:
        self.model.load_state_dict(checkpoint.model)
        self.optimizer.load_state_dict(dict(checkpoint.optimizer))
        assert checkpoint.stream is not None
        self.position = checkpoint.stream["at"]


def test_a_resumed_run_has_the_losses_of_the_uninterrupted_one(tmp_path: Path) -> None:
    path = tmp_path / "runs" / "last.pt"
    run = Run()
    run.train(3)
    save_checkpoint(path, run.checkpoint())
    expected = run.train(4)
    resumed = Run()
    resumed.train(1)
    resumed.restore(load_checkpoint(path))
    assert resumed.train(4) == expected
    assert same(resumed.model.state_dict(), run.model.state_dict())


def test_a_checkpoint_comes_back_whole_and_needs_no_code(tmp_path: Path) -> None:
    run = Run()
    run.train(1)
    ema = {name: tensor + 1 for name, tensor in run.model.state_dict().items()}
    written = dataclasses.replace(run.checkpoint(), ema=ema)
    save_checkpoint(tmp_path / "a.pt", written)
    assert isinstance(torch.load(tmp_path / "a.pt", weights_only=True), dict)
    read = load_checkpoint(tmp_path / "a.pt")
    assert (read.step, read.epoch, read.stream, read.config) == (1, 1, written.stream, written.config)
    assert same(dict(read.model), dict(written.model))
    assert read.ema is not None
    assert same(dict(read.ema), ema)
    other = small(seed=1)
    load_into(other, tmp_path / "a.pt")
    assert same(other.state_dict(), run.model.state_dict())
    load_into(other, tmp_path / "a.pt", ema=True)
    assert same(other.state_dict(), ema)


@pytest.mark.parametrize("fails", ["fsync", "write"])
def test_a_failed_write_leaves_the_old_checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fails: str) -> None:
    path = tmp_path / "last.pt"
    run = Run()
    save_checkpoint(path, run.checkpoint())
    old = path.read_bytes()
    run.train(1)

    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(*((os, "fsync", full) if fails == "fsync" else (torch, "save", full)))
    with pytest.raises(OSError, match="No space"):
        save_checkpoint(path, run.checkpoint())
    assert path.read_bytes() == old
    assert [entry.name for entry in tmp_path.iterdir()] == ["last.pt"]


def test_disk_errors_are_raised_unchanged(tmp_path: Path) -> None:
    """Not what PyTorch's writer makes of it."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    large = dataclasses.replace(Run().checkpoint(), ema={"weight": torch.zeros(60_000)})
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, before[1]))
        with pytest.raises(OSError, match="File too large"):
            save_checkpoint(tmp_path / "last.pt", large)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert not list(tmp_path.iterdir())


def test_the_data_are_on_the_disk_before_the_name_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []
    fsync, replace = os.fsync, Path.replace

    def spy_fsync(descriptor: int) -> None:
        calls.append("folder" if Path(f"/proc/self/fd/{descriptor}").is_dir() else "file")
        fsync(descriptor)

    def spy_replace(self: Path, target: Path) -> Path:
        calls.append("replace")
        return replace(self, target)

    monkeypatch.setattr(os, "fsync", spy_fsync)
    monkeypatch.setattr(Path, "replace", spy_replace)
    save_checkpoint(tmp_path / "last.pt", Run().checkpoint())
    assert calls == ["file", "replace", "folder"]


def test_objects_that_need_code_to_load_are_refused_before_writing(tmp_path: Path) -> None:
    checkpoint = dataclasses.replace(Run().checkpoint(), config={"sizes": [1, {"seed": np.int64(3)}]})
    with pytest.raises(UsageError, match=r"config\['sizes'\]\[1\]\['seed'\] is a int64"):
        save_checkpoint(tmp_path / "a.pt", checkpoint)
    assert list(tmp_path.iterdir()) == []


def test_other_files_are_refused_as_checkpoints(tmp_path: Path) -> None:
    path = tmp_path / "a.pt"
    with pytest.raises(UsageError, match="no file"):
        load_checkpoint(path)
    torch.save({"state_dict": small().state_dict()}, path)
    with pytest.raises(UsageError, match="for weights alone use read_weights"):
        load_checkpoint(path)
    save_checkpoint(path, Run().checkpoint())
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(UsageError, match="or damaged"):
        load_checkpoint(path)
    torch.save(torch.load(_written(path, whole), weights_only=True) | {"format": 99}, path)
    with pytest.raises(UsageError, match="format 99, this release reads 2"):
        load_checkpoint(path)


def test_a_flipped_bit_in_a_checkpoint_is_found(tmp_path: Path) -> None:
    """Anywhere in a tensor or in the plain values; ``torch.load`` gives other numbers."""
    path = tmp_path / "a.pt"
    save_checkpoint(path, Run().checkpoint())
    whole = path.read_bytes()
    with zipfile.ZipFile(path) as archive:
        entries = [entry for entry in archive.infolist() if entry.file_size > 8]
    for entry in entries:
        content = bytearray(whole)
        name, extra = struct.unpack_from("<HH", content, entry.header_offset + 26)
        content[entry.header_offset + 30 + name + extra + entry.file_size // 2] ^= 4
        path.write_bytes(content)
        with pytest.raises(UsageError, match=rf"or damaged: wrong CRC-32 of {entry.filename}"):
            load_checkpoint(path)
        with pytest.raises(UsageError, match="or damaged: wrong CRC-32"):
            read_weights(path)
    path.write_bytes(whole)
    load_checkpoint(path)


def test_files_without_checksums_are_read(tmp_path: Path) -> None:
    compute = torch.serialization.get_crc32_options()
    torch.serialization.set_crc32_options(False)
    try:
        torch.save(small().state_dict(), tmp_path / "bare.pth")
    finally:
        torch.serialization.set_crc32_options(compute)
    assert same(dict(read_weights(tmp_path / "bare.pth").state), small().state_dict())


def test_keys_that_are_newer_than_a_checkpoint_had_their_defaults(tmp_path: Path) -> None:
    config = TrainConfig()
    older = config.to_dict()
    del older["compute"]["group_timeout_seconds"], older["run"]["validate_config"], older["optimizer"]["schedule"]
    checkpoint = dataclasses.replace(Run().checkpoint(), config=older)
    assert require_same_run(checkpoint, config) == []
    compute = dataclasses.replace(config.compute, group_timeout_seconds=60.0)
    changed = require_same_run(checkpoint, dataclasses.replace(config, compute=compute))
    assert changed == ["compute.group_timeout_seconds: 7200.0 -> 60.0"]
    optimizer = dataclasses.replace(config.optimizer, schedule="cosine")
    with pytest.raises(UsageError, match=r"optimizer\.schedule: 'constant' -> 'cosine'"):
        require_same_run(checkpoint, dataclasses.replace(config, optimizer=optimizer))


def _written(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path
