"""The processes of the chaos test: one server with its workers, further workers, consumers; started, watched, started
again when they end, and ended.

Everything runs with TMPDIR in the test's folder and with one variable in its environment by which it is found again,
whoever its parent is by then.
"""

from __future__ import annotations

import json
import os
import random
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import psutil

from bench.chaos.consumer import log_path
from bench.chaos.keyring import KeyRing
from v2v_protocol.errors import UsageError
from v2v_protocol.keys import VARIABLE as KEY_VARIABLE

MARK = "V2V_CHAOS_RUN"
_STOP_SECONDS = 30.0
_LAST_WORDS_SECONDS = 5.0
_PORTS = range(20_000, 30_000)
"""Below the ports that the kernel gives to outgoing connections. A consumer that reconnects to a dead server's port
could else be given that very port for its own end, connect to itself and keep the address (TCP simultaneous open)."""


@dataclass(slots=True)
class Process:
    """One place in the fleet, and the process that has it now.

    Attributes:
        name: "server", "consumer 0", "worker 3".
        command: the program.
        folder: its log goes here.
        process: None when it is not there.
        expected: its end was caused on purpose.
        side: whose key it comes with, where the server takes nobody without: "consumer", "worker", "" for none.
    """

    name: str
    command: list[str]
    folder: Path
    process: subprocess.Popen[bytes] | None = None
    expected: bool = False
    side: str = ""

    @property
    def pid(self) -> int | None:
        """None when it does not run."""
        return None if self.process is None or self.process.poll() is not None else self.process.pid

    def last_lines(self, most: int = 1) -> str:
        """Of what it wrote to its standard error."""
        file = self.folder / "stderr"
        if not file.exists():
            return "(it was not started)"
        lines = file.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        return "\n".join(lines[-most:]) or "(it wrote nothing)"


@dataclass(frozen=True, slots=True)
class Failure:
    """A process that ended although nobody had touched it."""

    name: str
    status: int
    text: str


