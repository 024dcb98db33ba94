"""The trainer that is fed: it learns, it is counted, and one short run for real."""

from __future__ import annotations

import itertools
from pathlib import Path

import pytest
import torch

from bench.speed import gpu_feed
from tests.bench.small import FLAGS, clips, is_picture, one_line, records
from v2v_client import Batch

CPU = torch.device("cpu")


def batch() -> Batch:
    generator = torch.Generator().manual_seed(0)
    return Batch(
        arrays={
            "voxels": torch.randint(-3, 4, (2, 3, 5, 16, 16), generator=generator, dtype=torch.int8),
            "frames": torch.randint(0, 256, (2, 3, 1, 16, 16), generator=generator, dtype=torch.uint8),
        },
        indices=(0, 1), epoch=0, provenance=(), resume_state={}, wait_seconds=0.0, cpu_seconds=0.0, decodes=2,
    )  # fmt: skip


@pytest.mark.parametrize("network", ["firenet", "e2vid"])
def test_the_loss_of_a_batch_seen_again_and_again_falls(network: str) -> None:
    trainer = gpu_feed.Trainer(network, 4, 5, CPU, bfloat16=False)
    seen = batch()
    losses = [float(trainer.step(seen)) for _ in range(10)]
    assert losses[-1] < losses[0]


def test_a_stretch_counts_its_steps_after_the_warm_up() -> None:
    trainer = gpu_feed.Trainer("firenet", 2, 5, CPU, bfloat16=False)
    taken = 0

    def count() -> Batch:
        nonlocal taken
        taken += 1
        return batch()

    begun: list[int] = []
    trained = gpu_feed.train(trainer, (count() for _ in itertools.count()), 0.0, lambda: begun.append(taken))
    assert begun == [gpu_feed.WARMUP_STEPS]
    assert (trained.batches, taken) == (1, gpu_feed.WARMUP_STEPS + 1)
    assert 0 < trained.busy_seconds <= trained.seconds


@pytest.mark.slow
def test_a_short_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, picture = tmp_path / "feed.json", tmp_path / "feed.png"
    flags = ["--videos", str(clips(tmp_path / "clips")), "--rows", "full", "--batch-size", "3", "--seconds", "0.3"]
    flags += ["--workers", "1,2", "--network", "firenet", "--base-channels", "2", "--device", "cpu"]
    assert gpu_feed.main([*flags, *FLAGS, "--json", str(out), "--plot", str(picture)]) == 0
    found = records(out)
    assert [(item["measure"], item["workers"]) for item in found] == [("ceiling", None), ("fed", 1), ("fed", 2)]
    assert found[0]["share_of_ceiling"] == 1.0
    assert all(0 < item["utilisation"] <= 1 for item in found)
    assert is_picture(picture)
    assert "utilisation" in capsys.readouterr().out


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device here")
def test_a_device_that_is_not_there_is_status_2(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert gpu_feed.main(["--videos", str(tmp_path), "--device", "cuda"]) == 2
    assert one_line(capsys, "gpu_feed")
