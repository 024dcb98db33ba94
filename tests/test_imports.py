"""Check which package may import which, by reading the source, so that imports inside functions count as well."""

from __future__ import annotations

import ast
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

from tests.tools.statements import nodes_of

ROOT = Path(__file__).parents[1]
PACKAGES = (
    "v2v_protocol",
    "v2v_pictures",
    "v2v_recordings",
    "v2v_server",
    "v2v_tools",
    "v2v_client",
    "trainer",
    "bench",
    "examples",
)

FORBIDDEN: dict[str, set[str]] = {
    "v2v_pictures": {
        "v2v_server",
        "v2v_tools",
        "v2v_client",
        "trainer",
        "bench",
        "examples",
        "torch",
        "zmq",
        "numba",
        "cv2",
    },
    "v2v_recordings": {
        "v2v_server",
        "v2v_tools",
        "v2v_client",
        "v2v_pictures",
        "trainer",
        "bench",
        "examples",
        "torch",
        "zmq",
        "numba",
    },
    "v2v_server": {"torch", "v2v_tools", "v2v_client", "trainer", "bench", "examples"},
    "v2v_tools": {"torch", "zmq", "v2v_client", "trainer", "bench", "examples"},
    "v2v_client": {"v2v_server", "v2v_tools", "trainer", "bench", "examples", "av", "numba", "cv2"},
    "trainer": {"v2v_server", "v2v_tools", "bench", "examples"},
}
PROTOCOL_MAY = {*sys.stdlib_module_names, "numpy", "msgpack", "v2v_protocol"}


FLOORS = (
    "system", "keys", "video", "simulation", "labels", "motion", "flow", "worlds", "recorded", "store", "kinds",
    "config", "corpus", "lease_memory", "corpus_words", "schedule",
    "quarantine", "sharing",
    "broker",
    "worker", "supervise", "status", "prepare", "prepare_recordings", "page",
    "serve", "commands",
)  # fmt: skip
"""The rooms of the server, from the ground up: each imports only from itself and from those before it."""


def imported_modules(source: str) -> set[str]:
    """Return the full names of all imports anywhere in a module: statements, and import_module("...") calls."""
    names: set[str] = set()
    for node in nodes_of(source, expressions="import_module" in source or "__import__" in source):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names.add("." if node.level else str(node.module))
        elif isinstance(node, ast.Call) and node.args and isinstance(node.args[0], ast.Constant):
            function = node.func
            called = function.attr if isinstance(function, ast.Attribute) else getattr(function, "id", "")
            if called in ("import_module", "__import__"):
                names.add(str(node.args[0].value))
    return names


@cache
def modules_of(path: Path) -> frozenset[str]:
    """Return the full names of a file's imports; each file is parsed once."""
    return frozenset(imported_modules(path.read_text("utf-8")))


def imported(path: Path) -> set[str]:
    """Return the top-level names of a file's imports."""
    return {name.split(".")[0] for name in modules_of(path)}


def modules(package: str) -> list[Path]:
    return sorted((ROOT / package).rglob("*.py"))


def test_all_kinds_of_imports_are_found() -> None:
    source = """
import a.b, c as d
from e.f import g
def h():
    import i
    if True:
        from j import k
    importlib.import_module("l.m")
    __import__("n")
from . import o
"""
    assert imported_modules(source) == {"a.b", "c", "e.f", "i", "j", "l.m", "n", "."}


def test_the_protocol_needs_only_light_packages() -> None:
    more = {"safe_yaml.py": {"yaml"}, "progress.py": {"rich"}, "command.py": {"shtab"}, "link": {"zmq"}}
    for path in modules("v2v_protocol"):
        assert imported(path) - PROTOCOL_MAY - more.get(path.name, set()) - more.get(path.parent.name, set()) == set()


def test_at_most_four_files_import_the_transport() -> None:
    users = {path.relative_to(ROOT) for name in PACKAGES for path in modules(name) if "zmq" in imported(path)}
    assert {path.parent.as_posix() for path in users} == {"v2v_protocol/link"}
    assert len(users) <= 4


def test_yaml_is_read_in_one_place() -> None:
    """YAML's own loaders expand aliases without a bound."""
    users = [path for package in PACKAGES for path in modules(package) if "yaml" in imported(path)]
    assert users == [ROOT / "v2v_protocol" / "safe_yaml.py"]


