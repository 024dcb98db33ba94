"""Product code uses plain words, docstrings say shapes and errors, and pages hold no marks of an unfinished merge."""

import ast
import re
from collections.abc import Iterator
from itertools import pairwise
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
ARRAY = re.compile(r"\b(?:NDArray|ndarray|Tensor|ByteArray)\b")
NAMED = re.compile(r"\b(?:Mapping|dict)\[str, [^]]*(?:\[\w+\])?\]")
"""Arrays by name, each of a shape of its own."""
ALIAS = re.compile(r"^\w+ = .*\b(?:NDArray|Tensor)\b", re.M)
SHAPE = re.compile(r"\[[\w ,.*+/()-]*\]")


def found(path: Path) -> list[str]:
    lines = path.read_text(encoding="utf-8").splitlines()
    return [
        f"{path.relative_to(ROOT)}:{number}: {line.strip()}"
        for number, line in enumerate(lines, 1)
        if FORBIDDEN.search(line)
    ]


def sources() -> list[Path]:
    return [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]


def test_packages_use_no_forbidden_words() -> None:
    checked = sources()
    assert checked
    assert [line for path in checked for line in found(path)] == []


def public(body: list[ast.stmt], of_class: str = "") -> Iterator[tuple[ast.FunctionDef, str]]:
    """Yield the public functions of a body, each with its docstring; a constructor has that of its class."""
    for node in body:
        name = getattr(node, "name", "_")
        if isinstance(node, ast.ClassDef) and not name.startswith("_"):
            yield from public(node.body, ast.get_docstring(node) or "")
        elif isinstance(node, ast.FunctionDef) and (name == "__init__" or not name.startswith("_")):
            yield node, of_class if name == "__init__" else ast.get_docstring(node) or ""


def shapeless_aliases(body: list[ast.stmt]) -> Iterator[str]:
    """Yield the aliases of an array's type whose docstring states no shape."""
    for node, after in pairwise([*body, ast.Pass()]):
        if isinstance(node, ast.Assign) and re.match(r"(\w+\.)*(NDArray|Tensor)\b", ast.unparse(node.value)):
            stated = isinstance(after, ast.Expr) and SHAPE.search(ast.unparse(after))
            yield from () if stated else map(ast.unparse, node.targets)


def raises(function: ast.FunctionDef) -> bool:
    """Return whether a function raises an error of its own; an abstract one does not count."""
    raised = [node.exc for node in ast.walk(function) if isinstance(node, ast.Raise) and node.exc]
    return any(ast.unparse(each) != "NotImplementedError" for each in raised)


def faults(path: Path, array: re.Pattern[str]) -> Iterator[str]:
    """Yield the public functions of a file whose docstring lacks a shape or a ``Raises:``.

    One that refers to the same function of another class has what is written there.
    """
    for function, text in public(ast.parse(path.read_text("utf-8")).body):
        if re.search(rf":meth:`[\w.]+\.{function.name}`", text):
            continue
        shaped = f"{ast.unparse(function.args)} {'' if function.returns is None else ast.unparse(function.returns)}"
        if array.search(NAMED.sub("", shaped)) and not SHAPE.search(text):
            yield f"{path.relative_to(ROOT)}:{function.lineno} {function.name}: arrays without a shape"
        if "Raises:" not in text and raises(function):
            yield f"{path.relative_to(ROOT)}:{function.lineno} {function.name}: raises without saying so"


def test_public_docstrings_give_shapes_and_errors() -> None:
    aliases = {
        name
        for path in sources()
        if ALIAS.search(path.read_text("utf-8"))
        for name in shapeless_aliases(ast.parse(path.read_text("utf-8")).body)
    }
    array = re.compile("|".join((ARRAY.pattern, *(rf"\b{name}\b" for name in aliases))))
    checked = [path for path in sources() if path.relative_to(ROOT).parts[0] != "examples"]
    assert [fault for path in checked for fault in faults(path, array)] == []
