"""The training loop, on a server that sends random samples over the real wire."""

from __future__ import annotations

import dataclasses
import json
import re
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torch import Tensor, nn

from tests.client.fake_server import FakeServer
from tests.trainer.evaluation.h5_file import random_recording
from tests.trainer.training import arguments, losses, trained
from trainer.config_file import load_config
from trainer.evaluation.cli import main as evaluate
from trainer.models import NETWORKS, FireNet, VoxelNetwork
from trainer.models.sequence import Guide, Settings
from trainer.run.checkpoint import LAST, load_checkpoint, require_fresh, save_checkpoint
from trainer.run.reporting import METRICS, read_metrics
from trainer.train import main
from trainer.weights import load_into, load_network
from v2v_protocol.errors import UsageError


@pytest.fixture(scope="module")
def server() -> Iterator[FakeServer]:
    with FakeServer(sequences=23) as running:
        yield running


@pytest.fixture(scope="module")
def whole(server: FakeServer, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An uninterrupted run of 12 steps: two epochs of 5 and a part of the third."""
    return trained(tmp_path_factory.mktemp("whole"), server.address, "run", run__steps=12)


def same(left: object, right: object) -> bool:
    """Equal to the last bit, tensors included."""
    if isinstance(left, Tensor) and isinstance(right, Tensor):
        return torch.equal(left, right)
    if isinstance(left, dict) and isinstance(right, dict):
        return left.keys() == right.keys() and all(same(left[key], right[key]) for key in left)
    if isinstance(left, list | tuple) and isinstance(right, list | tuple):
        return len(left) == len(right) and all(map(same, left, right))
    return left == right


def test_it_trains(whole: Path) -> None:
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


def test_resuming_drops_what_was_said_of_later_steps(server: FakeServer, whole: Path, tmp_path: Path) -> None:
    """As after a crash: the last checkpoint is older than the last reading."""
    run = trained(tmp_path, server.address, "run", run__steps=7, run__save_every=4)
    early = trained(tmp_path, server.address, "early", run__steps=4)
    shutil.copy(early / LAST, run / LAST)
    trained(tmp_path, server.address, "run", resume=f"run/{LAST}", run__steps=12)
    assert losses(run) == losses(whole)


def test_a_run_begun_anew_drops_what_an_ended_one_said(server: FakeServer, tmp_path: Path) -> None:
    """One that ended before its first checkpoint, in the same folder."""
    run = trained(tmp_path, server.address, "run", run__steps=3)
    (run / LAST).unlink()
    trained(tmp_path, server.address, "run", run__steps=2)
    board = EventAccumulator(str(run / "tensorboard")).Reload()
    assert [event.step for event in board.Scalars("loss/total")] == [1, 2]
    assert [record["step"] for record in losses(run)] == [1, 2]


def test_a_reading_that_a_crash_cut_off_hinders_nobody(server: FakeServer, whole: Path, tmp_path: Path) -> None:
    run = trained(tmp_path, server.address, "run", run__steps=3)
    with (run / METRICS).open("a", encoding="utf-8") as file:
        file.write('{"step": 4, "epo')
    trained(tmp_path, server.address, "run", resume=f"run/{LAST}", run__steps=4)
    assert losses(run) == losses(whole)[:4]


def test_a_larger_batch_does_not_repeat_an_epoch_of_which_less_is_left(tmp_path: Path) -> None:
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


def test_a_finished_run_has_nothing_left(server: FakeServer, tmp_path: Path) -> None:
    run = trained(tmp_path, server.address, "run", run__epochs=1)
    before = load_checkpoint(run / LAST)
    assert (before.step, before.epoch) == (5, 1)
    trained(tmp_path, server.address, "run", resume=f"run/{LAST}", run__epochs=1)
    assert same(load_checkpoint(run / LAST).model, before.model)
    assert len(losses(run)) == 5


def test_readings_are_means_over_the_steps_since_the_last(server: FakeServer, whole: Path, tmp_path: Path) -> None:
    run = trained(tmp_path, server.address, "run", run__steps=10, run__log_every=4)
    single, coarse = losses(whole), losses(run)
    assert [record["step"] for record in coarse] == [4, 8, 10]
    for record, steps in zip(coarse, (single[:4], single[4:8], single[8:10]), strict=True):
        assert record["total"] == pytest.approx(sum(step["total"] for step in steps) / len(steps), rel=1e-5)


def test_checkpoints_of_epochs_and_previews(server: FakeServer, tmp_path: Path) -> None:
    run = trained(
        tmp_path, server.address, "run", run__epochs=3, run__keep_epochs=2, run__preview_every=9,
        run__preview_samples=1,
    )  # fmt: skip
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


def test_a_preview_does_not_change_the_training(server: FakeServer, whole: Path, tmp_path: Path) -> None:
    run = trained(tmp_path, server.address, "run", run__steps=4, run__preview_every=2)
    assert losses(run) == losses(whole)[:4]


def test_a_held_out_batch_is_judged_and_says_more_than_a_step(
    server: FakeServer, whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = trained(tmp_path, server.address, "run", run__steps=12, run__judge_every=5)
    assert losses(run) == losses(whole)
    judged = [record for record in read_metrics(run / METRICS) if "held_out_total" in record]
    assert [record["step"] for record in judged] == [0, 5, 10, 12]
    assert judged[-1]["held_out_total"] < judged[0]["held_out_total"]
    assert f"held out {judged[-2]['held_out_total']:.4f}  loss" in capsys.readouterr().out


def test_the_network_that_does_best_on_recordings_is_kept(server: FakeServer, whole: Path, tmp_path: Path) -> None:
    """Scored at the ends of epochs, without changing the training; a resumed run knows what was best before."""
    for seed in range(2):
        random_recording(tmp_path / "recordings" / f"{seed}.h5", seed=seed)
    blank = "validation_constant_grey_mse"
    validation = {"run__validate": str(tmp_path / "recordings"), "run__validate_every": 2}
    run = trained(tmp_path, server.address, "run", run__steps=23, **validation)
    assert losses(run)[:12] == losses(whole)

    def scored() -> dict[int, float]:
        return {r["step"]: r["validation_mse"] for r in read_metrics(run / METRICS) if "validation_mse" in r}

    assert list(scored()) == [10, 20]
    first_best = min(scored(), key=scored().__getitem__)
    assert load_checkpoint(run / "best.pt").step == first_best
    record = next(record for record in read_metrics(run / METRICS) if "validation_mse" in record)
    assert 0 < record["validation_correlation_lacking"] < 2
    trained(tmp_path, server.address, "run", "run/last.pt", run__steps=43, **validation)
    assert list(scored()) == [10, 20, 30, 40]
    assert load_checkpoint(run / "best.pt").step == min(scored(), key=scored().__getitem__)
    assert [r["step"] for r in read_metrics(run / METRICS) if blank in r] == [10]  # it does not change
    said = trainer_evaluation_means(run / "best.pt", tmp_path / "recordings")
    assert said["mse"] == pytest.approx(min(scored().values()), rel=1e-6)


def trainer_evaluation_means(weights: Path, recordings: Path) -> dict[str, float]:
    """What ``v2v-eval`` says of the averaged network."""
    out = weights.with_suffix(".json")
    assert (
        evaluate(
            ["--weights", str(weights), "--ema", "--data", str(recordings), "--metrics", "mse", "--json", str(out)]
        )
        == 0
    )
    scores = [record["mse"] for record in json.loads(out.read_text("utf-8")) if record.get("sequence") in ("0", "1")]
    return {"mse": float(np.mean(scores))}


@pytest.mark.parametrize("network", ["firenet", "evflownet"])
def test_recordings_that_cannot_be_scored_are_said_before_the_first_step(
    server: FakeServer, tmp_path: Path, capsys: pytest.CaptureFixture[str], network: str
) -> None:
    flow = {"loss__flow": "stream"} if network == "evflownet" else {}
    missing = refused(tmp_path, server.address, capsys, run__validate="nowhere", network__name=network, **flow)
    assert "run.validate = nowhere" in missing
    assert not (tmp_path / "run" / "last.pt").exists()


@pytest.mark.parametrize(("processor", "slow"), [("AVX2", True), ("AVX512", False)])
def test_bfloat16_in_software_is_said(
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


def test_the_configuration_of_a_run_is_beside_it(
    server: FakeServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
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
        self.brightness = nn.Conv2d(bins + 1, 1, 1)

    def unroll(self, x: Tensor, state: Tensor | None, steps: int, _guide: Guide | None) -> tuple[Tensor, Tensor]:
        picture = torch.zeros_like(x[: len(x) // steps, :1]) if state is None else state
        pictures = []
        for voxel in x.chunk(steps):
            picture = self.brightness(torch.cat([voxel, picture], dim=1))
            pictures.append(picture)
        return torch.cat(pictures), picture

    @classmethod
    def from_state(cls, state: Mapping[str, Tensor], _settings: Settings) -> dict[str, Any]:
        return {"bins": state["brightness.weight"].shape[1] - 1}


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


def test_flow_is_judged_and_shown_as_well(server: FakeServer, tmp_path: Path) -> None:
    run = trained(
        tmp_path, server.address, "run", run__steps=2, run__preview_every=2, run__judge_every=1,
        network__name="evflownet", network__options={"base_channels": 2},
        loss__flow="stream", loss__valid="consistent",
    )  # fmt: skip
    assert server.hellos[-1].arrays == ("voxels", "flow", "flow_valid")
    judged = [record for record in read_metrics(run / METRICS) if "held_out_total" in record]
    assert [record["step"] for record in judged] == [0, 1, 2]
    assert all(record["held_out_end_point_error_px"] > 0 for record in judged)
    sheet = cv2.imread(str(run / "previews" / "step-0000002-0.png"))
    height, width = 3 * (8 * 16 + 4), 3 * (8 * 20 + 4)
    assert sheet.shape[0] > height  # a title and the names of the columns above
    assert sheet.shape[1] > width  # and an arrow of time beside them


def test_a_preview_shows_no_more_samples_than_an_epoch_has(tmp_path: Path) -> None:
    with FakeServer(sequences=1) as server:
        run = trained(
            tmp_path, server.address, "run", run__steps=1, run__preview_every=1, run__judge_samples=2,
            stream__batch_size=1,
        )  # fmt: skip
    assert [path.name for path in (run / "previews").glob("*.png")] == ["step-0000001-0.png"]


def test_too_large_a_batch_is_said_with_its_own_numbers(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with FakeServer(sequences=1) as server:
        told = refused(tmp_path, server.address, capsys, run__preview_every=1, stream__batch_size=4)
    assert "no global batch of 1 x 4 = 4 samples" in told


def test_loader_workers_change_nothing(server: FakeServer, whole: Path, tmp_path: Path) -> None:
    run = trained(tmp_path, server.address, "run", run__steps=7, stream__loader_workers=1)
    assert losses(run) == losses(whole)[:7]
    trained(tmp_path, server.address, "run", resume=f"run/{LAST}", run__steps=12, stream__loader_workers=1)
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


def refused(folder: Path, address: str, capsys: pytest.CaptureFixture[str], **settings: object) -> str:
    assert main(arguments(folder, address, "run", **settings)) == 2  # type: ignore[arg-type]
    return capsys.readouterr().err


def test_a_folder_with_a_run_is_not_written_over(
    server: FakeServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    trained(tmp_path, server.address, "run", run__steps=1)
    assert "holds a run: go on with --resume" in refused(tmp_path, server.address, capsys)


@pytest.mark.parametrize("out", ["file", "file/run"])
def test_a_folder_that_cannot_be_written_is_said_before_anything_is_asked(
    server: FakeServer, tmp_path: Path, capsys: pytest.CaptureFixture[str], out: str
) -> None:
    (tmp_path / "file").touch()
    before = len(server.hellos)
    assert main(arguments(tmp_path, server.address, out, run__steps=1)) == 2
    assert re.search(r"run\.out = .*file.*; give another folder with --out", capsys.readouterr().err)
    assert len(server.hellos) == before


def test_a_folder_that_may_not_be_entered_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def denied(_: Path) -> bool:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "exists", denied)
    with pytest.raises(UsageError, match=r"run\.out = .*: Permission denied; give another folder"):
        require_fresh(tmp_path)


def test_a_run_goes_on_in_its_own_folder(server: FakeServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    without_out = ["small.yaml", "--connect", server.address, "--set", "run.steps=1"]
    trained(tmp_path, server.address, "elsewhere", run__steps=1)
    assert main(without_out) == 0
    first = (tmp_path / "runs" / "small" / LAST).read_bytes()
    assert main([*without_out, "--set", "run.steps=2", "--resume", f"elsewhere/{LAST}"]) == 0
    assert load_checkpoint(tmp_path / "elsewhere" / LAST).step == 2
    assert (tmp_path / "runs" / "small" / LAST).read_bytes() == first


def test_another_run_is_not_resumed(server: FakeServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    trained(tmp_path, server.address, "run", run__steps=1)
    message = refused(tmp_path, server.address, capsys, resume=f"run/{LAST}", optimizer__learning_rate=0.5)
    assert "optimizer.learning_rate: 0.01 -> 0.5" in message
    message = refused(tmp_path, server.address, capsys, resume=f"run/{LAST}", stream__seed=9)
    assert "stream.seed: 0 -> 9" in message


def test_other_videos_are_not_resumed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with FakeServer(sequences=23) as server:
        trained(tmp_path, server.address, "run", run__steps=1)
        server.restart(catalogue="catalogue-2")
        message = refused(tmp_path, server.address, capsys, resume=f"run/{LAST}")
    assert "catalogue_digest" in message


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
def test_what_is_missing_is_said_before_anything_is_asked_of_the_server(
    server: FakeServer, tmp_path: Path, capsys: pytest.CaptureFixture[str], settings: dict[str, object], message: str
) -> None:
    before = len(server.hellos)
    assert re.search(message, refused(tmp_path, server.address, capsys, **settings))
    assert len(server.hellos) == before
    assert not (tmp_path / "run").exists()


def test_without_videos_or_address_it_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "--videos DIR, or --connect ADDRESS" in refused(tmp_path, "", capsys)


def test_a_diverged_run_keeps_the_checkpoint_before(
    server: FakeServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = trained(tmp_path, server.address, "run", run__steps=1)
    good = load_checkpoint(run / LAST)
    spoilt = {name: tensor * torch.nan for name, tensor in good.model.items()}
    save_checkpoint(tmp_path / "spoilt.pt", dataclasses.replace(good, model=spoilt))
    assert main(arguments(tmp_path, server.address, "run", resume="spoilt.pt", run__steps=3, run__save_every=1)) == 1
    message = capsys.readouterr().err
    assert "step 2: loss nan" in message
    assert "nothing was saved since this start" in message
    assert same(load_checkpoint(run / LAST).model, good.model)


def test_a_disk_that_refuses_is_said(
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
    assert "nothing heard" in message
    assert load_checkpoint(tmp_path / "run" / LAST).step == len(losses(tmp_path / "run")) == 3
    assert (tmp_path / "run" / METRICS).is_file()


def test_a_server_that_never_was_there_leaves_no_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    message = refused(tmp_path, f"ipc://{tmp_path}/nobody", capsys, stream__timeout_seconds=0.1)
    assert "nothing heard" in message
    assert not (tmp_path / "run" / LAST).exists()
