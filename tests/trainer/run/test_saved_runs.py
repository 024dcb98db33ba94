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

from tests.trainer.run.test_checkpoint import small
from tests.trainer.training import same
from trainer.config import TrainConfig
from trainer.run.checkpoint import Checkpoint, load_checkpoint, require_same_run, save_checkpoint
from trainer.weights import load_into, read_weights
from v2v_protocol.errors import UsageError


def checkpoint(step: int = 0) -> Checkpoint:
    """Return the checkpoint of a small training after one step, with a stream position."""
    model = small()
    optimizer = torch.optim.Adam(model.parameters(), lr=1e-2, amsgrad=True)
    model.forward_sequence(torch.ones(1, 2, 5, 16, 16)).mean().backward()
    optimizer.step()
    stream = {"version": 1, "stream": {"spec": {"seed": 2**64 - 1}, "list": ["a", 0.5, None]}, "at": step}
    config = {"batch_size": 12, "network": {"name": "e2vid"}}
    return Checkpoint(step, 1, model.state_dict(), optimizer.state_dict(), None, stream, config)


def test_a_checkpoint_comes_back_whole_and_needs_no_code(tmp_path: Path) -> None:
    plain = checkpoint(7)
    ema = {name: tensor + 1 for name, tensor in plain.model.items()}
    written = dataclasses.replace(plain, ema=ema)
    save_checkpoint(tmp_path / "a.pt", written)
    assert isinstance(torch.load(tmp_path / "a.pt", weights_only=True), dict)
    assert same(vars(load_checkpoint(tmp_path / "a.pt")), vars(written))
    for is_averaged, expected in ((False, plain.model), (True, ema)):
        other = small(seed=1)
        load_into(other, tmp_path / "a.pt", ema=is_averaged)
        assert same(other.state_dict(), expected)


@pytest.mark.parametrize("fails", ["fsync", "write"])
def test_a_failed_write_leaves_the_old_checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fails: str) -> None:
    path = tmp_path / "last.pt"
    save_checkpoint(path, checkpoint())
    old = path.read_bytes()

    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(*((os, "fsync", full) if fails == "fsync" else (torch, "save", full)))
    with pytest.raises(OSError, match="No space"):
        save_checkpoint(path, checkpoint(1))
    assert path.read_bytes() == old
    assert [entry.name for entry in tmp_path.iterdir()] == ["last.pt"]


def test_disk_errors_are_raised_unchanged(tmp_path: Path) -> None:
    """Not what PyTorch's writer makes of it."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    large = dataclasses.replace(checkpoint(), ema={"weight": torch.zeros(60_000)})
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, before[1]))
        with pytest.raises(OSError, match="File too large"):
            save_checkpoint(tmp_path / "last.pt", large)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert not list(tmp_path.iterdir())


def test_objects_that_need_code_to_load_are_refused_before_writing(tmp_path: Path) -> None:
    unsafe = dataclasses.replace(checkpoint(), config={"sizes": [1, {"seed": np.int64(3)}]})
    with pytest.raises(UsageError, match=r"config\['sizes'\]\[1\]\['seed'\] is a int64"):
        save_checkpoint(tmp_path / "a.pt", unsafe)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "no file"),
        ({"state_dict": {}}, "for weights alone use read_weights"),
        (
            {"format": 99, **{field.name: None for field in dataclasses.fields(Checkpoint)}},
            "format 99, this release reads 2",
        ),
        (b"PK\x03\x04 and no more", "or damaged"),
    ],
)
def test_other_files_are_refused_as_checkpoints(tmp_path: Path, content: Any, message: str) -> None:
    path = tmp_path / "a.pt"
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content is not None:
        torch.save(content, path)
    with pytest.raises(UsageError, match=message):
        load_checkpoint(path)


def test_a_flipped_bit_in_a_checkpoint_is_found(tmp_path: Path) -> None:
    """Anywhere in a tensor or in the plain values; ``torch.load`` gives other numbers."""
    path = tmp_path / "a.pt"
    save_checkpoint(path, checkpoint())
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
    earlier = dataclasses.replace(checkpoint(), config=older)
    assert require_same_run(earlier, config) == []
    compute = dataclasses.replace(config.compute, group_timeout_seconds=60.0)
    changed = require_same_run(earlier, dataclasses.replace(config, compute=compute))
    assert changed == ["compute.group_timeout_seconds: 7200.0 -> 60.0"]
    optimizer = dataclasses.replace(config.optimizer, schedule="cosine")
    with pytest.raises(UsageError, match=r"optimizer\.schedule: 'constant' -> 'cosine'"):
        require_same_run(earlier, dataclasses.replace(config, optimizer=optimizer))
