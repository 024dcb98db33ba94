"""Check the reference page of all keys, and the flags that the documentation names."""

from __future__ import annotations

import re
import runpy
import sys
import tomllib
from pathlib import Path

import pytest

from v2v_protocol import programs

FOLDER = Path(__file__).parents[1] / "docs" / "reference"
SCRIPTS = tomllib.loads((FOLDER.parents[1] / "pyproject.toml").read_text("utf-8"))["project"]["scripts"]


def test_the_page_of_keys_matches_the_source() -> None:
    page = runpy.run_path(str(FOLDER / "make_keys.py"))["page"]()
    assert (FOLDER / "keys.md").read_text("utf-8") == page, "run: python docs/reference/make_keys.py"


def flags_of(program: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> set[str]:
    monkeypatch.setattr(sys, "argv", [program, "--help"])
    assert not getattr(programs, SCRIPTS[program].partition(":")[2])()
    shown = capsys.readouterr().out
    listed = [line for line in shown.splitlines() if line.startswith("  -")]
    return {flag for line in listed for flag in re.findall(r"--[a-z-]+", re.split("  +", line.strip())[0])}


@pytest.mark.parametrize("program", sorted(SCRIPTS.keys() - {"v2v"}))
def test_every_flag_in_the_documentation_exists(
    program: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """In code: a line that begins with the program's name, or such a piece between backticks. Dated notes and
    decisions may name what has gone since."""
    known = flags_of(program, monkeypatch, capsys)
    assert "--version" in known
    pages = [path for path in FOLDER.parent.rglob("*.md") if path.parent.name not in ("notes", "decisions")]
    for page in (FOLDER.parents[1] / "README.md", *pages):
        text = page.read_text("utf-8").replace("\\\n", " ")
        commands = re.findall(rf"^\s*(?:\$ )?{program} ([^\n`]*)$|`{program} ([^`\n]*)`", text, re.MULTILINE)
        for command in ("".join(parts) for parts in commands):
            unknown = set(re.findall(r"(?<!\S)(--[a-z][a-z-]*)", command)) - known
            assert not unknown, f"{page.name}: {program} {command}"
