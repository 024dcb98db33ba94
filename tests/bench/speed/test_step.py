"""The time of one training step: the rows that a device can run, and what is said of those that fail."""

from __future__ import annotations

import argparse

import pytest
import torch

from bench.frame import Report, parser_of
from bench.speed import step
from trainer.config_file import load_config
from v2v_protocol.errors import UsageError

SMALL = ["--device", "cpu", "--batch", "1", "--grids", "2", "--crop", "16", "--steps", "1", "--launches", "eager"]


def measured(*flags: str) -> Report:
    return step.measure(parser_of("step", step).parse_args([*flags, *SMALL]))


@pytest.mark.parametrize("config", ["firenet-cpu", "evflownet-worlds"])
def test_a_processor_runs_each_format_of_two_precisions(config: str) -> None:
    found = measured(config, "--set", "network.options.base_channels=2")
    assert [(record["precision"], record["format"]) for record in found.records] == [
        ("ieee", "NCHW"), ("ieee", "NHWC"), ("bf16", "NCHW"), ("bf16", "NHWC"),
    ]  # fmt: skip
    assert all(record["seconds"] > 0 for record in found.records)
    assert found.records[0]["ratio"] == 1
    best = min(found.records, key=lambda record: record["seconds"])
    assert list(found.lines) == [f"fastest: {best['settings']}"]
    for record in found.records:
        load_config("e2vid", record["settings"].split())  # as v2v-train takes them


def test_a_row_that_fails_says_why_and_others_run(monkeypatch: pytest.MonkeyPatch) -> None:
    def seconds_of(learner: step.Learner, _steps: int) -> float:
        if learner.config.compute.precision == "float32":
            raise torch.OutOfMemoryError("memory is short\ntrace")
        return 0.5

    monkeypatch.setattr(step, "seconds_of", seconds_of)
    found = measured()
    assert [record.get("failed") for record in found.records] == ["memory is short", "memory is short", None, None]
    assert found.lines[0].startswith("fastest: compute.precision=bfloat16")


def test_rows_without_a_device_are_refused() -> None:
    asked = parser_of("step", step).parse_args([*SMALL, "--precisions", "tf32"])
    assert isinstance(asked, argparse.Namespace)
    with pytest.raises(UsageError, match="tf32 and graph need a GPU, and the device is cpu"):
        step.measure(asked)
