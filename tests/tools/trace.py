"""Trace one sample through the files of the project, from the request to the batch.

Run: python -m tests.tools.trace CLIP, or --write to bring the table in docs/architecture.md up to date

A server with one worker serves one sequence of a clip; a consumer takes it in epoch 0. Each process of the three notes
every call of a function of the project, with the time. The way of the sample is, for each process, the first call of
each function between the consumer's connecting and its batch, without the functions that are also called while no
sample is asked for. That is done several times, with new processes, and only functions that are called every time
count: pings and waits depend on how busy the host is. A profiler does not see compiled kernels, but the function that
enters them.
"""

from __future__ import annotations

import argparse
import ast
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from tests.clips import panned_luma, write_clip
from v2v_server.status.client import StatusClient

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "architecture.md"
HEADING = "### By file and function"
_SECTION = """{heading}

The files that one sample of the paper's recipe visits, which a local worker decodes from a file: {files} files, and \
{returns} returns to an earlier one. Each process has its files in the order in which it enters them first, and the \
function that it enters there. `python -m tests.tools.trace --write` makes this table.

| process | file | enters | what that does |
|---|---|---|---|
{table}

"""
_PROCESSES = {"worker": "v2v_server/worker/process.py", "consumer": "v2v_client/dataset.py"}
"""A file by which a process is known; the other one is the server."""
RUNS = 3
PACKAGES = ("v2v_protocol", "v2v_server", "v2v_tools", "v2v_client", "v2v_pictures", "v2v_recordings")
FOLDER = "V2V_TRACE_FOLDER"
_QUIET_SECONDS = 3.0
_START_SECONDS = 300.0
_SITE = """
import os, sys, threading, time
FOLDER, ROOT = os.environ["{folder}"], {root!r}
PACKAGES = {packages!r}
NAMES = {{}}
TO = os.open(f"{{FOLDER}}/{{os.getpid()}}.calls", os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC)
def note(frame, event, argument):
    if event != "call":
        return
    code = frame.f_code
    name = NAMES.get(code)
    if name is None:
        file = code.co_filename
        ours = file.startswith(ROOT) and file[len(ROOT):].split("/")[0] in PACKAGES and code.co_name[0] != "<"
        name = NAMES[code] = f"{{file[len(ROOT):]}}:{{code.co_name}}:{{code.co_qualname}}" if ours else ""
    if name:
        try:
            os.write(TO, f"{{time.monotonic_ns()}} {{name}}\\n".encode())
        except OSError:
            pass
threading.setprofile(note)
sys.setprofile(note)
"""
_CONSUMER = """
import sys, time
from v2v_client import V2VStreamDataset
with V2VStreamDataset(sys.argv[1], batch_size=1, max_sequences_per_video=1, recipe=dict(RECIPE)) as dataset:
    batches = iter(dataset)
    print(time.monotonic_ns(), flush=True)
    batch = next(batches)
    assert len(batch) == 1
    print(time.monotonic_ns(), flush=True)
    time.sleep(QUIET)
    print(time.monotonic_ns(), flush=True)
"""
RECIPE = {"preset": "paper", "voxels_per_clip": 4, "crop_height_px": 32, "crop_width_px": 40}


class Call(NamedTuple):
    """A function of the project, called in a process."""

    nanoseconds: int
    file: str
    function: str
    full_name: str


@dataclass(frozen=True)
class Way:
    """The way of one sample.

    Attributes:
        steps: (file, function) for each process, in the order of time.
        idle: what is also called while no sample is asked for.
        full_names: of each step in a process, with the class: (number of the process, file, function) -> name.
    """

    steps: list[list[tuple[str, str]]]
    idle: set[tuple[str, str]]
    full_names: Mapping[tuple[int, str, str], str] = field(default_factory=dict)

    @classmethod
    def common(cls, ways: Sequence[Way]) -> Way:
        """Return the steps that all ways of one sample have, in the order of the way with the fewest returns."""
        idle = set[tuple[str, str]]().union(*(way.idle for way in ways))
        in_all = [
            set[tuple[str, str]].intersection(*map(set, each)) for each in zip(*(w.steps for w in ways), strict=True)
        ]
        kept = [
            [[step for step in process if step in always] for process, always in zip(way.steps, in_all, strict=True)]
            for way in ways
        ]
        return min(map(cls, kept, [idle] * len(kept), [way.full_names for way in ways]), key=lambda way: way.returns)

    @property
    def files(self) -> int:
        """Number of files that it visits."""
        return len({file for process in self.steps for file, _ in process})

    @property
    def returns(self) -> int:
        """Number of steps from one file into another that the same process has visited before."""
        total = 0
        for process in self.steps:
            visited = [file for file, _ in process]
            total += sum(file in visited[:at] and file != visited[at - 1] for at, file in enumerate(visited))
        return total


def trace(folder: Path, clip: Path, runs: int = RUNS) -> Way:
    """Serve one sample of the clip to one consumer; return its way.

    Args:
        folder: an empty folder.
        clip: a video of at least 21 frames.
        runs: times that it is served; steps of some of them only do not count.

    Raises:
        RuntimeError: a process failed; with what it printed.
    """
    ways = []
    for number in range(runs):
        (folder / str(number)).mkdir()
        ways.append(_traced(folder / str(number), clip))
    return Way.common(ways)


def _has_started(calls: Path) -> bool:
    """Return whether the worker has confined itself a second time, which it does after the server's first answer."""
    return any(file.read_text("utf-8").count("/sandbox.py:confine:") > 1 for file in calls.iterdir())


