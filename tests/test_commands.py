"""Every command line that the documentation, `deploy/` and the examples show: its flags are those of the program."""

from __future__ import annotations

import argparse
import re
from functools import cache
from importlib import import_module
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
MODULES = {
    "v2v-serve": "v2v_server.commands.serve",
    "v2v-worker": "v2v_server.commands.worker",
    "v2v-simulate": "v2v_server.commands.simulate",
    "v2v-preview": "v2v_server.commands.preview",
    "v2v-prepare": "v2v_server.commands.prepare",
    "v2v-catalogue": "v2v_server.commands.catalogue",
    "v2v-quarantine": "v2v_server.commands.quarantine",
    "v2v-top": "v2v_server.commands.top",
    "v2v-doctor": "v2v_server.commands.doctor",
    "v2v-keys": "v2v_server.commands.keys",
    "v2v-loadtest": "v2v_client.tools.loadtest",
    "v2v-train": "trainer.train",
    "v2v-eval": "trainer.evaluation.cli",
    "v2v-convert": "trainer.convert.cli",
}
"""`v2v-bench` and `make` have commands of their own."""
PAGES = sorted(
    page
    for pattern in ("README.md", "docs/*.md", "docs/guides/*.md", "docs/reference/*.md", "deploy/**/*", "examples/*.py")
    for page in ROOT.glob(pattern)
    if page.is_file()
)
"""Decisions and notes are of their day, and stay as they were."""
_LINE = re.compile(r"\b(v2v-[a-z]+)((?: [^\n`|;&#)]*)?)")
_FLAG = re.compile(r"(?<=\s)(--[a-z][a-z-]*)")


class _Caught(Exception):
    pass


@cache
def flags_of(program: str) -> frozenset[str]:
    """All flags that the program's own parser knows."""
    module = import_module(MODULES[program])
    found: list[argparse.ArgumentParser] = []

    def parse(self: argparse.ArgumentParser, *_: object) -> None:
        found.append(self)
        raise _Caught

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(argparse.ArgumentParser, "parse_args", parse)
        with pytest.raises(_Caught):
            module.main([])
    return frozenset(found[0]._option_string_actions)


def command_lines(text: str) -> list[tuple[str, list[str]]]:
    """(program, its flags) of each command line in a text; a backslash at the end of a line goes on with the next."""
    joined = re.sub(r"\\\n\s*#?\s*", " ", text)
    return [(program, _FLAG.findall(rest)) for program, rest in _LINE.findall(joined) if program in MODULES]


def test_the_reader_of_command_lines_sees_them() -> None:
    text = "Say `v2v-serve --videos DIR --bind=x`, or\n    v2v-worker --connect A \\\n      --cache B  # --no flag\n"
    assert command_lines(text) == [("v2v-serve", ["--videos", "--bind"]), ("v2v-worker", ["--connect", "--cache"])]


def test_every_program_is_asked() -> None:
    named = {value.strip('"') for value in re.findall(r"^(v2v-\w+) = ", (ROOT / "pyproject.toml").read_text(), re.M)}
    assert named - {"v2v-bench"} == set(MODULES)
    assert "--videos" in flags_of("v2v-serve")
    assert "--no-shuffle" in flags_of("v2v-serve")
    assert "--resume" in flags_of("v2v-train")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_flags_that_are_shown_exist(page: Path) -> None:
    wrong = [
        f"{program} {flag}"
        for program, flags in command_lines(page.read_text(encoding="utf-8"))
        for flag in flags
        if flag not in flags_of(program)
    ]
    assert wrong == []


def test_images_start_programs_with_flags_of_theirs() -> None:
    lists = [
        *re.findall(r"^(?:ENTRYPOINT|CMD) (\[.*\])$", (ROOT / "deploy" / "Dockerfile").read_text(), re.M),
        *re.findall(r"command: (\[\"--.*\])$", (ROOT / "deploy" / "compose.yaml").read_text(), re.M),
    ]
    assert len(lists) == 3
    assert set(_FLAG.findall(" ".join(lists).replace('"', " "))) <= flags_of("v2v-serve")
    (train,) = re.findall(r"command: (\[\"\$.*\])$", (ROOT / "deploy" / "compose.yaml").read_text(), re.M)
    assert set(_FLAG.findall(train.replace('"', " "))) <= flags_of("v2v-train")


def test_pages_with_command_lines_are_many() -> None:
    assert sum(bool(command_lines(page.read_text(encoding="utf-8"))) for page in PAGES) > 10
