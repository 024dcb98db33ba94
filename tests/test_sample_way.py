"""The list of a sample's way in docs/architecture.md names functions that exist, and counts them right."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
_ROW = re.compile(r"^\| [a-z ]+ \(`(v2v_\w+/)`\) \| (.*) \|$", re.M)


def steps() -> list[tuple[str, str]]:
    """Return (file, function) of each step."""
    found = [(base, *step) for base, row in _ROW.findall(PAGE) for step in re.findall(r"`([\w/]+\.py):(\w+)`", row)]
    return [(file if file.startswith("v2v_") else base + file, function) for base, file, function in found]


def test_each_step_exists() -> None:
    way = steps()
    assert len(way) > 50
    for file, function in way:
        assert re.search(rf"def {function}\b", (ROOT / file).read_text(encoding="utf-8")), (file, function)


def test_files_and_returns_are_counted() -> None:
    files = [file for file, _ in steps()]
    returns = sum(file in files[:place] and file != files[place - 1] for place, file in enumerate(files))
    assert f"{len(set(files))} files, {returns} returns" in PAGE