@dataclass(slots=True)
class Fleet:
    """
    Args:
        folder: for everything that is written.
        videos: the corpus.
        workers: of the server's own.
        consumers: how many.
        lease_deadline_seconds: for the server.
        server_module: what is run as the server.
        server_flags: more of its flags.
        clip_cache: folder of decoded clips, for the server's own workers; None: they keep none.
        host: where the server listens.
        elsewhere: what the commands of consumers and further workers begin with, to run them on another host.
        keyed: the server takes nobody without a key, and all is encrypted.

    Attributes:
        failures: processes that ended unasked.
        ready_at: when servers said they were ready, ascending.
    """

    folder: Path
    videos: Path
    workers: int
    consumers: int
    lease_deadline_seconds: float
    server_module: str = "v2v_server"
    server_flags: tuple[str, ...] = ()
    clip_cache: Path | None = None
    host: str = "127.0.0.1"
    elsewhere: tuple[str, ...] = ()
    keyed: bool = False
    failures: list[Failure] = field(default_factory=list)
    ready_at: list[float] = field(default_factory=list)
    token: str = field(default_factory=lambda: f"{os.getpid()}-{time.monotonic_ns()}")
    server: Process = field(init=False)
    further_workers: list[Process] = field(init=False, default_factory=list)
    crowd: list[Process] = field(init=False)
    keys: KeyRing | None = field(init=False)
    _address: str = field(init=False)
    _worker_address: str = field(init=False)
    _awaited: bool = field(init=False, default=False)
    _added: int = field(init=False, default=0)

    def __post_init__(self) -> None:
        for name in ("tmp", "cache", "server"):
            (self.folder / name).mkdir(parents=True)
        self.keys = KeyRing.made(self.folder / "keys") if self.keyed else None
        self._address, self._worker_address = (f"tcp://{self.host}:{port}" for port in free_ports(2))
        self.server = Process("server", self._server_command(), self.folder / "server")
        self.crowd = []
        for number in range(self.consumers):
            folder = self.folder / f"consumer{number}"
            folder.mkdir()
            command = [*self.elsewhere, sys.executable, "-X", "faulthandler", "-m", "bench.chaos.consumer"]
            command += ["--address", self._address, "--profile", str(number), "--folder", str(folder)]
            self.crowd.append(Process(f"consumer {number}", command, folder, side="consumer"))

    @property
    def port_file(self) -> Path:
        """Written by the server when it is ready."""
        return self.folder / "port"

    @property
    def cache(self) -> Path:
        """Folder of the catalogue index."""
        return self.folder / "cache"

    @property
    def tally(self) -> Path:
        """As many bytes as hostile peers made connections by hand, or were refused a handshake."""
        return self.folder / "tally"

    @property
    def tmp(self) -> Path:
        """TMPDIR of all processes."""
        return self.folder / "tmp"

    @property
    def addresses(self) -> tuple[str, str]:
        """The server's, for consumers and for workers."""
        return self._address, self._worker_address

    @property
    def ports(self) -> list[int]:
        """The server's two."""
        return [int(address.rpartition(":")[2]) for address in self.addresses]

    @property
    def everyone(self) -> list[Process]:
        """All places."""
        return [self.server, *self.further_workers, *self.crowd]

    def _server_command(self) -> list[str]:
        return [
            *(sys.executable, "-m", self.server_module, "--videos", str(self.videos)),
            *("--workers", str(self.workers)),
            *("--bind", self._address, "--worker-bind", self._worker_address, "--port-file", str(self.port_file)),
            *("--cache-dir", str(self.cache), "--lease-deadline-seconds", str(self.lease_deadline_seconds)),
            # The server's own recipe only has to fit the corpus: every consumer states its own.
            *("--set", "voxels_per_clip=4", "--set", "crop_height_px=32", "--set", "crop_width_px=32"),
            *("--parent-pid", str(os.getpid())),
            *self.server_flags,
            *(() if self.clip_cache is None else ("--cache", str(self.clip_cache), "--cache-gib", "4")),
            *(() if self.keys is None else ("--keys", str(self.keys.server))),
        ]

    # --- living -------------------------------------------------------------------------------------------------------

    def start(self, start_seconds: float = 180.0) -> None:
        """Starts the server, then the consumers, and returns when each of them has saved a state.

        Raises:
            UsageError: they do not come up; the message quotes what was said.
        """
        deadline = time.monotonic() + start_seconds
        self._spawn(self.server)
        self._await(lambda: bool(self.ready_at), deadline)
        for consumer in self.crowd:
            self._spawn(consumer)
        self._await(lambda: min(self.committed()) > 0, deadline)

    def _await(self, done: Callable[[], bool], deadline: float) -> None:
        while not done():
            self.look(time.monotonic())
            if self.failures:
                raise UsageError(f"{self.failures[0].name} does not come up: {self.failures[0].text}")
            if time.monotonic() > deadline:
                raise UsageError(f"no batches yet, and out of patience; the server: {self.server.last_lines()}")
            time.sleep(0.05)

    def look(self, now: float) -> None:
        """Starts again what has ended (a further worker is not, its place is gone), and notes what ended unasked."""
        if self._awaited and self.port_file.exists():
            self._awaited = False
            self.ready_at.append(now)
        for place in self.everyone:
            status = None if place.process is None else place.process.poll()
            if status is None:
                continue
            if not place.expected:
                self.failures.append(Failure(place.name, status, place.last_lines()))
            if place in self.further_workers:
                self.further_workers.remove(place)
            else:
                self._spawn(place)

    def add_worker(self) -> None:
        """One more worker, as from another host."""
        name = f"further{self._added}"
        self._added += 1
        folder = self.folder / name
        folder.mkdir()
        command = [*self.elsewhere, sys.executable, "-m", "v2v_server.commands.worker"]
        command += ["--connect", self._worker_address, "--videos", str(self.videos), "--name", name]
        place = Process(f"worker {name}", command, folder, side="worker")
        self._spawn(place)
        self.further_workers.append(place)

    def peers(self, kind: str, *, last: bool = True) -> subprocess.Popen[bytes]:
        """Hostile peers of that kind (:mod:`bench.chaos.hostile`); whoever asks ends them.

        Args:
            last: they get what others leave of the processor.
        """
        command = [sys.executable, "-m", "bench.chaos.hostile", "--address", self._address, "--kind", kind]
        command += ["--tally", str(self.tally)]
        if self.keys is not None:
            command += ["--worker-address", self._worker_address, "--revoked", str(self.keys.revoked)]
        return subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env=self._environment("consumer"),
            start_new_session=True,
            preexec_fn=last_in_line if last else None,
        )

    def cached_pieces(self) -> list[Path]:
        """Pieces of decoded clips that are kept."""
        return [] if self.clip_cache is None else sorted(self.clip_cache.glob("??/*"))

    def server_workers(self) -> list[int]:
        """Process ids of the server's own workers."""
        if self.server.pid is None:
            return []
        try:
            children = psutil.Process(self.server.pid).children()
            return [child.pid for child in children if "v2v_server.commands.worker" in child.cmdline()]
        except (psutil.NoSuchProcess, psutil.ZombieProcess):
            return []

    def committed(self) -> list[int]:
        """Batches that each consumer has committed."""
        counts = []
        for place in self.crowd:
            state = place.folder / "state.json"
            counts.append(json.loads(state.read_text(encoding="utf-8"))["committed"] if state.exists() else 0)
        return counts

    def logged_bytes(self) -> int:
        """Length of all consumers' logs: it grows whenever anybody gets a batch."""
        logs = [log_path(place.folder) for place in self.crowd]
        return sum(path.stat().st_size for path in logs if path.exists())

    def _spawn(self, place: Process) -> None:
        if place is self.server:
            self.port_file.unlink(missing_ok=True)
            self._awaited = True
        place.expected = False
        with (place.folder / "stderr").open("ab") as errors:
            place.process = subprocess.Popen(
                place.command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=errors,
                env=self._environment(place.side),
            )

    def _environment(self, side: str) -> dict[str, str]:
        key = "" if self.keys is None or not side else str(getattr(self.keys, side))
        return os.environ | {MARK: self.token, "TMPDIR": str(self.tmp), KEY_VARIABLE: key}

    # --- the end ------------------------------------------------------------------------------------------------------

    def stop(self) -> list[str]:
        """Asks everybody to leave, consumers first.

        Returns:
            what was left over: processes that did not leave or left badly, and what :meth:`traces` finds.
        """
        left = []
        for place in (*self.crowd, *self.further_workers, self.server):
            if place.process is None:
                continue
            if place.pid is not None:
                place.process.send_signal(signal.SIGCONT)
                place.process.terminate()
            try:
                status = place.process.wait(_STOP_SECONDS)
            except subprocess.TimeoutExpired:
                place.process.send_signal(signal.SIGABRT)  # consumers say where they are
                with suppress(subprocess.TimeoutExpired):
                    place.process.wait(_LAST_WORDS_SECONDS)
                place.process.kill()
                place.process.wait()
                left.append(f"{place.name} did not leave within {_STOP_SECONDS:g} s of SIGTERM: {place.last_lines(30)}")
                continue
            if status not in (0, -signal.SIGTERM):
                left.append(f"{place.name} left with status {status}: {place.last_lines()}")
        return left + self.traces()

    def kill(self) -> None:
        """Ends everything at once, whatever state it is in."""
        for place in self.everyone:
            if place.process is not None:
                place.process.kill()
                place.process.wait()
        for process in self.marked():
            process.kill()

    def traces(self) -> list[str]:
        """What processes that are gone should have taken with them: processes, listening sockets, files."""
        _, alive = psutil.wait_procs(self.marked(), timeout=5.0)
        left = [f"process {process.pid}: {_command_of(process)}" for process in alive]
        for child in psutil.Process().children():
            if child.status() == psutil.STATUS_ZOMBIE:
                left.append(f"zombie {child.pid}")
        for port in self.ports:
            with socket.socket() as probe:
                if probe.connect_ex((self.host, port)) == 0:
                    left.append(f"port {port} still listens")
        left += [f"file {path.relative_to(self.folder)}" for path in sorted(self.tmp.rglob("*")) if path.is_file()]
        left += [
            f"file {path.name}" for path in self.cache.iterdir() if path.name.endswith(("-wal", "-shm", "-journal"))
        ]
        if self.port_file.exists():
            left.append("the port file")
        return left

    def marked(self) -> list[psutil.Process]:
        """Living processes of this run, whoever started them."""
        found = []
        for process in psutil.process_iter():
            try:
                if process.pid != os.getpid() and process.environ().get(MARK) == self.token:
                    found.append(process)
            except (psutil.AccessDenied, psutil.NoSuchProcess, psutil.ZombieProcess, OSError):
                continue  # not ours, or gone
        return found


