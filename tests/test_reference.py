"""Check the reference page of all keys, and the flags that the documentation names."""

from __future__ import annotations

import ast
import json
import re
import runpy
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

import pytest

import v2v_client

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "docs" / "reference"
PUBLIC = frozenset(re.findall(r"^::: (\S+)$", (FOLDER / "api.md").read_text("utf-8"), re.M))
"""Modules and names of the page of the Python API."""
INSIDE = {"extending.md", "make_keys.py", "make_pixel.py", "site_hooks.py"}
"""What changes the product, or makes a page of it."""
READERS = sorted(
    path
    for pattern in ("README.md", "docs/**/*.md", "examples/*.py", "examples/*.ipynb")
    for path in ROOT.glob(pattern)
    if path.name not in INSIDE
)


def test_the_page_of_keys_matches_the_source() -> None:
    page = runpy.run_path(str(FOLDER / "make_keys.py"))["page"]()
    assert (FOLDER / "keys.md").read_text("utf-8") == page, "run: python docs/reference/make_keys.py"


def code_of(path: Path) -> str:
    """Return the text of a page or program, or the cells of a notebook."""
    text = path.read_text("utf-8")
    return "\n".join("".join(cell["source"]) for cell in json.loads(text)["cells"]) if path.suffix == ".ipynb" else text


def imported(code: str) -> Iterator[str]:
    """Yield the full name of each thing that code imports from our packages."""
    for line in re.findall(r"^ *((?:from|import) (?:v2v_|trainer).*)$", code, re.M):
        (node,) = ast.parse(line).body
        if isinstance(node, ast.ImportFrom):
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)


def is_public(name: str) -> bool:
    """Return whether the page lists a name, or the module that it is from, where it is or where it was defined."""
    module, _, attribute = name.rpartition(".")
    thing = getattr(import_module(module), attribute, None)
    defined = f"{getattr(thing, '__module__', module)}.{getattr(thing, '__qualname__', attribute)}"
    return any({each, each.rpartition(".")[0]} & PUBLIC for each in (name, defined))


@pytest.mark.parametrize("path", READERS, ids=lambda path: path.name)
def test_pages_and_examples_import_public_names_only(path: Path) -> None:
    assert [name for name in imported(code_of(path)) if not is_public(name)] == []


def test_imports_are_found() -> None:
    found = {name for path in READERS for name in imported(code_of(path))}
    assert {
        "v2v_client.V2VStreamDataset",
        "trainer.weights.load_into",
        "v2v_server.status.client.StatusClient",
    } <= found
    assert not is_public("v2v_server.video.decode.DecodedClip")


def test_what_the_client_exports_is_public() -> None:
    assert [name for name in v2v_client.__all__ if not is_public(f"v2v_client.{name}")] == []
