"""Count the statements of Python files by AST; a docstring is not a statement.

Run: python -m tests.tools.statements FOLDER...
"""

import argparse
import ast
from pathlib import Path


def _is_docstring(node: ast.stmt) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


def nodes_of(source: str, *, expressions: bool = False) -> list[ast.AST]:
    """Return the nodes of a module, without or with its expressions: most nodes, in which there is no statement."""
    nodes: list[ast.AST] = [ast.parse(source)]
    for node in nodes:
        nodes += (child for child in ast.iter_child_nodes(node) if expressions or not isinstance(child, ast.expr))
    return nodes


def statements_of(source: str) -> int:
    """Count the statements of one module's source, without docstrings, those below a constant or field included."""
    return sum(isinstance(node, ast.stmt) and not _is_docstring(node) for node in nodes_of(source))


def statements_under(folder: Path) -> int:
    """Count the statements of all Python files in a folder and below it."""
    return sum(statements_of(path.read_text("utf-8")) for path in sorted(folder.rglob("*.py")))


def main() -> None:
    """Print one line for each folder: its statements and its name."""
    parser = argparse.ArgumentParser(description="Count statements, docstrings not counted.")
    parser.add_argument("folders", nargs="+", type=Path, metavar="FOLDER")
    for folder in parser.parse_args().folders:
        if not folder.is_dir():
            parser.error(f"{folder} is not a folder; give a folder of Python files")
        print(f"{statements_under(folder):7d} {folder}")


if __name__ == "__main__":
    main()
