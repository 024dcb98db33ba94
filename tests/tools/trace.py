"""Trace one sample through the files of the project, from the request to the batch.

Run: python -m tests.tools.trace CLIP

A server with one worker serves one sequence of a clip; a consumer takes it in epoch 0. Each process of the three notes
every call of a function of the project, with the time. The way of the sample is, for each process, the first call of
each function between the consumer's connecting and its batch, without the functions that are also called while no
sample is asked for. A profiler does not see compiled kernels, but the function that enters them.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from v2v_server.status.client import StatusClient

ROOT = Path(__file__).parents[2]
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
        name = NAMES[code] = f"{{file[len(ROOT):]}}:{{code.co_name}}" if ours else ""
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


@dataclass(frozen=True)
class Way:
    """The way of one sample.

    Attributes:
        steps: (file, function) for each process, in the order of time.
        idle: what is also called while no sample is asked for.
    """

    steps: list[list[tuple[str, str]]]
    idle: set[tuple[str, str]]

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


def trace(folder: Path, clip: Path) -> Way:
    """Serve one sample of the clip to one consumer; return its way.

    Args:
        folder: an empty folder.
        clip: a video of at least 21 frames.

    Raises:
        RuntimeError: a process failed; with what it printed.
    """
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
                while not client.get_status(_START_SECONDS)["is_ready"]:
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
    steps, every_idle = [], set()
    for file in sorted((folder / "calls").iterdir(), key=lambda file: int(file.stem)):
        calls = [Call(int(at), *name.split(":")) for at, name in map(str.split, file.read_text("utf-8").splitlines())]  # type: ignore[call-arg]
        idle = {call[1:] for call in calls if ended + 5e8 < call.nanoseconds < quiet - 1e8}
        every_idle |= idle
        asked = (call[1:] for call in calls if began <= call.nanoseconds <= ended)
        steps.append([step for step in dict.fromkeys(asked) if step not in idle])
    return Way([process for process in steps if process], every_idle)


def main() -> None:
    """Print the way of one sample of a clip, a function a line, and how many files and returns it has."""
    parser = argparse.ArgumentParser(description="Trace one sample through the files of the project.")
    parser.add_argument("clip", type=Path)
    with tempfile.TemporaryDirectory() as folder:
        way = trace(Path(folder), parser.parse_args().clip.resolve())
    for process in way.steps:
        print(*(f"{file}:{function}" for file, function in process), sep="\n", end="\n\n")
    print(f"{way.files} files, {way.returns} returns, {sum(map(len, way.steps))} functions")


if __name__ == "__main__":
    main()
