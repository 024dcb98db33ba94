"""Measure the power of the tests: change one operator or constant at a time and see whether a test fails.

Run: python -m pytest -m "not slow" --cov --cov-branch --cov-context=test --cov-report=
     python -m tests.tools.mutants --count 500 --seed 1 --coverage .coverage --out mutants.json

The tests of a changed line come from the coverage database, which has a context for each test. What survives them, and
lines without a context (compiled kernels, subprocesses), meet a second stage: the tests that mirror the module, and
whole files of others that run the line or import the module. A run that was stopped continues from its file. Two runs
with one seed on the same product code draw the same mutants, so that a suite before and after a change of its tests
can be compared module by module (`--compare BEFORE.json`).

Compiling the kernels takes longer than their tests, and each of their mutants compiles them. So its first stage is the
tests of UNCOMPILED, in which the kernels run as Python. Only survivors are compiled. Mutants of the kernels come last.

This module is also the plugin of pytest in these runs. Examples of hypothesis are the same in every run, and one that
fails is not made smaller. For uncompiled kernels it defines in Python what only compiled code has.
"""

import argparse
import ast
import json
import os
import random
import re
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
from importlib import import_module
from pathlib import Path
from shutil import copytree, ignore_patterns
from typing import Any, NamedTuple

import numpy as np
from hypothesis import Phase, settings

PACKAGES = ("v2v_protocol", "v2v_server", "v2v_tools", "v2v_client", "v2v_pictures", "v2v_recordings", "trainer")
MOST_TESTS = 40
MOST_FILES = 20
TIMEOUT_SECONDS = 300
KERNELS = ("v2v_server/simulation/", "v2v_server/motion/", "v2v_server/worlds/")
UNCOMPILED = (
    *(f"tests/server/simulation/test_{name}.py" for name in ("pixel", "draw", "view", "durations")),
    "tests/server/simulation/test_effects.py::test_kernel_equals_the_oracle",
)
"""Tests of the kernels that take seconds uncompiled, by file or by name."""
COMPILED_ONLY = (
    "tests/server/simulation/test_pixel.py::test_kernel_is_",
    "tests/server/simulation/test_draw.py::test_both_kernels_start_where_the_law_says",
)
"""Tests of those files that together take most of a minute uncompiled, by the start of their name."""
_BLOCK = 32
"""PIXELS_A_BLOCK of the kernels there: each block is simulated whole, however small the picture."""

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


class Stage(NamedTuple):
    """Tests that run together, and whether kernels are compiled for them."""

    tests: list[str]
    is_compiled: bool = True


def stages_for(
    mutant: Mutant, contexts: Mapping[tuple[str, int], list[str]], lines: Mapping[str, int], root: Path
) -> list[Stage]:
    """Choose the tests of a mutant: at most MOST_TESTS that run its line, those that run the fewest lines first.

    What survives them meets the tests that mirror the module, and at most MOST_FILES whole files of tests that run the
    line, or import the module if none is known to: results of fixtures that tests share count for one test only.
    """
    names = sorted(set(contexts.get((mutant.path, mutant.line), [])), key=lambda name: (lines[name], name))
    mirror = mirror_of(mutant.path, root)
    files = dict.fromkeys(name.partition("::")[0] for name in names) or importers_of(mutant.path, root)
    others = [file for file in files if not file.startswith(tuple(mirror))][:MOST_FILES]
    first = Stage(names[:MOST_TESTS])
    if mutant.path.startswith(KERNELS):
        own = [name for name in names if name.startswith(UNCOMPILED)][:MOST_TESTS]
        first = Stage(own or [file for file in UNCOMPILED if file.startswith(tuple(mirror))], is_compiled=False)
    return [stage for stage in (first, Stage([*mirror, *others])) if stage.tests]


def mirror_of(path: str, root: Path) -> list[str]:
    """Name the folder of tests nearest to a module's place, or else the files of its package's tests."""
    package, *rest = Path(path).with_suffix("").parts
    home = root / "tests" / package
    home = home if home.is_dir() else home.with_name(package.removeprefix("v2v_"))
    place = home.joinpath(*rest)
    folders = [folder for folder in (place, *place.parents[: len(rest) - 1]) if folder.is_dir()]
    return [str(file.relative_to(root)) for file in folders[:1] or sorted(home.glob("test_*.py"))]


def importers_of(path: str, root: Path) -> list[str]:
    """Name the test files that import a module, by the text of their imports."""
    module = ".".join(Path(path).with_suffix("").parts).removesuffix(".__init__")
    package, _, name = module.rpartition(".")
    imported = re.compile(
        rf"\b{re.escape(module)}(?![.\w])|^from {re.escape(package)} import .*\b{name}\b", re.MULTILINE
    )
    files = sorted((root / "tests").rglob("test_*.py"))
    return [str(file.relative_to(root)) for file in files if imported.search(file.read_text("utf-8"))]


def pytest_configure() -> None:
    """Choose the examples of hypothesis, and let the kernels run as Python under ``NUMBA_DISABLE_JIT=1``."""
    phases = (Phase.explicit, Phase.generate)
    settings.register_profile("mutants", parent=settings.get_profile("ci"), phases=phases)
    settings.load_profile("mutants")
    if "NUMBA_DISABLE_JIT" in os.environ:
        _define_in_python()


