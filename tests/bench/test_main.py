"""``python -m bench``: its status, its one line for what went wrong, its flags."""

from __future__ import annotations

import argparse
import signal
from pathlib import Path

import pytest

from bench import corpus
from bench.__main__ import BENCHES, main, parser_for, usage
from bench.frame import Report
from tests.bench.small import records


def result(*missed: str) -> Report:
    made = [{"name": "a", "seconds": 2.0, "nothing": None}]
    return Report(made, [(made, (("name", "", "{}", 1), ("seconds", "ms", "{:.0f}", 1e3)))], ["below"], missed)


def run(monkeypatch: pytest.MonkeyPatch, measure: object, *flags: str) -> int:
    monkeypatch.setattr(corpus, "measure", measure)
    return main(["corpus", "--out", "x", "y", *flags])


def test_tables_records_and_bars(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    file = tmp_path / "out.json"
    assert run(monkeypatch, lambda asked: result(), "--json", str(file)) == 0
    assert capsys.readouterr().out.split() == ["ms", "a", "2000", "below"]
    assert records(file) == [{"name": "a", "seconds": 2.0, "nothing": None}]
    assert run(monkeypatch, lambda asked: result("too slow")) == 1
    assert capsys.readouterr().err == "bar missed: too slow\n"


def test_a_file_that_cannot_be_written_is_one_line_before_the_work(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert run(monkeypatch, lambda asked: result(), "--json", str(tmp_path)) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err == f"python -m bench corpus: --json {tmp_path}: it is a folder; give the name of a file\n"


def test_an_error_of_the_system_is_one_line_and_debug_shows_its_trace(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(asked: argparse.Namespace) -> Report:
        raise OSError(28, "No space left on device")

    assert run(monkeypatch, full) == 2
    assert capsys.readouterr().err == "python -m bench corpus: [Errno 28] No space left on device\n"
    assert run(monkeypatch, full, "--debug") == 2
    assert "Traceback" in capsys.readouterr().err


def test_an_unknown_bench_is_named_with_the_known_ones(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["zzz"]) == 2
    assert "no bench 'zzz'; known: corpus, throughput, " in capsys.readouterr().err


def test_every_bench_has_a_parser_and_a_line_in_the_list() -> None:
    shown = usage()
    for name in BENCHES:
        assert "--json" in parser_for(name)._option_string_actions
        assert f"\n  {name} " in shown


@pytest.mark.parametrize(
    ("command", "said"),
    [
        ("throughput --videos clips --turns 0", "argument --turns: 0: give 1 or more"),
        ("throughput --videos clips --warmup-batches -1", "argument --warmup-batches: -1: give 0 or more"),
        ("throughput --videos clips --prepared folder", "argument --prepared: folder: write NAME=DIR"),
        ("throughput --videos clips --presets faster", "--presets faster: choose from exact, balanced, fast"),
        ("scaling --videos clips --workers 1,0", "argument --workers: 0: give 1 or more"),
        ("kernel --turns 1.5", "argument --turns: invalid"),
        ("link --videos clips --mbit 0", "argument --mbit: 0: give a finite number above 0"),
        ("soak --videos clips --minutes nan", "argument --minutes: nan: give a finite number above 0"),
        ("chaos --videos clips --faults worker-kill,typo", "--faults typo: choose from worker-kill, "),
        ("siege --footage film --kinds refused", "--kinds refused: choose from headers, "),
        ("fuzz --live 5", "--live needs a corpus: give --videos DIR"),
        ("flow --videos none", "No such file or directory: 'none'"),
    ],
)
def test_wrong_usage_is_one_line(command: str, said: str, capsys: pytest.CaptureFixture[str]) -> None:
    name, *rest = command.split()
    assert main([name, *rest]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"python -m bench {name}: ")
    assert said in error
    assert error.count("\n") == 1


def test_a_signal_ends_a_bench_in_order(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    ended: list[str] = []

    def signalled(number: signal.Signals) -> None:
        try:
            signal.raise_signal(number)
        finally:
            ended.append(number.name)  # as processes and folders are

    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(SystemExit) as exit_:
        run(monkeypatch, lambda asked: signalled(signal.SIGTERM))
    assert exit_.value.code == 143
    assert signal.getsignal(signal.SIGTERM) is before
    interrupt = signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored in a shell's background job
    try:
        assert run(monkeypatch, lambda asked: signalled(signal.SIGINT)) == 130
    finally:
        signal.signal(signal.SIGINT, interrupt)
    assert capsys.readouterr().err == "python -m bench corpus: interrupted\n"
    assert ended == ["SIGTERM", "SIGINT"]