def _traced(folder: Path, clip: Path) -> Way:
    (folder / "calls").mkdir()
    (folder / "site").mkdir()
    site = _SITE.format(folder=FOLDER, root=f"{ROOT}/", packages=PACKAGES)
    (folder / "site" / "sitecustomize.py").write_text(site, "utf-8")
    paths = os.pathsep.join((str(folder / "site"), str(ROOT)))
    environment = dict(os.environ) | {FOLDER: str(folder / "calls"), "PYTHONPATH": paths}
    address = f"ipc://{folder}/v2v.sock"
    flags = [part for name, value in RECIPE.items() if name != "preset" for part in ("--set", f"{name}={value}")]
    with (folder / "log").open("w", encoding="utf-8") as log:
        server = subprocess.Popen(
            [sys.executable, "-m", "v2v_server", "--videos", str(clip), "--workers", "1", "--bind", address,
             "--cache-dir", str(folder / "cache"), *flags],
            cwd=ROOT, env=environment, stdout=log, stderr=log,
        )  # fmt: skip
        try:
            with StatusClient(address) as client:
                while not (client.get_status(_START_SECONDS)["is_ready"] and _has_started(folder / "calls")):
                    time.sleep(0.1)
            program = _CONSUMER.replace("RECIPE", repr(RECIPE)).replace("QUIET", str(_QUIET_SECONDS))
            consumer = subprocess.run(
                [sys.executable, "-c", program, address],
                cwd=ROOT, env=environment, capture_output=True, text=True, timeout=300, check=False,
            )  # fmt: skip
        finally:
            server.terminate()
            server.wait(60)
    if consumer.returncode:
        raise RuntimeError(f"{consumer.stderr}\n{(folder / 'log').read_text('utf-8')}")
    began, ended, quiet = map(int, consumer.stdout.split())
    steps, every_idle, full_names = [], set[tuple[str, str]](), dict[tuple[int, str, str], str]()
    for file in sorted((folder / "calls").iterdir(), key=lambda file: int(file.stem)):
        lines = (re.split("[ :]", line) for line in file.read_text("utf-8").splitlines())
        calls = [Call(int(at), *names) for at, *names in lines]  # type: ignore[call-arg]
        idle = {call[1:3] for call in calls if ended + 5e8 < call.nanoseconds < quiet - 1e8}
        every_idle |= idle
        asked = [call for call in calls if began <= call.nanoseconds <= ended and call[1:3] not in idle]
        if asked:
            full_names |= {(len(steps), *call[1:3]): call.full_name for call in reversed(asked)}
            steps.append(list(dict.fromkeys(call[1:3] for call in asked)))
    return Way(steps, every_idle, full_names)


def sentence(file: str, name: str) -> str:
    """Return the first sentence of the docstring of a function; of its class or file if it has none.

    Args:
        name: with its class: "Batch.to".

    Raises:
        StopIteration: there is no such function.
    """
    node: ast.AST = ast.parse((ROOT / file).read_text("utf-8"))
    texts = [ast.get_docstring(node)]  # type: ignore[arg-type]
    for part in name.replace(".<locals>", "").split("."):
        node = next(each for each in nodes_of_names(node) if each.name == part)
        texts.append(ast.get_docstring(node))
    text = " ".join(next(filter(None, reversed(texts)), "").partition("\n\n")[0].split())
    return re.split(r"(?<=[.:]) ", text)[0].rstrip(":.").replace("|", "\\|") + "."


def nodes_of_names(node: ast.AST) -> Iterator[ast.FunctionDef | ast.ClassDef]:
    """Yield the classes and functions of a module, class or function, under conditions as well."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.FunctionDef | ast.ClassDef):
            yield child
        else:
            yield from nodes_of_names(child)


def section(way: Way) -> str:
    """Return the section of the page: for each process the files that it visits, in order of their first function."""
    rows = dict[str, list[str]](consumer=[], server=[], worker=[])
    for number, steps in enumerate(way.steps):
        first = dict(reversed(steps))
        process = next((name for name, file in _PROCESSES.items() if file in first), "server")
        for file in dict.fromkeys(file for file, _ in steps):
            function = way.full_names.get((number, file, first[file]), first[file])
            rows[process].append(f"| {process} | `{file}` | `{function}` | {sentence(file, function)} |")
    table = "\n".join(row for each in rows.values() for row in each)
    return _SECTION.format(heading=HEADING, files=way.files, returns=way.returns, table=table)


def main() -> None:
    """Print the way of one sample of a clip, a function a line, and how many files and returns it has."""
    parser = argparse.ArgumentParser(description="Trace one sample through the files of the project.")
    parser.add_argument("clip", type=Path, nargs="?", help="a video (default: one that is made)")
    parser.add_argument("--write", action="store_true", help="write the table of docs/architecture.md")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        clip = given.clip or Path(folder, "clip.mp4")
        if given.clip is None:
            write_clip(clip, panned_luma(200, 48, 64), gop=200, b_frames=2)
        way = trace(Path(folder), clip.resolve())
    if given.write:
        page = PAGE.read_text("utf-8")
        before, rest = page.split(HEADING)
        PAGE.write_text(before + section(way) + rest[rest.index("## ") :], "utf-8")
    else:
        for process in way.steps:
            print(*(f"{file}:{function}" for file, function in process), sep="\n", end="\n\n")
    print(f"{way.files} files, {way.returns} returns, {sum(map(len, way.steps))} functions")


if __name__ == "__main__":
    main()
