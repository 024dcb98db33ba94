"""Test that the notebook runs from its first cell to its last, and shows what its text describes."""

from __future__ import annotations

import ast
import json
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from tests.clips import write_panned

NOTEBOOK = Path(__file__).parents[1] / "examples" / "first_steps.ipynb"
CELLS = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]


def shown_by(source: str, names: dict[str, Any]) -> Any:
    """Run a cell as a notebook does, and return the value of an expression at its end."""
    tree = ast.parse(source)
    last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
    exec(compile(tree, str(NOTEBOOK), "exec"), names)
    return None if last is None else eval(compile(ast.Expression(last.value), str(NOTEBOOK), "eval"), names)


def test_the_notebook_is_stored_without_outputs() -> None:
    code = [cell for cell in CELLS if cell["cell_type"] == "code"]
    assert len(code) > 5
    assert all(cell["outputs"] == [] and cell["execution_count"] is None for cell in code)


def test_linked_pages_exist() -> None:
    text = "".join("".join(cell["source"]) for cell in CELLS if cell["cell_type"] == "markdown")
    pages = [part.split(")")[0] for part in text.split("](")[1:]]
    assert pages
    assert all((NOTEBOOK.parent / page).is_file() for page in pages)


@pytest.mark.slow
def test_from_a_video_to_a_trained_network(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_panned(tmp_path, 2, 60, 144, 176)
    monkeypatch.setenv("V2V_VIDEOS", str(tmp_path))
    monkeypatch.setenv("V2V_SECONDS", "5")
    monkeypatch.setenv("V2V_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    names: dict[str, Any] = {"__name__": "__main__"}
    shown = [shown_by("".join(cell["source"]), names) for cell in CELLS if cell["cell_type"] == "code"]
    pictures = [value for value in shown if isinstance(value, Image.Image)]
    assert len(pictures) == 2
    assert pictures[-1].size == (864, 576)
    assert "Sample(" in repr(names["sample"])
    assert len(names["events"]) > 1000
    assert "mean loss of the first half" in capsys.readouterr().out
