"""Measure the power of the tests: change one operator or constant at a time and see whether a test fails.

Run: python -m tests.tools.mutants --count 500 --seed 1 --coverage .coverage --out mutants.json

The tests of a changed line come from a coverage database with one context per test (pytest-cov's
`--cov-context=test`); lines without one (compiled kernels, subprocesses) use the folder of tests that mirrors the
module. Mutants of the kernels come last: each of them compiles every kernel again. Two runs with one seed on the same
product code draw the same mutants, so that a suite before and after a change of its tests can be compared module by
module (`--compare BEFORE.json`).
"""

import argparse
import ast
import json
import os
import random
import signal
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from shutil import copytree, ignore_patterns

PACKAGES = ("v2v_protocol", "v2v_server", "v2v_tools", "v2v_client", "v2v_pictures", "v2v_recordings", "trainer")
MOST_TESTS = 40
TIMEOUT_SECONDS = 300
KERNELS = ("v2v_server/simulation/", "v2v_server/motion/")

_COMPARISONS: dict[type[ast.cmpop], type[ast.cmpop]] = {
    ast.Lt: ast.LtE,
    ast.LtE: ast.Lt,
    ast.Gt: ast.GtE,
    ast.GtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
}
_ARITHMETIC: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Add,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.Mod: ast.Mult,
}


@dataclass(frozen=True, slots=True)
class Mutant:
    """One change of one expression: the file, its line, the old and the new source of the expression."""

    path: str
    line: int
    column: int
    old: str
    new: str


@dataclass(frozen=True, slots=True)
class Verdict:
    """What the tests said of a mutant: "killed", "survived", "untested" (no test reaches it) or "unfinished".

    Tests that take longer than TIMEOUT_SECONDS are unfinished: the mutant never ends, or the machine is slow.
    """

    mutant: Mutant
    outcome: str
    tests: int
    seconds: float


def mutants_of(path: str, source: str) -> Iterator[tuple[Mutant, str]]:
    """Yield each mutant of a module with the module's changed source.

    Annotations, string formatting and `if TYPE_CHECKING` never change what runs, so they are left out.
    """
    tree = ast.parse(source)
    lines = source.splitlines(keepends=True)
    starts = [0]
    for text in lines:
        starts.append(starts[-1] + len(text.encode()))
    data = source.encode()
    for node in _expressions(tree):
        changed = _changed(node)
        if changed is None or node.end_lineno is None or node.end_col_offset is None:
            continue
        begin = starts[node.lineno - 1] + node.col_offset
        end = starts[node.end_lineno - 1] + node.end_col_offset
        new = f"({ast.unparse(changed)})"
        old = data[begin:end].decode()
        yield (
            Mutant(path, node.lineno, node.col_offset, " ".join(old.split()), new),
            (data[:begin] + new.encode() + data[end:]).decode(),
        )


def _expressions(tree: ast.AST) -> Iterator[ast.expr]:
    for name, value in ast.iter_fields(tree):
        if name in ("annotation", "returns"):
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, (ast.JoinedStr, ast.Assert)) or not isinstance(child, ast.AST):
                continue
            if isinstance(child, ast.If) and ast.unparse(child.test) == "TYPE_CHECKING":
                continue
            if isinstance(child, ast.expr):
                yield child
            yield from _expressions(child)


def _changed(node: ast.expr) -> ast.expr | None:
    if isinstance(node, ast.Compare) and type(node.ops[0]) in _COMPARISONS:
        return ast.Compare(node.left, [_COMPARISONS[type(node.ops[0])](), *node.ops[1:]], node.comparators)
    if isinstance(node, ast.BinOp) and type(node.op) in _ARITHMETIC and not _is_text(node):
        return ast.BinOp(node.left, _ARITHMETIC[type(node.op)](), node.right)
    if isinstance(node, ast.BoolOp):
        return ast.BoolOp(ast.Or() if isinstance(node.op, ast.And) else ast.And(), node.values)
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
        return node.operand
    if isinstance(node, ast.Constant) and type(node.value) is bool:
        return ast.Constant(not node.value)
    if isinstance(node, ast.Constant) and type(node.value) is int:
        return ast.Constant(node.value + 1)
    return None


