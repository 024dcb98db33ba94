"""Run a server as a subprocess, and stop it with every process it started."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

import psutil

from v2v_client.options import require_videos
from v2v_protocol.errors import ServerLost, UsageError, undo_on_error
from v2v_protocol.programs import environment
from v2v_protocol.recipe import Recipe
from v2v_protocol.spec import StreamSpec

_POLL_SECONDS = 0.05
_LAST_LINES = 12


class LocalServer:
    """Run ``python -m v2v_server`` with this interpreter inside a ``with`` block.

        with LocalServer("webvid10k/", workers=2) as server:
            dataset = V2VStreamDataset(server.address)

    Args:
        videos: folder or list of videos, as for ``v2v-serve --videos``.
        workers: server workers.
        flags: more flags for ``v2v-serve``; without ``--bind`` it listens on a free port of this host only.
        start_seconds: how long the server may write nothing before it listens. Cataloguing a large folder for the first
            time takes longer in total, but reports progress every few seconds.
        stop_seconds: how long the server may take to stop before it is killed.

    Attributes:
        address: the address it listens on.

    Entering raises UsageError if the server exits with status 2 (its message says what is wrong with the videos or
    flags), and ServerLost if it dies otherwise or is silent for too long. Both quote the last lines it wrote.
    """

    address: str

    def __init__(
        self,
        videos: str | os.PathLike[str],
        *,
        workers: int = 2,
        flags: Sequence[str] = (),
        start_seconds: float = 600.0,
        stop_seconds: float = 15.0,
    ) -> None:
        bind = ["--bind", "tcp://127.0.0.1:*"] if "--bind" not in flags else []
        self._arguments = ["--videos", require_videos(videos), "--workers", str(workers), *bind, *flags]
        self._start_seconds = start_seconds
        self._stop_seconds = stop_seconds
        self._process: subprocess.Popen[bytes] | None = None
        self._errors: IO[bytes] | None = None
        self._owner = 0  # the process that started the server
        self._cpu_seconds: dict[tuple[int, float], float] = {}

    def __enter__(self) -> LocalServer:
        self._owner = os.getpid()
        # The server needs the port file's folder only while it starts. Its output goes to a file, because it would
        # block on a full pipe.
        with tempfile.TemporaryDirectory(prefix="v2v-server-") as folder:
            port_file = Path(folder, "port")
            self._errors = tempfile.TemporaryFile()
            command = [sys.executable, "-m", "v2v_server", *self._arguments, "--port-file", str(port_file)]
            # A killed process cannot stop its server, so the server watches its parent.
            command += ["--parent-pid", str(os.getpid())]
            with undo_on_error(self.stop):
                self._process = subprocess.Popen(
                    command,
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    stderr=self._errors,
                    env=environment(),
                )
                self.address = self._wait_for(port_file, self._process)
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    @property
    def pid(self) -> int:
        """Return the id of the server's main process.

        Raises:
            UsageError: the server is not running.
        """
        if self._process is None:
            raise UsageError("the local server is not running: use it inside its with block")
        return self._process.pid

    def _wait_for(self, port_file: Path, process: subprocess.Popen[bytes]) -> str:
        seen, deadline = 0, time.monotonic() + self._start_seconds
        while True:
            if port_file.exists() and (address := port_file.read_text(encoding="utf-8").strip()):
                return address
            status = process.poll()
            if status is not None:
                raise (UsageError if status == 2 else ServerLost)(
                    f"the local server ended with status {status} before it listened: {self.last_lines()}"
                )
            if self._stderr_bytes() > seen:
                seen, deadline = self._stderr_bytes(), time.monotonic() + self._start_seconds
            if time.monotonic() >= deadline:
                raise ServerLost(
                    f"the local server does not listen after {self._start_seconds:g} s of silence: "
                    f"{self.last_lines()}; start v2v-serve yourself, which shows its progress, and connect to it, or "
                    "give LocalServer more start_seconds"
                )
            time.sleep(_POLL_SECONDS)

    def _stderr_bytes(self) -> int:
        return 0 if self._errors is None else os.fstat(self._errors.fileno()).st_size

    def last_lines(self) -> str:
        """Return the last lines that the server wrote to its standard error."""
        if self._errors is None:
            return "(it was not started)"
        # pread, because the server shares the file's offset and writes there.
        lines = os.pread(self._errors.fileno(), self._stderr_bytes(), 0).decode(errors="replace").strip().splitlines()
        return "\n".join(lines[-_LAST_LINES:]) or "(it wrote nothing)"

    def stop(self) -> None:
        """Stop the server with SIGTERM, then kill its remaining processes.

        Repeated calls do nothing. Calls in a forked process do nothing either, because the server is not its own.
        """
        if os.getpid() != self._owner:
            return
        process, self._process = self._process, None
        try:
            if process is not None:
                tree = list(_tree(process.pid))
                process.terminate()
                try:
                    process.wait(self._stop_seconds)
                except subprocess.TimeoutExpired:
                    process.kill()
                    process.wait()
                for survivor in tree:
                    with suppress(psutil.NoSuchProcess):
                        survivor.kill()
                psutil.wait_procs(tree, self._stop_seconds)
        finally:
            errors, self._errors = self._errors, None
            if errors is not None:
                errors.close()

    def cpu_seconds(self) -> dict[int, float]:
        """Return user plus system time of each process of the tree by process id, including ended ones seen before."""
        for process in _tree(self.pid):
            with suppress(psutil.NoSuchProcess):
                times = process.cpu_times()
                self._cpu_seconds[process.pid, process.create_time()] = times.user + times.system
        found: dict[int, float] = {}
        for (pid, _), seconds in self._cpu_seconds.items():
            found[pid] = found.get(pid, 0.0) + seconds
        return found

    def rss_bytes(self) -> dict[int, int]:
        """Return resident bytes of each living process of the tree by process id; shared pages count for each."""
        found: dict[int, int] = {}
        for process in _tree(self.pid):
            with suppress(psutil.NoSuchProcess):
                found[process.pid] = process.memory_info().rss
        return found


def server_flags(recipe: Recipe, options: Mapping[str, Any], *others: str) -> list[str]:
    """Return flags that give ``v2v-serve`` a stream's recipe, so that its start names the videos that are too small,
    and what the recipe may need: its scene analysis and dtype.

    Args:
        options: fields of the stream's spec by name; None takes the default.
        others: more flags.
    """
    named = ("scene", "voxel_dtype")
    spec = StreamSpec.from_dict({key: options.get(key) for key in ("preset", *named)})
    flags = [text for key, value in recipe.to_dict().items() for text in ("--set", f"{key}={json.dumps(value)}")]
    for name in named:
        if (value := getattr(spec, name)) != getattr(StreamSpec(), name):
            flags += (f"--{name.replace('_', '-')}", value)
    return [*flags, *others]


def _tree(pid: int) -> Iterator[psutil.Process]:
    # A process may end between being listed and being queried, here and above.
    with suppress(psutil.NoSuchProcess):
        root = psutil.Process(pid)
        yield root
        yield from root.children(recursive=True)
