"""The size of three parts of the house, as a guard. Statements are counted by AST, docstrings apart."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.clips import panned_luma, write_clip
from tests.test_sample_way import steps
from tests.tools.statements import statements_of
from tests.tools.trace import trace

ROOT = Path(__file__).parents[1]
PARTS = {
    "service": (21920, ("v2v_protocol", "v2v_server", "v2v_client")),
    "workshop": (5520, ("v2v_tools", "v2v_recordings", "v2v_pictures")),
    "trainer": (4400, ("trainer",)),
}
"""Most statements of each part, and its packages: what they have, rounded up. See docs/decisions/0018-the-house.md."""
WAY_FILES, WAY_RETURNS = 78, 265
"""Files that a sample visits, and returns to earlier ones: 77 and 254 measured; a busy host adds pings and waits."""


@pytest.mark.parametrize("part", PARTS)
def test_no_part_grows_beyond_its_limit(part: str) -> None:
    limit, packages = PARTS[part]
    paths = [path for package in packages for path in (ROOT / package).rglob("*.py")]
    statements = sum(statements_of(path.read_text("utf-8")) for path in paths)
    assert statements <= limit, f"{part} ({', '.join(packages)}) has {statements} statements, the limit is {limit}"


@pytest.mark.slow
def test_the_way_of_a_sample_does_not_grow(tmp_path: Path) -> None:
    """The page's list names functions that a sample passes, and their number has a limit."""
    clip = tmp_path / "clip.mp4"
    write_clip(clip, panned_luma(200, 48, 64), gop=200, b_frames=2)
    (tmp_path / "run").mkdir()
    way = trace(tmp_path / "run", clip)
    assert way.files <= WAY_FILES
    assert way.returns <= WAY_RETURNS
    passed = way.idle.union(*way.steps)
    assert set(steps()) - passed == set()