def last_in_line() -> None:
    """Gives the calling process what others leave of the processor: to be called in a new one, before its program."""
    os.nice(19)
    with suppress(OSError):  # else the share of its session would not be lowered, where sessions have one
        Path("/proc/self/autogroup").write_text("19", encoding="ascii")


def free_ports(count: int) -> list[int]:
    """Ports that nobody listens on just now.

    Raises:
        UsageError: there are not so many.
    """
    found: list[int] = []
    for port in random.sample(_PORTS, len(_PORTS)):
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind(("127.0.0.1", port))
            except OSError:
                continue
        found.append(port)
        if len(found) == count:
            return found
    raise UsageError(f"no free port from {_PORTS[0]} to {_PORTS[-1]}")


def shared_memory() -> set[str]:
    """Names of the shared memory of this host: files, for a folder there is somebody's place for temporary files."""
    folder = Path("/dev/shm")
    return {item.name for item in os.scandir(folder) if item.is_file()} if folder.is_dir() else set()


def abandoned_memory(before: set[str]) -> list[str]:
    """Names of the shared memory that came since and that no living process maps: what others use is theirs."""
    found: dict[str, str] = {}
    for name in shared_memory() - before:
        with suppress(FileNotFoundError):  # gone by now
            found[str(os.stat(f"/dev/shm/{name}").st_ino)] = name
    for maps in Path("/proc").glob("[0-9]*/maps") if found else ():
        try:
            text = maps.read_text(encoding="utf-8", errors="replace")
        except OSError:
            continue  # not ours to look at, or gone
        for line in text.splitlines():
            if "/dev/shm/" in line:  # by number: who made a semaphore maps it under a name that it had before
                found.pop(line.split()[4], None)
    return sorted(found.values())


def _command_of(process: psutil.Process) -> str:
    try:
        return " ".join(process.cmdline())[:200]
    except psutil.NoSuchProcess:
        return "gone by now"