def _is_text(node: ast.BinOp) -> bool:
    return any(
        isinstance(side, ast.JoinedStr) or (isinstance(side, ast.Constant) and isinstance(side.value, str))
        for side in (node.left, node.right)
    )


def draw(root: Path, count: int, seed: int) -> list[tuple[Mutant, str]]:
    """Draw `count` mutants over the packages, each possible one with equal chance."""
    everything = [
        pair
        for package in PACKAGES
        for path in sorted((root / package).rglob("*.py"))
        for pair in mutants_of(str(path.relative_to(root)), path.read_text("utf-8"))
    ]
    return random.Random(seed).sample(everything, min(count, len(everything)))


def read_contexts(database: Path, root: Path) -> dict[tuple[str, int], list[str]]:
    """Read which tests run each line of the packages: {(path, line): names of tests}."""
    found: dict[tuple[str, int], list[str]] = {}
    with sqlite3.connect(database) as connection:
        rows = connection.execute(
            "select distinct file.path, arc.fromno, context.context from arc "
            "join file on file.id = arc.file_id join context on context.id = arc.context_id "
            "where context.context != '' and arc.fromno > 0"
        )
        for path, line, context in rows:
            name = context.rsplit("|", 1)[0]
            if (relative := os.path.relpath(path, root)).startswith(PACKAGES):
                found.setdefault((relative, line), []).append(name)
    return found


def lines_of(contexts: Mapping[tuple[str, int], list[str]]) -> Counter[str]:
    """Count the lines that each test runs."""
    return Counter(name for names in contexts.values() for name in set(names))


def tests_for(
    mutant: Mutant, contexts: Mapping[tuple[str, int], list[str]], lines: Mapping[str, int], root: Path
) -> list[list[str]]:
    """Choose the tests of a mutant: at most MOST_TESTS that run its line, those that run the fewest lines first.

    What survives them meets the folder of tests that mirrors the module: results of fixtures that tests share count
    for one test only.
    """
    package, *rest = Path(mutant.path).with_suffix("").parts
    mirror = Path("tests", package.removeprefix("v2v_"), *rest[:-1])
    names = sorted(set(contexts.get((mutant.path, mutant.line), [])), key=lambda name: (lines[name], name))
    folder = [str(mirror)] if (root / mirror).is_dir() else []
    return [chosen for chosen in (names[:MOST_TESTS], folder) if chosen]


def judge(mutant: Mutant, source: str, tests: list[list[str]], tree: Path) -> Verdict:
    """Run a mutant's tests in a copy of the tree until some fail, and restore the file."""
    began = time.monotonic()
    path = tree / mutant.path
    healthy, when = path.read_bytes(), path.stat()
    path.write_text(source, "utf-8")
    outcome = "untested"
    try:
        for chosen in tests:
            passed = _pass(chosen, tree)
            if passed is None and outcome != "survived":
                outcome = "unfinished"
            elif passed is not None:
                outcome = "survived" if passed else "killed"
            if outcome != "survived":
                break
    finally:
        path.write_bytes(healthy)
        os.utime(path, ns=(when.st_atime_ns, when.st_mtime_ns))  # its bytecode is valid again
    return Verdict(mutant, outcome, sum(map(len, tests)), time.monotonic() - began)


