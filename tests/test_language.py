"""Product code uses plain words, and pages hold no marks of an unfinished merge."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGES = (
    "v2v_protocol",
    "v2v_server",
    "v2v_tools",
    "v2v_client",
    "v2v_pictures",
    "v2v_recordings",
    "trainer",
    "examples",
)
FORBIDDEN = re.compile(
    r"\b(nobody|whoever|anew|shall|lest|thereby|hence|for ever|of late|as it was|so many|so long|so much)\b", re.I
)
ALLOWED = ("so many specs share a table",)
"""Parts of lines that may use a forbidden word in another meaning."""


def found(path: Path) -> list[str]:
    lines = path.read_text(encoding="utf-8").splitlines()
    return [
        f"{path.relative_to(ROOT)}:{number}: {line.strip()}"
        for number, line in enumerate(lines, 1)
        if FORBIDDEN.search(line) and not any(part in line for part in ALLOWED)
    ]


def sources() -> list[Path]:
    return [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]


def test_packages_use_no_forbidden_words() -> None:
    checked = sources()
    assert checked
    assert [line for path in checked for line in found(path)] == []


def test_pages_hold_no_marks_of_a_merge() -> None:
    pages = [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")]
    assert ROOT / "docs" / "accuracy.md" in pages
    marks = ("<<<<<<<", ">>>>>>>", "|||||||")
    assert [
        str(page) for page in pages for line in page.read_text("utf-8").splitlines() if line.startswith(marks)
    ] == []
