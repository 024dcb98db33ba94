"""A server of one's own: started as a subprocess, stopped with everything it started."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO

import psutil

from v2v_protocol.errors import ServerLost, UsageError
from v2v_protocol.programs import environment
from v2v_protocol.recipe import Recipe

_POLL_SECONDS = 0.05
_LAST_LINES = 12


class LocalServer:
    """``python -m v2v_server`` with this interpreter, from ``with`` on.

        with LocalServer("webvid10k/", workers=2) as server:
            dataset = V2VStreamDataset(server.address)

    Args:
        videos: folder or list of videos, as for ``v2v-serve --videos``.
        workers: server workers.
        flags: more flags for ``v2v-serve``; without ``--bind`` it listens on a free port of this host only.
        start_seconds: how long it may be silent until it listens. To catalogue a large folder for the first time takes
            longer, but then it says every few seconds how far it is.
        stop_seconds: how long it may take to leave when asked, before it is killed.

    Attributes:
        address: where it listens.

    Entering raises UsageError when the server leaves with status 2 (its message says what is wrong with the videos or
    flags) and ServerLost when it dies otherwise or is silent for too long; both quote the last lines it wrote.
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
        self._arguments = ["--videos", os.fspath(videos), "--workers", str(workers), *bind, *flags]
        self._start_seconds = start_seconds
        self._stop_seconds = stop_seconds
        self._process: subprocess.Popen[bytes] | None = None
        self._errors: IO[bytes] | None = None
        self._cpu_seconds: dict[tuple[int, float], float] = {}

    def __enter__(self) -> LocalServer:
        # The port file's folder is the server's only while it starts; what it writes goes to a file, because a pipe
        # that nobody reads would stop it.
        with tempfile.TemporaryDirectory(prefix="v2v-server-") as folder:
            port_file = Path(folder, "port")
            self._errors = tempfile.TemporaryFile()
            command = [sys.executable, "-m", "v2v_server", *self._arguments, "--port-file", str(port_file)]
            # A process that is killed cannot stop its server: the server looks after that itself.
            command += ["--parent-pid", str(os.getpid())]
            try:
                self._process = subprocess.Popen(
                    command,
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    stderr=self._errors,
                    env=environment(),
                )
                self.address = self._wait_for(port_file, self._process)
            except BaseException:
                self.stop()
                raise
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    @property
    def pid(self) -> int:
        """Of the server's main process.

        Raises:
            UsageError: it does not run.
        """
        if self._process is None:
            raise UsageError("the local server does not run: use it inside its with block")
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
                    f"{self.last_lines()}; start v2v-serve yourself, which shows what it is at, and connect to it, or "
                    "give LocalServer more start_seconds"
                )
            time.sleep(_POLL_SECONDS)

    def _stderr_bytes(self) -> int:
        return 0 if self._errors is None else os.fstat(self._errors.fileno()).st_size

    def last_lines(self) -> str:
        """The end of what the server wrote to its standard error."""
        if self._errors is None:
            return "(it was not started)"
        # The server writes where the file stands, and the two of us share that place: it must not be moved.
        lines = os.pread(self._errors.fileno(), self._stderr_bytes(), 0).decode(errors="replace").strip().splitlines()
        return "\n".join(lines[-_LAST_LINES:]) or "(it wrote nothing)"

    def stop(self) -> None:
        """Asks the server to leave (SIGTERM), then kills what is left of its processes. May be called again."""
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
                    with _ignore_ended_process():
                        survivor.kill()
                psutil.wait_procs(tree, self._stop_seconds)
        finally:
            errors, self._errors = self._errors, None
            if errors is not None:
                errors.close()

    def cpu_seconds(self) -> dict[int, float]:
        """User and system time of each process of the tree, by process id; the ones seen before and gone included."""
        for process in _tree(self.pid):
            with _ignore_ended_process():
                times = process.cpu_times()
                self._cpu_seconds[process.pid, process.create_time()] = times.user + times.system
        found: dict[int, float] = {}
        for (pid, _), seconds in self._cpu_seconds.items():
            found[pid] = found.get(pid, 0.0) + seconds
        return found

    def rss_bytes(self) -> dict[int, int]:
        """Resident bytes of each living process of the tree, by process id; pages they share count for each."""
        found: dict[int, int] = {}
        for process in _tree(self.pid):
            with _ignore_ended_process():
                found[process.pid] = process.memory_info().rss
        return found


def recipe_flags(recipe: Recipe) -> list[str]:
    """The recipe for ``v2v-serve``: at its start it looks which videos are long and large enough for it."""
    return [text for key, value in recipe.to_dict().items() for text in ("--set", f"{key}={json.dumps(value)}")]


def _tree(pid: int) -> Iterator[psutil.Process]:
    with _ignore_ended_process():
        root = psutil.Process(pid)
        yield root
        yield from root.children(recursive=True)


@contextmanager
def _ignore_ended_process() -> Iterator[None]:
    """A process may end between being listed and being asked."""
    try:
        yield
    except psutil.NoSuchProcess:
        return