@pytest.mark.parametrize("package", FORBIDDEN)
def test_packages_import_only_allowed_packages(package: str) -> None:
    for path in modules(package):
        crossed = imported(path) & FORBIDDEN[package]
        if path.name == "in_process.py":
            crossed -= {"v2v_server", "v2v_tools"}  # the one door, opened when it is used
        assert not crossed, f"{path.relative_to(ROOT)} imports {', '.join(sorted(crossed))}"


def test_server_folders_import_only_lower_folders() -> None:
    upward: set[tuple[str, str]] = set()
    for path in modules("v2v_server"):
        room = path.relative_to(ROOT / "v2v_server").parts[0].removesuffix(".py")
        if room.startswith("__"):
            continue
        for name in modules_of(path):
            package, _, rest = name.partition(".")
            other = rest.split(".")[0]
            if package == "v2v_server" and FLOORS.index(other) > FLOORS.index(room):
                upward.add((room, other))
    assert upward == set()


def imports_by_module(files: dict[str, str]) -> dict[str, set[str]]:
    """Return which of these modules each one imports, anywhere in it: functions and TYPE_CHECKING count as well.

    A folder's own ``__init__`` that Python runs before a module does not count, nor the files that a registry loads by
    names of its table.
    """
    graph: dict[str, set[str]] = {name: set() for name in files}
    for name, source in files.items():
        for node in nodes_of(source):
            if isinstance(node, ast.Import):
                graph[name] |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                whole = {alias.name: f"{node.module}.{alias.name}" for alias in node.names}
                graph[name] |= {full if full in files else str(node.module) for full in whole.values()}
        graph[name] &= files.keys() - {name}
    return graph


def circles(graph: dict[str, set[str]]) -> list[set[str]]:
    """Return the groups of modules that import each other, directly or through others of the group."""
    reached: dict[str, set[str]] = {}
    for name, targets in graph.items():
        todo, reached[name] = [*targets], set()
        while todo:
            if (module := todo.pop()) not in reached[name]:
                reached[name].add(module)
                todo += graph[module]
    groups = {frozenset(other for other in reached[name] if name in reached[other]) for name in graph}
    return [set(group) for group in sorted(groups, key=sorted) if group]


def test_a_circle_is_found_wherever_its_imports_stand() -> None:
    files = {
        "a": "def f():\n    from b import x",
        "b": "if TYPE_CHECKING:\n    from c import d",
        "c": "",
        "c.d": "import a",
        "e": "from c import d",
    }
    assert circles(imports_by_module(files)) == [{"a", "b", "c.d"}]
    assert circles(imports_by_module(files | {"c.d": ""})) == []


