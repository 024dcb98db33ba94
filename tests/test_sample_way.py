"""The table of a sample's way in docs/architecture.md says what the traced functions do, and counts its files right."""

import re

import pytest

from tests.clips import panned_luma, write_clip
from tests.tools.trace import PAGE, Way, section, sentence, trace

_ROW = re.compile(r"^\| (?:consumer|server|worker) \| `([\w/]+\.py)` \| `([\w.<>]+)` \| (.*) \|$", re.M)
_TEXT = PAGE.read_text("utf-8")
_RUN = "run: python -m tests.tools.trace --write"


def steps() -> list[tuple[str, str]]:
    """Return (file, function) of each step."""
    return [(file, name.rpartition(".")[2]) for file, name, _ in _ROW.findall(_TEXT)]


def test_each_step_exists_and_is_described_in_its_own_words() -> None:
    rows = _ROW.findall(_TEXT)
    assert len(rows) > 50
    for file, name, said in rows:
        assert said == sentence(file, name), f"{file}: {_RUN}"


def test_the_files_are_counted() -> None:
    assert f": {len({file for file, _ in steps()})} files, and " in _TEXT, _RUN


def test_only_what_every_run_passes_counts() -> None:
    """A busy host adds pings and waits, which come at any time."""
    a, b, c, ping = ("a.py", "f"), ("b.py", "f"), ("a.py", "g"), ("p.py", "ping")
    quiet, busy = Way([[a, b, c]], {ping}), Way([[a, ping, b, c, ("b.py", "wait")]], set())
    common = Way.common([busy, quiet])
    assert common.steps == [[a, b, c]]
    assert (common.files, common.returns, common.idle) == (2, 1, {ping})


def test_a_row_is_a_file_at_its_first_function() -> None:
    way = Way(
        [
            [
                ("tests/tools/trace.py", "sentence"),
                ("tests/tools/statements.py", "main"),
                ("tests/tools/trace.py", "main"),
            ]
        ],
        set(),
    )
    rows = [line for line in section(way).splitlines() if line.startswith("| server")]
    assert [row.split(" | ")[1:3] for row in rows] == [
        ["`tests/tools/trace.py`", "`sentence`"],
        ["`tests/tools/statements.py`", "`main`"],
    ]
    assert "Print one line for each folder" in rows[1]


@pytest.mark.slow
def test_the_table_has_the_files_of_a_trace(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Which function of a file comes first, and a few returns, may depend on how busy the host is."""
    clip = write_clip(tmp_path_factory.mktemp("clip") / "clip.mp4", panned_luma(200, 48, 64), gop=200, b_frames=2)
    way = trace(tmp_path_factory.mktemp("run"), clip)
    rows = [re.findall(r"^\| (consumer|server|worker) \| `(\S+)`", text, re.M) for text in (section(way), _TEXT)]
    assert sorted(rows[0]) == sorted(rows[1]), _RUN
    returns = int(re.findall(r"and (\d+) returns to an earlier one", _TEXT)[0])
    assert way.returns == pytest.approx(returns, rel=0.05), _RUN
