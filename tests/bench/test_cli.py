"""``v2v-bench``: one line for what went wrong, and a status."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest

from bench import cli, corpus
from bench.speed import kernel


def test_a_file_that_cannot_be_written_is_one_line_after_what_was_measured(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    each = {
        "cpu_seconds_per_sample": 1.0, "cpu_seconds_per_pixel_step": 1.0, "ratio_to_released": 1.0,
        "median_cpu_seconds_per_sample": 1.0, "median_ratio_to_released": 1.0,
    }  # fmt: skip
    monkeypatch.setattr(kernel, "measure", lambda turns: [{"name": "kernel", **each}])
    assert cli.main(["kernel", "--json", str(tmp_path)]) == 2
    said = capsys.readouterr()
    assert said.out.startswith("kernel ")
    assert said.err == f"v2v-bench kernel: --json {tmp_path}: cannot be written: Is a directory\n"


def test_an_error_of_the_system_is_one_line_too(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full() -> int:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(corpus, "main", full)
    assert cli.main(["corpus"]) == 2
    assert capsys.readouterr().err == "v2v-bench corpus: [Errno 28] No space left on device\n"


def test_what_is_unknown_is_named_with_what_is_known(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["zzz"]) == 2
    assert "no benchmark 'zzz'; known: throughput, kernel, transport, " in capsys.readouterr().err


@pytest.mark.parametrize(
    ("command", "said"),
    [
        ("throughput --videos clips --turns 0", "--turns 0: give 1 or more"),
        ("throughput --videos clips --workers 0", "--workers 0: give 1 or more"),
        ("throughput --videos clips --batch-size 0", "--batch-size 0: give 1 or more"),
        ("throughput --videos clips --warmup-batches -1", "--warmup-batches -1: give 0 or more"),
        ("limits --videos clips --batch-size 0", "--batch-size 0: give 1 or more"),
        ("training_trade --videos clips --held-out more --samples 0", "--samples 0: give 1 or more"),
        ("gpu_feed --videos clips --device gpu", "--device gpu: give cuda, cuda:N or cpu"),
    ],
)
def test_what_cannot_be_measured_is_refused_in_a_line(
    command: str, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    name, *rest = command.split()
    assert cli.main([name, *rest]) == 2
    assert capsys.readouterr().err == f"{name}: {said}\n"


def test_no_turn_of_the_kernel_is_refused_too(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        cli.main(["kernel", "--turns", "0"])
    assert ended.value.code == 2
    assert "--turns 0: give 1 or more" in capsys.readouterr().err


def test_a_signal_ends_a_benchmark_in_order(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    ended: list[str] = []

    def signalled(number: signal.Signals) -> None:
        try:
            signal.raise_signal(number)
        finally:
            ended.append(number.name)  # processes and folders, say

    before = signal.getsignal(signal.SIGTERM)
    monkeypatch.setattr(corpus, "main", lambda: signalled(signal.SIGTERM))
    with pytest.raises(SystemExit) as exit_:
        cli.main(["corpus"])
    assert exit_.value.code == 143
    assert signal.getsignal(signal.SIGTERM) is before
    monkeypatch.setattr(corpus, "main", lambda: signalled(signal.SIGINT))
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored where a shell began this behind itself
    try:
        assert cli.main(["corpus"]) == 130
    finally:
        signal.signal(signal.SIGINT, before)
    assert capsys.readouterr().err == "v2v-bench corpus: interrupted\n"
    assert ended == ["SIGTERM", "SIGINT"]
