"""The held-out batch, and recordings that are scored at the ends of epochs, of whole runs."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.client.fake_server import FakeServer
from tests.trainer.evaluation.h5_file import random_recording
from tests.trainer.training import arguments, losses, refused, trained
from trainer.evaluation.cli import main as evaluate
from trainer.evaluation.evaluate import evaluate_sequence
from trainer.run.checkpoint import LAST, load_checkpoint
from trainer.run.reporting import METRICS_FILE, read_metrics
from trainer.train import main


def test_a_held_out_batch_is_scored(
    server: FakeServer, whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = trained(tmp_path, server.address, "run", run__steps=12, run__judge_every=5)
    assert losses(run) == losses(whole)
    judged = [record for record in read_metrics(run / METRICS_FILE) if "held_out_total" in record]
    assert [record["step"] for record in judged] == [0, 5, 10, 12]
    assert judged[-1]["held_out_total"] < judged[0]["held_out_total"]
    assert f"held out {judged[-2]['held_out_total']:.4f}  loss" in capsys.readouterr().out


def test_the_best_network_on_recordings_is_kept(server: FakeServer, whole: Path, tmp_path: Path) -> None:
    """Scored at the ends of epochs, without changing the training; a resumed run knows what was best before."""
    for seed in range(2):
        random_recording(tmp_path / "recordings" / f"{seed}.h5", seed=seed)
    blank = "validation_constant_grey_mse"
    validation = {"run__validate": str(tmp_path / "recordings"), "run__validate_every": 2}
    run = trained(tmp_path, server.address, "run", run__steps=23, **validation)
    assert losses(run)[:12] == losses(whole)

    def scored() -> dict[int, float]:
        return {r["step"]: r["validation_mse"] for r in read_metrics(run / METRICS_FILE) if "validation_mse" in r}

    assert list(scored()) == [10, 20]
    first_best = min(scored(), key=scored().__getitem__)
    assert load_checkpoint(run / "best.pt").step == first_best
    record = next(record for record in read_metrics(run / METRICS_FILE) if "validation_mse" in record)
    assert 0 < record["validation_correlation_lacking"] < 2
    trained(tmp_path, server.address, "run", "run/last.pt", run__steps=33, **validation)
    assert list(scored()) == [10, 20, 30]
    assert load_checkpoint(run / "best.pt").step == min(scored(), key=scored().__getitem__)
    assert [r["step"] for r in read_metrics(run / METRICS_FILE) if blank in r] == [10]  # it does not change
    said = trainer_evaluation_means(run / "best.pt", tmp_path / "recordings")
    assert said["mse"] == pytest.approx(min(scored().values()), rel=1e-6)


def test_a_validation_that_did_not_end_comes_first_when_the_run_goes_on(
    server: FakeServer, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """One that failed loses no steps, one that is to stop ends early; the scores are those of an unbroken run."""
    random_recording(tmp_path / "recordings" / "a.h5")
    settings: dict[str, Any] = {"run__validate": str(tmp_path / "recordings"), "run__steps": 7}

    def scored(run: Path) -> list[dict[str, float]]:
        return [record for record in read_metrics(run / METRICS_FILE) if "validation_mse" in record]

    whole = trained(tmp_path, server.address, "whole", **settings)
    with monkeypatch.context() as patched:

        def lost(*_: object, **__: object) -> None:
            raise OSError(5, "Input/output error")

        patched.setattr("trainer.tasks.reconstruction.evaluate_sequence", lost)
        assert "Input/output error" in refused(tmp_path, server.address, capsys, **settings)
    assert load_checkpoint(tmp_path / "run" / LAST).step == 5
    with monkeypatch.context() as patched:

        def signalled(*given: Any, **named: Any) -> Any:
            os.kill(os.getpid(), signal.SIGTERM)
            return evaluate_sequence(*given, **named)

        patched.setattr("trainer.tasks.reconstruction.evaluate_sequence", signalled)
        random_recording(tmp_path / "recordings" / "b.h5", seed=1)
        assert main(arguments(tmp_path, server.address, "run", f"run/{LAST}", **settings)) == 128 + signal.SIGTERM
        (tmp_path / "recordings" / "b.h5").unlink()
    assert scored(tmp_path / "run") == []
    assert load_checkpoint(tmp_path / "run" / LAST).step == 5
    run = trained(tmp_path, server.address, "run", f"run/{LAST}", **settings)
    assert scored(run) == scored(whole)
    assert [record["step"] for record in scored(run)] == [5]
    assert losses(run) == losses(whole)


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
