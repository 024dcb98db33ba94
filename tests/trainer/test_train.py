"""The training loop, on a server that sends random samples over the real wire."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torch import Tensor, nn

from tests.client.fake_server import FakeServer
from tests.trainer.training import arguments, losses, refused, same, trained
from trainer.config_file import load_config
from trainer.models import NETWORKS, FireNet, VoxelNetwork
from trainer.models.sequence import Guide, Settings
from trainer.run.checkpoint import LAST, load_checkpoint
from trainer.run.reporting import METRICS_FILE, read_metrics
from trainer.train import main
from trainer.weights import load_into, load_network


def test_training_reduces_the_loss(whole: Path) -> None:
    readings = losses(whole)
    assert [record["step"] for record in readings] == list(range(1, 13))
    assert [record["epoch"] for record in readings] == [0] * 5 + [1] * 5 + [2] * 2
    assert [record["learning_rate"] for record in readings] == [0.01] * 5 + [0.005] * 5 + [0.0025] * 2
    assert readings[-1]["total"] < 0.9 * readings[0]["total"]
    last = load_checkpoint(whole / LAST)
    assert (last.step, last.epoch) == (12, 2)
    assert (last.stream["epoch"], last.stream["position"]) == (2, 8)
    assert not same(last.model, last.ema)
    network = FireNet(bins=2, base_channels=2)
    load_into(network, whole / LAST)
    load_into(network, whole / LAST, ema=True)


@pytest.mark.parametrize("first", [3, 5, 7], ids=["within an epoch", "between two epochs", "in the second epoch"])
def test_a_resumed_run_is_the_uninterrupted_one(
    server: FakeServer, whole: Path, tmp_path: Path, first: int, capsys: pytest.CaptureFixture[str]
) -> None:
    """Equal losses, weights, averages, optimiser, scheduler and stream position, to the last bit."""
    trained(tmp_path, server.address, "run", run__steps=first)
    resumed = trained(tmp_path, server.address, "run", resume=f"run/{LAST}", run__steps=12)
    assert "run.steps: " in capsys.readouterr().err
    assert losses(resumed) == losses(whole)
    mine, theirs = load_checkpoint(resumed / LAST), load_checkpoint(whole / LAST)
    for part in ("step", "epoch", "model", "optimizer", "ema", "stream"):
        assert same(getattr(mine, part), getattr(theirs, part)), part


@pytest.mark.parametrize(
    ("name", "options", "loss"),
    [
        ("e2vid", {"base_channels": 2, "encoders": 2}, {}),
        ("hypere2vid", {"base_channels": 2}, {"guide_epochs": 2}),
        ("etnet", {"base_channels": 2}, {}),
        ("evflownet", {"base_channels": 2}, {"flow": "stream"}),
        pytest.param("eraft", {}, {"flow": "stream", "valid": "consistent"}, marks=pytest.mark.slow),
    ],
)
def test_every_network_resumes_exactly(
    server: FakeServer, tmp_path: Path, name: str, options: dict[str, Any], loss: dict[str, Any],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    """Dropout and batch norm included."""
    monkeypatch.setattr("trainer.models.eraft.UPDATES", 2)  # the other ten say nothing new
    monkeypatch.setattr("trainer.models.etnet.ENCODER_LAYERS", 1)  # nor do two more layers
    settings: dict[str, Any] = {
        "network": {"name": name, "options": options}, "loss": loss, "stream": {"batch_size": 2},
        "optimizer": {"learning_rate": 1e-3},
    }  # fmt: skip
    flat = {f"{section}__{key}": value for section, keys in settings.items() for key, value in keys.items()}
    whole = trained(tmp_path, server.address, "whole", run__steps=3, **flat)
    trained(tmp_path, server.address, "run", run__steps=2, **flat)
    resumed = trained(tmp_path, server.address, "run", resume=f"run/{LAST}", run__steps=3, **flat)
    assert losses(resumed) == losses(whole)
    assert same(load_checkpoint(resumed / LAST).model, load_checkpoint(whole / LAST).model)


def test_resuming_drops_readings_of_later_steps(server: FakeServer, whole: Path, tmp_path: Path) -> None:
    """As after a crash: the last checkpoint is older than the last reading."""
    run = trained(tmp_path, server.address, "run", run__steps=7, run__save_every=4)
    early = trained(tmp_path, server.address, "early", run__steps=4)
    shutil.copy(early / LAST, run / LAST)
    trained(tmp_path, server.address, "run", resume=f"run/{LAST}", run__steps=12)
    assert losses(run) == losses(whole)


def test_a_restarted_run_drops_readings_of_the_ended_one(server: FakeServer, tmp_path: Path) -> None:
    """One that ended before its first checkpoint, in the same folder."""
    run = trained(tmp_path, server.address, "run", run__steps=3)
    (run / LAST).unlink()
    trained(tmp_path, server.address, "run", run__steps=2)
    board = EventAccumulator(str(run / "tensorboard")).Reload()
    assert [event.step for event in board.Scalars("loss/total")] == [1, 2]
    assert [record["step"] for record in losses(run)] == [1, 2]


def test_a_larger_batch_does_not_repeat_a_nearly_finished_epoch(tmp_path: Path) -> None:
    """16 of 23 samples are trained on, and 7 are no batch of 8: the next epoch begins, with its learning rate."""
    with FakeServer(sequences=23) as server:
        run = trained(tmp_path, server.address, "run", run__steps=4)
        asked = len(server.wants)
        # Nothing is left to do the first time, and the second goes on from what that one saved.
        for steps in (4, 7):
            trained(tmp_path, server.address, "run", resume=f"run/{LAST}", run__steps=steps, stream__batch_size=8)
        assert not [epoch for epoch, _ in server.wants[asked:] if epoch == 0]
    readings = losses(run)
    assert [(record["step"], record["epoch"]) for record in readings] == [
        *((step, 0) for step in (1, 2, 3, 4)), *((5, 1), (6, 1), (7, 2)),
    ]  # fmt: skip
    assert [record["learning_rate"] for record in readings] == [0.01] * 4 + [0.005] * 2 + [0.0025]


def test_readings_are_means_over_the_steps_since_the_last(server: FakeServer, whole: Path, tmp_path: Path) -> None:
    run = trained(tmp_path, server.address, "run", run__steps=10, run__log_every=4)
    single, coarse = losses(whole), losses(run)
    assert [record["step"] for record in coarse] == [4, 8, 10]
    for record, steps in zip(coarse, (single[:4], single[4:8], single[8:10]), strict=True):
        assert record["total"] == pytest.approx(sum(step["total"] for step in steps) / len(steps), rel=1e-5)


def test_checkpoints_of_epochs_and_previews(server: FakeServer, whole: Path, tmp_path: Path) -> None:
    run = trained(
        tmp_path, server.address, "run", run__epochs=3, run__keep_epochs=2, run__preview_every=9,
        run__preview_samples=1,
    )  # fmt: skip
    assert losses(run)[:12] == losses(whole)
    assert sorted(path.name for path in run.glob("epoch-*")) == ["epoch-0001.pt", "epoch-0002.pt"]
    assert load_checkpoint(run / "epoch-0001.pt").step == 10
    pictures = sorted(path.name for path in (run / "previews").iterdir())
    assert pictures == [f"step-00000{step}-0.{kind}" for step in ("09", "15") for kind in ("mp4", "png")]
    sheet = cv2.imread(str(run / "previews" / "step-0000015-0.png"))
    height, width = 3 * (8 * 16 + 4), 3 * (8 * 20 + 4)
    assert sheet.shape[0] > height  # a title and the names of the columns above
    assert sheet.shape[1] > width  # and an arrow of time beside them
    video = cv2.VideoCapture(str(run / "previews" / "step-0000015-0.mp4"))
    assert sum(1 for _ in iter(lambda: video.read()[0], False)) == 3


@pytest.mark.parametrize(("processor", "slow"), [("AVX2", True), ("AVX512", False)])
def test_bfloat16_in_software_is_reported(
    server: FakeServer,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    processor: str,
    slow: bool,
) -> None:
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: processor)
    said = refused(tmp_path, server.address, capsys, compute__precision="bfloat16", run__validate="nowhere")
    assert ("bfloat16 in software" in said) == slow


def test_a_run_stores_its_configuration(server: FakeServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = trained(tmp_path, server.address, "run", run__steps=1)
    assert main([*arguments(tmp_path, server.address, "run", run__steps=1), "--show-config"]) == 0
    assert capsys.readouterr().out.endswith((run / "config.yaml").read_text())
    assert load_config(str(run / "config.yaml")).run.steps == 1


class Toy(VoxelNetwork):
    """All that a network needs to be trained, saved, shown and evaluated, besides its line in NETWORKS."""

    task = "reconstruction"
    signature = ("brightness.weight",)

    def __init__(self, *, bins: int = 5) -> None:
        super().__init__(bins=bins, size_multiple=4)
        self.brightness = nn.Conv2d(bins, 1, 1)

    def unroll(self, x: Tensor, _state: Any, _steps: int, _guide: Guide | None) -> tuple[Tensor, tuple[()]]:
        return self.brightness(x), ()

    @classmethod
    def from_state(cls, state: Mapping[str, Tensor], _settings: Settings) -> dict[str, Any]:
        return {"bins": state["brightness.weight"].shape[1]}


def test_a_network_touches_its_own_file_and_one_line_of_the_registry(
    server: FakeServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(NETWORKS, "toy", Toy)
    run = trained(
        tmp_path, server.address, "run", run__steps=8, run__preview_every=8, network__name="toy", network__options={}
    )
    readings = losses(run)
    assert readings[-1]["total"] < readings[0]["total"]
    assert list((run / "previews").glob("*.png"))
    assert load_network(run / LAST)[1] == "toy"
    torch.save(load_checkpoint(run / LAST).model, tmp_path / "bare.pth")
    assert isinstance(load_network(tmp_path / "bare.pth")[0], Toy)


def test_flow_is_scored_and_drawn_as_well(server: FakeServer, tmp_path: Path) -> None:
    run = trained(
        tmp_path, server.address, "run", run__steps=2, run__preview_every=2, run__judge_every=1,
        network__name="evflownet", network__options={"base_channels": 2},
        loss__flow="stream", loss__valid="consistent",
    )  # fmt: skip
    assert server.hellos[-1].arrays == ("voxels", "flow", "flow_valid")
    judged = [record for record in read_metrics(run / METRICS_FILE) if "held_out_total" in record]
    assert [record["step"] for record in judged] == [0, 1, 2]
    assert all(record["held_out_end_point_error_px"] > 0 for record in judged)
    assert (run / "previews" / "step-0000002-0.png").is_file()


def test_an_epoch_of_one_sample_limits_previews_and_batches(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with FakeServer(sequences=1) as server:
        told = refused(tmp_path, server.address, capsys, run__preview_every=1, stream__batch_size=4)
        run = trained(
            tmp_path, server.address, "run", run__steps=1, run__preview_every=1, run__judge_samples=2,
            stream__batch_size=1,
        )  # fmt: skip
    assert [path.name for path in (run / "previews").glob("*.png")] == ["step-0000001-0.png"]
    assert "no global batch of 1 x 4 = 4 samples" in told


def test_loader_workers_change_nothing(server: FakeServer, whole: Path, tmp_path: Path) -> None:
    """A run begins without one, goes on with one into the next epoch, and ends without one."""
    run = trained(tmp_path, server.address, "run", run__steps=3)
    for steps, workers in ((7, 1), (12, 0)):
        trained(tmp_path, server.address, "run", resume=f"run/{LAST}", run__steps=steps, stream__loader_workers=workers)
    assert losses(run) == losses(whole)


def test_temporal_consistency_takes_backward_flow_of_the_stream(server: FakeServer, tmp_path: Path) -> None:
    run = trained(
        tmp_path, server.address, "run", run__steps=2,
        loss__temporal_weight=1.0, loss__temporal_first_step=1, loss__flow="stream",
    )  # fmt: skip
    hello = server.hellos[-1]
    assert hello.arrays == ("voxels", "frames", "flow")
    assert (hello.spec["flow_direction"], hello.spec["flow_from"]) == ("backward", 1)
    for record in losses(run):
        assert record["total"] == pytest.approx(record["l1"] + record["temporal"])
        assert record["temporal"] > 0


def test_bfloat16_channels_last_is_close(server: FakeServer, whole: Path, tmp_path: Path) -> None:
    run = trained(
        tmp_path, server.address, "run", run__steps=2, compute__precision="bfloat16", compute__channels_last=True
    )
    for mine, theirs in zip(losses(run), losses(whole)[:2], strict=True):
        assert mine["total"] == pytest.approx(theirs["total"], rel=2e-2)
        assert mine["total"] != theirs["total"]
