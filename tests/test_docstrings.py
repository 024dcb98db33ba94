"""Check that public docstrings give the shapes of arrays, and say what is raised."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
ARRAY = re.compile(r"\b(?:NDArray|ndarray|Tensor|ByteArray)\b")
SHAPE = re.compile(r"\[[\w ,.*+/()-]*\]|scalar")
Function = ast.FunctionDef | ast.AsyncFunctionDef


def public(body: list[ast.stmt], about: str = "") -> Iterator[tuple[Function, str]]:
    """Yield the public functions of a body, each with its docstring; a constructor has that of its class."""
    for node in body:
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            yield from public(node.body, ast.get_docstring(node) or "")
        elif isinstance(node, Function) and (not node.name.startswith("_") or node.name == "__init__"):
            yield node, about if node.name == "__init__" else ast.get_docstring(node) or ""


def annotations(function: Function) -> str:
    given = function.args
    found = [item.annotation for item in (*given.posonlyargs, *given.args, *given.kwonlyargs)]
    return " ".join(ast.unparse(item) for item in (*found, function.returns) if item is not None)


def raises(function: Function) -> bool:
    """Return whether a ``raise`` with an error stands in the function itself, not in one that it defines."""
    waiting: list[ast.AST] = list(function.body)
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.Raise) and node.exc is not None:
            return True
        if not isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda, ast.ClassDef)):
            waiting += ast.iter_child_nodes(node)
    return False


def faults(path: Path) -> Iterator[str]:
    """Yield the public functions of a file whose docstring lacks a shape or a ``Raises:``."""
    for function, text in public(ast.parse(path.read_text("utf-8")).body):
        place = f"{path.relative_to(ROOT)}:{function.lineno} {function.name}"
        is_overload = any("overload" in ast.unparse(item) for item in function.decorator_list)
        if ARRAY.search(annotations(function)) and not SHAPE.search(text) and not is_overload:
            yield f"{place}: arrays without a shape"
        if raises(function) and "Raises:" not in text:
            yield f"{place}: raises without saying so"


@pytest.mark.parametrize("package", ["v2v_client", "v2v_protocol"])
def test_public_docstrings_give_shapes_and_errors(package: str) -> None:
    assert [fault for path in sorted((ROOT / package).rglob("*.py")) for fault in faults(path)] == []
