"""Exit status and stderr of a command, by what its work raised."""

from __future__ import annotations

import argparse
from dataclasses import dataclass

import pytest

from v2v_protocol.command import Parser, run_command
from v2v_protocol.errors import ServerLost, UsageError, V2VError
from v2v_protocol.settings import number, switch, text, whole, word


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


# --- flags from settings ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Toy:
    size_px: int = whole(3, 1, 10, "how large", unit="px", group="Shape")
    share: float = number(0.5, 0.0, 1.0, "how many per 100 %")
    is_on: bool = switch(False, "whether")
    kind: str = word("apple", ("apple", "pear"), "which", group="Kind")
    name: str = text("", "of whom", metavar="WHO")
    secret: int = whole(0, 0, 9, "a program's own", is_hidden=True)


def toy() -> Parser:
    parser = Parser("v2v-toy", "[flags]", "Toys.", ["v2v-toy --kind pear"], "Exit status: 0.")
    parser.add_settings(Toy)
    return parser


def test_settings_are_flags_and_what_is_not_given_is_none() -> None:
    given = vars(toy().parse_args(["--size-px", "4", "--share=0", "--is-on", "--kind", "pear", "--secret", "3"]))
    assert given == {
        "debug": False,
        "size_px": 4,
        "share": 0.0,
        "is_on": True,
        "kind": "pear",
        "name": None,
        "secret": 3,
    }
    assert vars(toy().parse_args(["--no-is-on"]))["is_on"] is False


def test_the_help_has_groups_defaults_units_and_examples() -> None:
    shown = toy().format_help()
    for part in (
        "\nShape:\n  --size-px N", "how large (default 3 px)", "how many per 100 % (default 0.5)", "(default off)",
        "\nKind:\n  --kind {apple,pear}", "--name WHO", "examples:\n  v2v-toy --kind pear\n\nExit status: 0.",
    ):  # fmt: skip
        assert part in shown
    assert "secret" not in shown
    assert shown.index("Kind:") < shown.index("General:")


@pytest.mark.parametrize(
    ("argv", "said"),
    [
        (["--size", "4"], "unknown flag --size (did you mean '--size-px'?)"),
        (["--zzz"], "unknown flag --zzz"),
        (["--share", "2", "--knid=pear"], "unknown flag --knid (did you mean '--kind'?)"),
        (["--size-px", "11"], "argument --size-px: '11': give a whole number from 1 to 10 px"),
        (["--size-px", "many"], "argument --size-px: 'many': give a whole number from 1 to 10 px"),
        (["--share", "nan"], "argument --share: 'nan': give a number from 0 to 1"),
        (["--kind", "peer"], "argument --kind: 'peer': choose one of apple, pear (did you mean 'pear'?)"),
        (["pear"], "unrecognized arguments: pear"),
    ],
)
def test_a_wrong_flag_is_one_line_with_its_remedy(
    argv: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_command(toy(), lambda arguments: None, argv) == 2
    assert capsys.readouterr().err == f"v2v-toy: {said}; v2v-toy --help shows all flags\n"