def _define_in_python() -> None:
    """Replace what numba's language adds to numpy."""
    in_python: dict[str, Any] = {
        "float_of_bits": lambda bits: bits.view(np.float32),
        "bits_of_float": lambda value: value.view(np.int32),
        "use_widest_vectors": lambda: None,
        "look_up_by_permutation": lambda *_: 0,
    }
    numba: Any = import_module("numba.extending")
    numba.intrinsic = lambda function: in_python.get(function.__name__, function)
    pixel: Any = import_module("v2v_server.simulation.pixel")
    pixel._log_intensity = lambda table, value: table[value] if isinstance(value, np.integer) else value
    pixel.PIXELS_A_BLOCK = _BLOCK  # modules that import it come later
    narrow = pixel.store

    def store(counts: Any, limit: Any, stored: Any) -> Any:
        wide = np.empty(len(stored))  # before they are clipped, numpy refuses counts that the dtype does not hold
        clipped = narrow(counts, limit, wide)
        stored[:] = wide
        return clipped

    pixel.store = store
    np.seterr(over="ignore")  # words of 32 bits wrap around


def judge(mutant: Mutant, source: str, stages: list[Stage], tree: Path) -> dict[str, object]:
    """Run a mutant's tests in a copy of the tree until some fail, and restore the file; return a row of the results.

    Its outcome is "killed", "survived", "untested" (no test reaches it) or "unfinished": tests took longer than
    TIMEOUT_SECONDS, so the mutant never ends, or the machine is slow. `by` is pytest's line about the test that failed.
    """
    began = time.monotonic()
    path = tree / mutant.path
    healthy, when = path.read_bytes(), path.stat()
    path.write_text(source, "utf-8")
    outcome = "untested"
    failed: str | None = ""
    try:
        for stage in stages:
            failed = _failure(stage, tree)
            if failed is None and outcome != "survived":
                outcome = "unfinished"
            elif failed is not None:
                outcome = "killed" if failed else "survived"
            if outcome != "survived":
                break
    finally:
        path.write_bytes(healthy)
        os.utime(path, ns=(when.st_atime_ns, when.st_mtime_ns))  # its bytecode is valid again
    tests = sum(len(stage.tests) for stage in stages)
    return asdict(mutant) | {"outcome": outcome, "by": failed, "tests": tests, "seconds": time.monotonic() - began}


def _failure(stage: Stage, tree: Path) -> str | None:
    """Return pytest's line about the first test that fails, "" if all pass, None after TIMEOUT_SECONDS."""
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", "-p", __spec__.name]
    environment = os.environ | {"PYTHONPATH": str(tree), "PYTHONDONTWRITEBYTECODE": "1"}
    if not stage.is_compiled:
        command += [f"--deselect={name}" for name in COMPILED_ONLY]
        environment["NUMBA_DISABLE_JIT"] = "1"
    running = subprocess.Popen(
        [*command, "-m", "not slow", *stage.tests],
        cwd=tree,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    try:
        said = running.communicate(timeout=TIMEOUT_SECONDS)[0].decode().splitlines()
    except subprocess.TimeoutExpired:
        os.killpg(running.pid, signal.SIGKILL)
        running.communicate()
        return None
    if running.returncode in (0, 5):
        return ""
    return next((line for line in said if line.startswith(("FAILED ", "ERROR "))), "ended without a result")


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
            collected = subprocess.run(
                [sys.executable, "-m", "pytest", "--collect-only", "-q", "-p", "no:cacheprovider"],
                cwd=tree,
                env=os.environ | {"PYTHONPATH": str(tree), "PYTHONDONTWRITEBYTECODE": ""},
                stdout=subprocess.PIPE,
                check=True,
            ).stdout  # and the bytecode, which each mutant's tests read
        # A name that pytest does not find, or cannot be given, would end its run like a test that fails.
        existing = set(collected.decode().splitlines())
        contexts = {place: [name for name in names if name in existing] for place, names in contexts.items()}
        healthy = Stage(list(UNCOMPILED), is_compiled=False)
        if any(mutant.path.startswith(KERNELS) for mutant, _ in todo) and _failure(healthy, trees[0]) != "":
            raise SystemExit(f"a test of UNCOMPILED fails without a mutant, or all take over {TIMEOUT_SECONDS} s")
        free = list(trees)

        def run(pair: tuple[Mutant, str]) -> dict[str, object]:
            tree = free.pop()
            try:
                return judge(*pair, stages_for(pair[0], contexts, lines, root), tree)
            finally:
                free.append(tree)

        with ThreadPoolExecutor(options.jobs) as pool:
            for row in pool.map(run, todo):
                rows.append(row)
                options.out.write_text(json.dumps(rows, indent=1))
    found, total = kills(rows), Counter(module_of(str(row["path"])) for row in rows)
    before = kills(json.loads(options.compare.read_text())) if options.compare else Counter[str]()
    for module in sorted(total):
        print(f"{module:32s} {found[module]:4d} of {total[module]:4d}" + f"  before {before[module]}" * bool(before))
    print(f"{'all':32s} {found.total():4d} of {total.total():4d}")
    return int(any(found[module] < before[module] for module in before))


if __name__ == "__main__":
    sys.exit(main())
