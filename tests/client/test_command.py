"""Exit status and stderr of a command, by what its work raised."""

from __future__ import annotations

import argparse

import pytest

from v2v_client.command import run_command
from v2v_protocol.errors import ServerLost, UsageError, V2VError


def ended(*argv: str, raised: BaseException | None = None, status: int = 0, **settings: object) -> int:
    parser = argparse.ArgumentParser(prog="v2v-thing")
    parser.add_argument("--debug", action="store_true")

    def run(arguments: argparse.Namespace) -> int:
        if raised is not None:
            raise raised
        return status

    return run_command(parser, run, argv, **settings)  # type: ignore[arg-type]


@pytest.mark.parametrize("status", [0, 1, 143])
def test_what_the_work_returns_is_the_status(status: int, capsys: pytest.CaptureFixture[str]) -> None:
    assert ended(status=status) == status
    assert capsys.readouterr() == ("", "")


def test_an_error_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert ended(raised=UsageError("two\n  lines")) == 2
    assert capsys.readouterr().err == "v2v-thing: two lines\n"


def test_debug_shows_the_trace_before_it(capsys: pytest.CaptureFixture[str]) -> None:
    assert ended("--debug", raised=UsageError("no")) == 2
    error = capsys.readouterr().err
    assert error.startswith("Traceback")
    assert error.endswith("UsageError: no\nv2v-thing: no\n")


@pytest.mark.parametrize(("error", "status"), [(ServerLost("gone"), 1), (UsageError("no"), 2), (V2VError("no"), 2)])
def test_failures_are_told_from_what_could_not_be_done(error: V2VError, status: int) -> None:
    assert ended(raised=error, failures=(ServerLost,)) == status


def test_an_interruption(capsys: pytest.CaptureFixture[str]) -> None:
    assert ended(raised=KeyboardInterrupt()) == 130
    assert ended(raised=KeyboardInterrupt(), interrupted="interrupted early") == 130
    assert capsys.readouterr().err == "v2v-thing: interrupted\nv2v-thing: interrupted early\n"


def test_other_errors_are_not_caught() -> None:
    with pytest.raises(ZeroDivisionError):
        ended(raised=ZeroDivisionError())


def test_flags_that_nobody_knows() -> None:
    with pytest.raises(SystemExit) as stop:
        ended("--unknown")
    assert stop.value.code == 2