def _pass(tests: list[str], tree: Path) -> bool | None:
    """Return whether tests pass; None if they take longer than TIMEOUT_SECONDS."""
    running = subprocess.Popen(
        [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", "-m", "not slow", *tests],
        cwd=tree,
        env=os.environ | {"PYTHONPATH": str(tree), "PYTHONDONTWRITEBYTECODE": "1"},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    try:
        return running.wait(TIMEOUT_SECONDS) in (0, 5)
    except subprocess.TimeoutExpired:
        os.killpg(running.pid, signal.SIGKILL)
        running.wait()
        return None


def module_of(path: str) -> str:
    """Name the package a mutant belongs to, two folders deep at most."""
    return "/".join(Path(path).parts[:-1][:2])


def kills(verdicts: list[dict[str, object]]) -> Counter[str]:
    """Count the killed mutants of each module."""
    return Counter(module_of(str(row["path"])) for row in verdicts if row["outcome"] == "killed")


def main() -> int:
    """Draw mutants, run their tests, write one row for each, and compare with an earlier run if one is given."""
    parser = argparse.ArgumentParser(description="Change one expression at a time and count the changes tests find.")
    parser.add_argument("--count", type=int, default=500, help="number of mutants")
    parser.add_argument("--seed", type=int, default=1, help="seed of the draw")
    parser.add_argument("--coverage", type=Path, required=True, help="coverage database with a context for each test")
    parser.add_argument("--coverage-root", type=Path, help="root of the tree in which coverage was recorded")
    parser.add_argument("--product", type=Path, help="root of the tree whose packages are mutated (default: this one)")
    parser.add_argument("--out", type=Path, required=True, help="JSON file of results; an existing one is continued")
    parser.add_argument("--compare", type=Path, help="results of an earlier run: exit with 1 if a module kills fewer")
    parser.add_argument("--jobs", type=int, default=2, help="mutants tried at the same time")
    options = parser.parse_args()
    root = Path.cwd()
    contexts = read_contexts(options.coverage, (options.coverage_root or root).resolve())
    lines = lines_of(contexts)
    rows: list[dict[str, object]] = json.loads(options.out.read_text()) if options.out.exists() else []
    known = {(row["path"], row["line"], row["column"], row["new"]) for row in rows}
    drawn = draw(options.product or root, options.count, options.seed)
    todo = [p for p in drawn if (p[0].path, p[0].line, p[0].column, p[0].new) not in known]
    todo.sort(key=lambda pair: pair[0].path.startswith(KERNELS))
    with tempfile.TemporaryDirectory() as folder:
        trees = [Path(folder, str(number)) for number in range(options.jobs)]
        for tree in trees:
            copytree(root, tree, symlinks=True, ignore=ignore_patterns(".git", ".venv*", "out", "__pycache__"))
            collect = [sys.executable, "-m", "pytest", "--collect-only", "-q", "-p", "no:cacheprovider"]
            subprocess.run(
                collect,
                cwd=tree,
                env=os.environ | {"PYTHONPATH": str(tree), "PYTHONDONTWRITEBYTECODE": ""},
                stdout=subprocess.DEVNULL,
                check=True,
            )  # writes the bytecode, which each mutant's tests read
        free = list(trees)

        def run(pair: tuple[Mutant, str]) -> Verdict:
            tree = free.pop()
            try:
                return judge(*pair, tests_for(pair[0], contexts, lines, root), tree)
            finally:
                free.append(tree)

        with ThreadPoolExecutor(options.jobs) as pool:
            for verdict in pool.map(run, todo):
                rows.append(asdict(verdict.mutant) | {k: v for k, v in asdict(verdict).items() if k != "mutant"})
                options.out.write_text(json.dumps(rows, indent=1))
    found, total = kills(rows), Counter(module_of(str(row["path"])) for row in rows)
    before = kills(json.loads(options.compare.read_text())) if options.compare else Counter[str]()
    for module in sorted(total):
        print(f"{module:32s} {found[module]:4d} of {total[module]:4d}" + f"  before {before[module]}" * bool(before))
    print(f"{'all':32s} {found.total():4d} of {total.total():4d}")
    return int(any(found[module] < before[module] for module in before))


if __name__ == "__main__":
    sys.exit(main())
