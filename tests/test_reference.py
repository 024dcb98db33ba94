"""Check the reference page of all keys, and the flags that the documentation names."""

from __future__ import annotations

import runpy
from pathlib import Path

FOLDER = Path(__file__).parents[1] / "docs" / "reference"


def test_the_page_of_keys_matches_the_source() -> None:
    page = runpy.run_path(str(FOLDER / "make_keys.py"))["page"]()
    assert (FOLDER / "keys.md").read_text("utf-8") == page, "run: python docs/reference/make_keys.py"