def test_no_modules_import_each_other() -> None:
    files = {}
    for package in PACKAGES:
        for path in modules(package):
            parts = path.relative_to(ROOT).with_suffix("").parts
            files[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path.read_text("utf-8")
    assert [sorted(group) for group in circles(imports_by_module(files))] == []


@pytest.mark.parametrize(
    "room",
    [
        "corpus/scenes",
        "corpus/sources",
        *sorted(
            set(FLOORS)
            - {
                "config",
                "prepare",
                "prepare_recordings",
                "recorded",
                "quarantine",
                "schedule",
                "corpus_words",
                "lease_memory",
                "sharing",
                "keys",
                "serve",
                "simulation",
                "motion",
                "flow",
            }
            - {"labels"}
        ),
    ],
)
def test_every_folder_documents_its_files(room: str) -> None:
    folder = ROOT / "v2v_server" / room
    on_the_map = {line.split()[0] for line in (folder / "__init__.py").read_text(encoding="utf-8").splitlines()[2:-1]}
    rooms = {path.parent.name for path in folder.glob("*/__init__.py")}
    assert on_the_map == {path.stem for path in folder.glob("*.py")} - {"__init__"} | rooms


BROKER = ROOT / "v2v_server" / "broker"
PURE = {
    "__future__", "bisect", "collections", "collections.abc", "dataclasses", "enum", "hashlib", "itertools", "math",
    "statistics", "typing",
    "v2v_protocol", "v2v_protocol.arena", "v2v_protocol.errors", "v2v_protocol.liveness", "v2v_protocol.messages",
    "v2v_protocol.recipe", "v2v_protocol.sample", "v2v_protocol.spec",
    "v2v_server.corpus.videos", "v2v_server.lease_memory", "v2v_server.schedule", "v2v_server.sharing",
    "v2v_server.system.log",
}  # fmt: skip
"""What the broker may import: nothing here reads a file, but for the quarantine, of which it uses the values."""


def broker_files() -> list[str]:
    """Return the names of the broker's files in the order of its page: each imports only those above it."""
    return [line.split()[0] for line in (BROKER / "__init__.py").read_text("utf-8").splitlines()[2:-1]]


@pytest.mark.parametrize("file", broker_files())
def test_the_broker_reads_no_file_and_imports_in_one_direction(file: str) -> None:
    source = (BROKER / f"{file}.py").read_text("utf-8")
    nodes = nodes_of(source, expressions=True)
    above = {f"v2v_server.broker.{name}" for name in broker_files()[: broker_files().index(file)]}
    from_quarantine: set[str] = set()
    for node in nodes:
        if isinstance(node, ast.ImportFrom) and node.module == "v2v_server.quarantine":
            from_quarantine |= {alias.name for alias in node.names}
    assert from_quarantine <= {"Quarantine", "QuarantineEntry"}
    modules = modules_of(BROKER / f"{file}.py") - {"v2v_server.quarantine", "v2v_server.broker"}
    assert modules - PURE - above == set()
    packages = {
        f"v2v_server.broker.{alias.name}"
        for node in nodes
        if isinstance(node, ast.ImportFrom) and node.module == "v2v_server.broker"
        for alias in node.names
    }
    assert packages - above == set()
    assert "open" not in {node.id for node in nodes if isinstance(node, ast.Name)}


@pytest.mark.parametrize(
    ("module", "without"),
    [
        ("v2v_protocol.messages", ("torch", "zmq", "av", "numba", "cv2", "yaml")),
        ("v2v_server.simulation.draw", ("torch", "zmq", "av", "numba", "cv2")),
        ("v2v_server.broker.dispatcher", ("torch", "zmq", "numba", "cv2")),
        ("v2v_server.serve", ("torch", "numba", "cv2")),
        ("v2v_server.worker.process", ("torch", "v2v_server.corpus.index", "v2v_server.schedule")),
        ("v2v_server.schedule", ("torch", "zmq", "numba", "cv2", "sqlite3")),
        ("v2v_server.kinds.registry", ("torch", "zmq", "av", "numba", "cv2", "PIL")),
    ],
)
def test_what_a_fresh_interpreter_loads(module: str, without: tuple[str, ...]) -> None:
    """Indirect imports count too."""
    program = f"import sys, {module}\nprint(*sorted({set(without)!r} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == []


def test_no_two_classes_constants_or_aliases_have_one_name() -> None:
    """But for what the files of one seam have in common, and what has the same definition: every effect has its
    ``Tables``, every plane its ``PLANE``."""
    found: dict[str, dict[str, ast.expr]] = {}
    for package in (
        "v2v_protocol",
        "v2v_pictures",
        "v2v_recordings",
        "v2v_server",
        "v2v_tools",
        "v2v_client",
        "trainer",
    ):
        for path in modules(package):
            if {"effects", "planes"} & set(path.parts):
                continue
            nodes = nodes_of(path.read_text("utf-8"))
            classes = {item.name: ast.Constant(str(path)) for item in nodes if isinstance(item, ast.ClassDef)}
            for name, definition in (constants(nodes[0]) | classes).items():
                if name[0].isupper():
                    found.setdefault(name, {})[str(path.relative_to(ROOT))] = definition
    del found["KIND"]  # of each kind of videos
    assert {
        name: list(used)
        for name, used in found.items()
        if len(used) > 1 and len(set(map(ast.unparse, used.values()))) > 1
    } == {}


def constants(module: ast.AST) -> dict[str, ast.expr]:
    """Return the definition of each constant and alias of a module."""
    found: dict[str, ast.expr] = {}
    for node in ast.iter_child_nodes(module):
        if isinstance(node, (ast.Assign, ast.AnnAssign)) and node.value is not None:
            for target in node.targets if isinstance(node, ast.Assign) else [node.target]:
                several = isinstance(target, ast.Tuple) and isinstance(node.value, ast.Tuple)
                pairs = zip(target.elts, node.value.elts, strict=True) if several else [(target, node.value)]
                for place, value in pairs:
                    names = (item for item in ast.walk(place) if isinstance(item, ast.Name))
                    found |= {item.id: value for item in names if isinstance(item.ctx, ast.Store)}
    return found
