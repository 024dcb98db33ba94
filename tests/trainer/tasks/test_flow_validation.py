"""Networks of flow are scored on recordings while they are trained, as `v2v-eval` scores them."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from tests.trainer.evaluation.h5_file import random_recording
from tests.trainer.evaluation.test_flow import constant, recording, run
from trainer.evaluation.flow import evaluate_flow
from trainer.tasks.flow import Flow, FlowTaskSettings
from v2v_protocol.errors import UsageError


def task() -> Flow:
    return Flow(FlowTaskSettings(flow="stream"), constant(0, 0), torch.device("cpu"), bfloat16=False)


def test_scores_are_those_of_the_evaluation(tmp_path: Path) -> None:
    files = [recording(tmp_path / "recordings" / f"{name}.h5") for name in ("indoor", "outdoor")]
    network = constant(0.3, 0.1)
    network.train()
    validate = task().validator(network, tmp_path / "recordings")
    expected = [
        evaluate_flow(run(constant(0.3, 0.1), as_published=False), file, None)["network"].means for file in files
    ]
    scores = validate()
    assert next(iter(scores)) == "aee_dense"  # decides
    for name, value in scores.items():
        assert value == pytest.approx((expected[0][name] + expected[1][name]) / 2)
    assert network.training
    with torch.no_grad():
        network.unet.pred.conv2d.bias.add_(5.0)  # type: ignore[union-attr, operator]
    assert validate()["aee_dense"] > scores["aee_dense"]


def test_recordings_without_flow_are_refused_at_once(tmp_path: Path) -> None:
    random_recording(tmp_path / "a.h5")
    with pytest.raises(UsageError, match="has 0 flow fields"):
        task().validator(constant(0, 0), tmp_path)
    with pytest.raises(UsageError, match="no such file or folder"):
        task().validator(constant(0, 0), tmp_path / "nowhere")
