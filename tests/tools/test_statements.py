"""The count of statements."""

from pathlib import Path

from tests.tools.statements import statements_of, statements_under

SOURCE = '"""Module."""\nx = 1\n\ndef f():\n    """Do."""\n    "text"\n    return x\n'


def test_docstrings_are_not_statements() -> None:
    assert statements_of(SOURCE) == 3


def test_a_folder_counts_the_files_below_it(tmp_path: Path) -> None:
    (tmp_path / "below").mkdir()
    (tmp_path / "a.py").write_text(SOURCE)
    (tmp_path / "below" / "b.py").write_text("if x:\n    y = 1\n")
    (tmp_path / "below" / "c.txt").write_text("x = 1\n")
    assert statements_under(tmp_path) == 5
