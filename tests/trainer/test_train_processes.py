"""Training as a process: ended by a signal, on two ranks, with a server of its own."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from itertools import islice
from pathlib import Path

import av
import cv2
import numpy as np
import psutil
import pytest
import torch
import yaml

from tests.client.fake_server import FakeServer
from tests.clips import panned_luma, write_clip
from tests.trainer.evaluation.h5_file import random_recording
from tests.trainer.training import OF_THE_CLOCK, arguments, losses, trained
from trainer.config_file import load_config
from trainer.feed import held_out_batch
from trainer.learner import build
from trainer.run.checkpoint import BEST, LAST, load_checkpoint
from trainer.run.distributed import Ranks
from trainer.run.reporting import METRICS_FILE, read_metrics
from trainer.train import main

ROOT = Path(__file__).parents[2]
ALONE = Ranks(0, 1, torch.device("cpu"))
TRAIN = (sys.executable, "-m", "trainer.train")
TORCHRUN = (sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2")


@pytest.fixture(autouse=True)
def _one_thread_each(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "1")


def until_step(process: subprocess.Popen[str], step: int) -> None:
    """Reads what a run says until it has said that step."""
    assert process.stdout is not None
    said = []
    for line in process.stdout:
        said.append(line)
        if line.startswith(f"step {step}/"):
            return
    raise AssertionError("".join(said))


def test_ctrl_c_ends_the_run_and_saves_it(server: FakeServer, tmp_path: Path) -> None:
    command = [*TRAIN, *arguments(tmp_path, server.address, "run")]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
        until_step(process, 2)
        process.send_signal(signal.SIGINT)
        rest = process.communicate()[0]
    assert process.returncode == 128 + signal.SIGINT
    assert "ended by signal" in rest
    run = tmp_path / "run"
    step = load_checkpoint(run / LAST).step
    assert step == len(losses(run)) >= 2
    trained(tmp_path, server.address, "run", resume=f"run/{LAST}", run__steps=step + 3)
    whole = trained(tmp_path, server.address, "whole", run__steps=step + 3)
    assert losses(run) == losses(whole)


@pytest.mark.slow
def test_two_ranks_train_as_one_with_twice_the_batch(server: FakeServer, tmp_path: Path) -> None:
    """The ranks' samples are those of one global batch, and their gradients are averaged."""
    alone = trained(tmp_path, server.address, "alone", stream__batch_size=6, run__steps=5)
    command = [*TORCHRUN, "-m", "trainer.train"]
    first = arguments(tmp_path, server.address, "both", stream__batch_size=3, run__steps=2)
    done = subprocess.run([*command, *first], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("done after step 2") == 1  # only the first rank speaks
    again = arguments(tmp_path, server.address, "both", f"both/{LAST}", stream__batch_size=3, run__steps=5)
    command = [*TORCHRUN, "-m", "tests.trainer.one_rank"]
    done = subprocess.run([*command, *again], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    one, two = losses(alone), losses(tmp_path / "both")
    assert [record["step"] for record in two] == [1, 2, 3, 4, 5]
    for mine, theirs in zip(two, one, strict=True):
        assert mine["total"] == pytest.approx(theirs["total"], rel=1e-4)
        assert mine["gradient_norm"] == pytest.approx(theirs["gradient_norm"], rel=1e-3)
        assert mine["epoch"] == theirs["epoch"]


@pytest.mark.slow
def test_two_ranks_with_validation_go_on_after_a_kill_as_if_there_had_been_none(
    server: FakeServer, tmp_path: Path
) -> None:
    """Losses, held-out losses, scores, weights and the best network; batch norm differs between the ranks."""
    for seed, name in enumerate(("a/0", "a/1", "b/0")):
        random_recording(tmp_path / "recordings" / f"{name}.h5", seed=seed)
    data_sets = [{"name": "a", "sequences": {"0": [0, 0.06], "1": None}}, {"name": "b", "sequences": ["0"]}]
    (tmp_path / "validate.yaml").write_text(yaml.safe_dump({"data": data_sets}), encoding="utf-8")

    def command(out: str, resume: str | None = None) -> list[str]:
        given = arguments(
            tmp_path, server.address, out, resume, stream__batch_size=2, run__steps=13, run__save_every=3,
            run__judge_every=4, run__validate=str(tmp_path / "recordings"),
            run__validate_config=str(tmp_path / "validate.yaml"), network__name="e2vid",
            network__options={"base_channels": 2, "encoders": 1, "norm": "batch"},
        )  # fmt: skip
        return [*TORCHRUN, "-m", "trainer.train", *given]

    def records(out: str) -> list[dict[str, object]]:
        found = read_metrics(tmp_path / out / METRICS_FILE)
        return [{name: value for name, value in each.items() if name not in OF_THE_CLOCK} for each in found]

    whole = subprocess.run(command("whole"), cwd=ROOT, capture_output=True, text=True, check=False)
    assert whole.returncode == 0, whole.stderr
    scores = [record for record in records("whole") if "validation_mse" in record]
    assert [record["step"] for record in scores] == [5, 10]
    with subprocess.Popen(
        command("killed"), cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    ) as process:
        until_step(process, 7)
        family = [*psutil.Process(process.pid).children(recursive=True), psutil.Process(process.pid)]
        for each in family:
            each.kill()
        process.communicate()
    psutil.wait_procs(family)
    assert load_checkpoint(tmp_path / "killed" / LAST).step == 6
    again = subprocess.run(command("killed", f"killed/{LAST}"), cwd=ROOT, capture_output=True, text=True, check=False)
    assert again.returncode == 0, again.stderr
    assert records("killed") == records("whole")
    for name in (LAST, BEST):
        ours, theirs = (load_checkpoint(tmp_path / out / name) for out in ("killed", "whole"))
        assert ours.step == theirs.step
        for mine, other in ((ours.model, theirs.model), (ours.ema or {}, theirs.ema or {})):
            assert all(torch.equal(mine[key], other[key]) for key in other)


@pytest.fixture(scope="module")
def clips(compiled: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four small films: 16 sequences of 16 frames."""
    folder = tmp_path_factory.mktemp("clips")
    for number in range(4):
        write_clip(folder / f"{number}.mp4", panned_luma(61, 48, 64, step=(1, 1 + number)), gop=15)
    return folder


@pytest.mark.slow
def test_with_a_local_server_a_resumed_run_equals_the_uninterrupted_one(clips: Path, tmp_path: Path) -> None:
    """The server of the second half is another process, with another number of workers."""

    def run(out: str, steps: int, *more: str) -> Path:
        given = arguments(
            tmp_path, "", out, run__steps=steps, stream__videos=str(clips),
            stream__recipe={"voxels_per_clip": 3, "crop_height_px": 32, "crop_width_px": 32},
        )  # fmt: skip
        assert main([*given, *more]) == 0
        return tmp_path / out

    before = set(psutil.Process().children(recursive=True))
    whole = run("whole", 6, "--workers", "1")
    run("half", 3, "--workers", "2")
    half = run("half", 6, "--workers", "1", "--resume", str(tmp_path / "half" / LAST))
    assert losses(half) == losses(whole)
    assert load_checkpoint(half / LAST).stream == load_checkpoint(whole / LAST).stream
    assert set(psutil.Process().children(recursive=True)) <= before


@pytest.mark.slow
def test_a_run_is_scored_on_videos_it_does_not_train_on(
    server: FakeServer, clips: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The held-out batch comes from a server of its own, which is gone when training begins."""
    before = set(psutil.Process().children(recursive=True))
    recipe = {"voxels_per_clip": 3, "bins": 2, "crop_height_px": 16, "crop_width_px": 20}
    given = arguments(tmp_path, server.address, "run", run__judge_videos=str(clips), stream__recipe=recipe)
    config = load_config(given[0], given[given.index("--set") + 1 :: 2])
    asked = build(config, ALONE).task.asked
    batches = list(held_out_batch(config, asked, server.address))
    assert len(batches) == 1
    assert {Path(each.video).name for each in batches[0].provenance} <= {f"{number}.mp4" for number in range(4)}
    assert len(batches[0].provenance) == config.run.judge_samples
    assert set(psutil.Process().children(recursive=True)) <= before
    missing = arguments(tmp_path, server.address, "other", run__judge_every=1, run__judge_videos="nowhere")
    assert main(missing) == 2
    assert "run.judge_videos = nowhere: " in capsys.readouterr().err


@pytest.mark.slow
def test_ctrl_c_reaches_its_server_as_well(clips: Path, tmp_path: Path) -> None:
    """As in a terminal: every process of the group has the signal, and the data ends at once."""
    recipe = {"voxels_per_clip": 3, "crop_height_px": 32, "crop_width_px": 32}
    given = arguments(tmp_path, "", "run", stream__videos=str(clips), stream__recipe=recipe)
    command = [*TRAIN, *given, "--workers", "1"]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True, start_new_session=True) as process:
        until_step(process, 2)
        os.killpg(process.pid, signal.SIGINT)
        process.communicate()
    assert process.returncode == 128 + signal.SIGINT
    assert load_checkpoint(tmp_path / "run" / LAST).step == len(losses(tmp_path / "run")) >= 2


REAL = Path(os.environ.get("V2V_DEMO_VIDEOS", ROOT / ".demo" / "videos"))
SIDE_PX = 48


def small_copy(source: Path, target: Path, frames: int) -> None:
    """The middle of a film's first frames, shrunk to one crop, so that every sample shows the same."""
    luma = []
    with av.open(str(source)) as container:
        for frame in islice(container.decode(video=0), frames):
            grey = frame.to_ndarray(format="gray")
            side, left = grey.shape[0], (grey.shape[1] - grey.shape[0]) // 2
            luma.append(cv2.resize(grey[:, left : left + side], (SIDE_PX, SIDE_PX), interpolation=cv2.INTER_AREA))
    write_clip(target, np.stack(luma))


@pytest.mark.slow
@pytest.mark.skipif(not (REAL / "bikes.mp4").is_file(), reason=f"no bikes.mp4 in {REAL}: `make demo` fetches it")
def test_the_tiny_configuration_overfits_two_real_clips(tmp_path: Path) -> None:
    """The same two samples again and again: their error falls to less than half of what it was at the start."""
    for name in ("bikes.mp4", "carphone_pristine.mp4"):
        (tmp_path / "videos").mkdir(exist_ok=True)
        small_copy(REAL / name, tmp_path / "videos" / name, 51)
    camera = {
        "preset": "noise-free", "voxels_per_clip": 10, "crop_height_px": SIDE_PX, "crop_width_px": SIDE_PX,
        "threshold": 0.15, "threshold_ratio": 1.0, "flip_probability": 0.0,
    }  # fmt: skip
    settings = {
        "run.seconds": 0, "run.steps": 80, "run.log_every": 5, "run.preview_every": 0, "stream.recipe": camera,
    }  # fmt: skip
    changes = [text for key, value in settings.items() for text in ("--set", f"{key}={json.dumps(value)}")]
    given = ["tiny-cpu", "--videos", str(tmp_path / "videos"), "--out", str(tmp_path / "run"), *changes]
    assert main(given) == 0
    readings = losses(tmp_path / "run")
    assert (readings[-1]["step"], readings[-1]["epoch"]) == (80, 79)
    assert readings[-1]["total"] < 0.5 * readings[0]["total"]
