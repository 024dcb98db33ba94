"""What ends a run: settings, folders and servers that do not fit, and a disk that refuses."""

from __future__ import annotations

import dataclasses
import re
import shutil
from pathlib import Path

import pytest
import torch

from tests.client.fake_server import FakeServer
from tests.trainer.training import arguments, losses, refused, same, trained
from trainer.run.checkpoint import LAST, epoch_name, load_checkpoint, prune_epochs, require_fresh, save_checkpoint
from trainer.run.reporting import METRICS_FILE
from trainer.train import main
from v2v_protocol.errors import UsageError


@pytest.mark.parametrize("out", ["file", "file/run"])
def test_an_unwritable_folder_is_reported_before_connecting(
    server: FakeServer, tmp_path: Path, capsys: pytest.CaptureFixture[str], out: str
) -> None:
    (tmp_path / "file").touch()
    before = len(server.hellos)
    assert main(arguments(tmp_path, server.address, out, run__steps=1)) == 2
    assert re.search(r"run\.out = .*file.*; give another folder with --out", capsys.readouterr().err)
    assert len(server.hellos) == before


def test_an_inaccessible_folder_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def denied(_: Path) -> bool:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "exists", denied)
    with pytest.raises(UsageError, match=r"run\.out = .*: Permission denied; give another folder"):
        require_fresh(tmp_path)


def test_a_run_resumes_in_its_own_folder(server: FakeServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    without_out = ["small.yaml", "--connect", server.address, "--set", "run.steps=1"]
    trained(tmp_path, server.address, "elsewhere", run__steps=1)
    assert main(without_out) == 0
    first = (tmp_path / "runs" / "small" / LAST).read_bytes()
    assert main([*without_out, "--set", "run.steps=2", "--resume", f"elsewhere/{LAST}"]) == 0
    assert load_checkpoint(tmp_path / "elsewhere" / LAST).step == 2
    assert (tmp_path / "runs" / "small" / LAST).read_bytes() == first


def test_neither_a_new_nor_a_resumed_run_overwrites_another(
    server: FakeServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    trained(tmp_path, server.address, "one", run__steps=1)
    run = trained(tmp_path, server.address, "run", run__steps=1)
    before = {path.name: path.read_bytes() for path in run.iterdir() if path.is_file()}
    for resume in (None, f"one/{LAST}"):
        message = refused(tmp_path, server.address, capsys, resume=resume, run__steps=2)
        assert "run holds a run: continue with --resume" in message
        assert {path.name: path.read_bytes() for path in run.iterdir() if path.is_file()} == before


def test_the_newest_epochs_are_kept_by_number(tmp_path: Path) -> None:
    for epoch in range(9990, 10003):
        (tmp_path / epoch_name(epoch)).touch()
    prune_epochs(tmp_path, 3)
    assert sorted(path.name for path in tmp_path.iterdir()) == [f"epoch-{epoch}.pt" for epoch in (10000, 10001, 10002)]


def test_another_run_is_not_resumed(server: FakeServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    trained(tmp_path, server.address, "run", run__steps=1)
    message = refused(tmp_path, server.address, capsys, resume=f"run/{LAST}", optimizer__learning_rate=0.5)
    assert "optimizer.learning_rate: 0.01 -> 0.5" in message


def test_a_refused_resume_writes_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Neither the configuration nor readings of the other corpus, and no reading is dropped."""
    with FakeServer(sequences=23) as server:
        run = trained(tmp_path, server.address, "run", run__steps=4, run__save_every=2, run__keep_epochs=1)
        early = trained(tmp_path, server.address, "early", run__steps=2)
        shutil.copy(early / LAST, run / "early.pt")

        def content() -> dict[str, bytes]:
            return {str(path): path.read_bytes() for path in run.rglob("*") if path.is_file()}

        before = content()
        server.restart(catalogue="catalogue-2")
        message = refused(
            tmp_path, server.address, capsys, resume="run/early.pt", run__steps=9, run__judge_every=1, run__log_every=3
        )
    assert "catalogue_digest" in message
    assert content() == before


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"loss__lpips_weight": 1.0}, "loss.lpips_backbone is missing.*download.pytorch.org/models/vgg16"),
        (
            {"loss__lpips_weight": 1.0, "loss__lpips_backbone": "no.pth", "loss__lpips_heads": "no.pth"},
            "no file no.pth",
        ),
        (
            {"loss__temporal_weight": 1.0, "loss__temporal_first_step": 1},
            "loss.raft_weights is missing.*raft_small_C_T_V2",
        ),
        ({"network__options": {"chanels": 3}}, "network.options.chanels: firenet knows base_channels"),
        ({"network__options": {"base_channels": 2.5}}, "network.options.base_channels = 2.5: give a whole number"),
        ({"network__options": {"normalize_voxels": "no"}}, "network.options.normalize_voxels = 'no': give true or fal"),
        (
            {"network__name": "e2vid", "network__options": {"norm": "BN"}},
            "network.options.norm = 'BN': choose one of none, batch",
        ),
        ({"network__weights": "no.pt"}, "no file no.pt"),
    ],
)
def test_missing_files_are_reported_before_connecting(
    server: FakeServer, tmp_path: Path, capsys: pytest.CaptureFixture[str], settings: dict[str, object], message: str
) -> None:
    before = len(server.hellos)
    assert re.search(message, refused(tmp_path, server.address, capsys, **settings))
    assert len(server.hellos) == before
    assert not (tmp_path / "run").exists()


def test_without_videos_or_address_training_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "--videos DIR, or --connect ADDRESS" in refused(tmp_path, "", capsys)


def test_a_diverged_run_keeps_the_checkpoint_before(
    server: FakeServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = trained(tmp_path, server.address, "run", run__steps=1)
    good = load_checkpoint(run / LAST)
    spoilt = {name: tensor * torch.nan for name, tensor in good.model.items()}
    save_checkpoint(run / "spoilt.pt", dataclasses.replace(good, model=spoilt))
    assert (
        main(arguments(tmp_path, server.address, "run", resume="run/spoilt.pt", run__steps=3, run__save_every=1)) == 1
    )
    message = capsys.readouterr().err
    assert "step 2: loss nan" in message
    assert "nothing was saved since this start" in message
    assert same(load_checkpoint(run / LAST).model, good.model)


def test_disk_errors_are_reported(
    server: FakeServer, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("trainer.loop.save_checkpoint", full)
    message = refused(tmp_path, server.address, capsys, run__steps=2)
    assert re.search(r"step 2 cannot be saved as .*last\.pt: No space left on device; .* start the run again", message)


def test_a_lost_server_costs_no_steps(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with FakeServer(sequences=23) as server:
        sent = []

        def silent_from_the_third_batch(frames: list[object]) -> list[object]:
            sent.append(frames)
            if len(sent) == 12:
                server.mute = True
            return frames

        server.alter = silent_from_the_third_batch
        message = refused(tmp_path, server.address, capsys, stream__timeout_seconds=2.0)
    assert "nothing received" in message
    assert load_checkpoint(tmp_path / "run" / LAST).step == len(losses(tmp_path / "run")) == 3
    assert (tmp_path / "run" / METRICS_FILE).is_file()


def test_an_unreachable_server_leaves_no_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], unused_port: int
) -> None:
    message = refused(tmp_path, f"tcp://127.0.0.1:{unused_port}", capsys, stream__timeout_seconds=0.1)
    assert "nothing received" in message
    assert not (tmp_path / "run" / LAST).exists()
