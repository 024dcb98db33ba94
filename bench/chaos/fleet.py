"""The processes of the chaos bench: a server with its workers, or brokers that share a pool; more workers; consumers.

The fleet starts them, restarts those that end, and stops them. Each has its TMPDIR in the run's folder, and a variable
in its environment by which it is found after its parent has ended.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

import psutil

from bench.chaos.consumer import log_path
from bench.chaos.hostile import TALLY
from bench.chaos.limited_worker import MODULE as LIMITED_WORKER
from bench.chaos.limited_worker import write_limit
from bench.processes import free_ports, last_in_line, workers_of
from v2v_protocol.errors import UsageError
from v2v_protocol.keys import VARIABLE as KEY_VARIABLE
from v2v_server.keys import KeyFolder

MARK = "V2V_CHAOS_RUN"
_STOP_SECONDS = 30.0
_LAST_WORDS_SECONDS = 5.0


@dataclass(slots=True)
class Process:
    """One place in the fleet, and its current process.

    Attributes:
        name: "server", "consumer 0", "worker 3".
        command: the program.
        folder: for its log.
        process: None before the first start.
        expected: its end was caused on purpose.
        side: key that it uses, if the server requires keys: "consumer", "worker", or "" for none.
    """

    name: str
    command: list[str]
    folder: Path
    process: subprocess.Popen[bytes] | None = None
    expected: bool = False
    side: str = ""

    @property
    def pid(self) -> int | None:
        """Return the process id; None when it does not run."""
        return None if self.process is None or self.process.poll() is not None else self.process.pid

    def last_lines(self, most: int = 1) -> str:
        """Return the last lines of its standard error."""
        lines = (self.folder / "stderr").read_text(encoding="utf-8", errors="replace").strip().splitlines()
        return "\n".join(lines[-most:]) or "(no output)"


def port_file(server: Process) -> Path:
    """Return the file that a server writes its address to once it is ready."""
    return server.folder / "port"


@dataclass(slots=True)
class Fleet:
    """A server, or several brokers; consumers and further workers.

    Args:
        folder: a new folder for all files.
        videos: the corpus.
        workers: of the server, or of the pool that several brokers share.
        consumers: their number.
        lease_deadline_seconds: of the server.
        server_module: module to run as the server.
        server_flags: more flags of the server.
        clip_cache: cache of decoded clips of the server's workers; None: no cache.
        host: address of the server.
        elsewhere: prefix of the commands of consumers and further workers, to run them on another host.
        keyed: whether the server requires keys.
        further_bytes: limit of a further worker's memory, that of its control group; 0: none.
        brokers: number of servers; several have no workers of their own. Consumers take turns with them.

    Attributes:
        failures: processes that ended without a fault.
        ready_at: when servers became ready, ascending.
        servers: the server, or all brokers.
        pool: the workers that several brokers share.
        addresses, worker_addresses: of the servers, for consumers and for workers.
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
    further_bytes: int = 0
    brokers: int = 1
    failures: list[str] = field(default_factory=list)
    ready_at: list[float] = field(default_factory=list)
    token: str = field(default_factory=lambda: f"{os.getpid()}-{time.monotonic_ns()}")
    servers: list[Process] = field(init=False)
    pool: list[Process] = field(init=False, default_factory=list)
    further_workers: list[Process] = field(init=False, default_factory=list)
    crowd: list[Process] = field(init=False)
    addresses: list[str] = field(init=False)
    worker_addresses: list[str] = field(init=False)
    cache: Path = field(init=False)
    tally: Path = field(init=False)
    tmp: Path = field(init=False)
    _awaited: list[Process] = field(init=False, default_factory=list)
    _added: int = field(init=False, default=0)

    def __post_init__(self) -> None:
        self.cache, self.tally, self.tmp = (self.folder / name for name in ("cache", "tally", "tmp"))
        for name in ("tmp", "cache"):
            (self.folder / name).mkdir(parents=True)
        if self.keyed:
            self._make_keys()
        found = [f"tcp://{self.host}:{port}" for port in free_ports(2 * self.brokers)]
        self.addresses, self.worker_addresses = found[: self.brokers], found[self.brokers :]
        self.servers = [self._server(number) for number in range(self.brokers)]
        if self.brokers > 1:
            self.pool = [self._worker(f"pool{number}") for number in range(self.workers)]
        self.crowd = []
        for number in range(self.consumers):
            folder = self.folder / f"consumer{number}"
            folder.mkdir()
            command = [
                *(*self.elsewhere, sys.executable, "-X", "faulthandler", "-m", "bench.chaos.consumer"),
                *("--address", self.addresses[number % self.brokers], "--profile", str(number)),
                *("--folder", str(folder)),
            ]
            self.crowd.append(Process(f"consumer {number}", command, folder, side="consumer"))

    @property
    def everyone(self) -> list[Process]:
        """Return all places."""
        return [*self.servers, *self.pool, *self.further_workers, *self.crowd]

    @property
    def server(self) -> Process:
        """Return the first server."""
        return self.servers[0]

    @property
    def address(self) -> str:
        """Return the first server's address for consumers."""
        return self.addresses[0]

    @property
    def worker_address(self) -> str:
        """Return the first server's address for workers."""
        return self.worker_addresses[0]

    @property
    def is_ready(self) -> bool:
        """Return whether all servers run and are ready."""
        return all(place.pid is not None and port_file(place).exists() for place in self.servers)

    def key(self, name: str) -> Path:
        """Return the file of a key: "consumer", "worker", or "revoked", which was a consumer's."""
        return self.folder / f"{name}.key"

    def _make_keys(self) -> None:
        server = KeyFolder(self.folder / "keys")
        server.init()
        for name in ("consumer", "worker", "revoked"):
            server.new(name, "worker" if name == "worker" else "consumer", self.key(name))
        server.revoke("revoked")

    def _server(self, number: int) -> Process:
        name = f"server{number or ''}"
        place = Process(name, [], self.folder / name)
        place.folder.mkdir()
        place.command = [
            *(sys.executable, "-m", self.server_module, "--videos", str(self.videos)),
            *("--workers", str(self.workers if self.brokers == 1 else 0), "--bind", self.addresses[number]),
            *("--worker-bind", self.worker_addresses[number], "--port-file", str(port_file(place))),
            *("--cache-dir", str(self.cache), "--lease-deadline-seconds", str(self.lease_deadline_seconds)),
            # The server's recipe only has to fit the corpus: every consumer states its own.
            *("--set", "voxels_per_clip=4", "--set", "crop_height_px=32", "--set", "crop_width_px=32"),
            *("--parent-pid", str(os.getpid())),
            *self.server_flags,
            *(() if self.clip_cache is None else ("--cache", str(self.clip_cache), "--cache-gib", "4")),
            *(("--keys", str(self.folder / "keys")) if self.keyed else ()),
        ]
        return place

    def start(self, start_seconds: float = 400.0) -> None:
        """Start pool and servers, then the consumers; wait until each consumer has saved a state.

        Raises:
            UsageError: a process does not start; the message quotes its output.
        """
        deadline = time.monotonic() + start_seconds
        for worker in self.pool:  # they get ready while the servers start
            self._spawn(worker)
        for server in self.servers:  # one after the other: the first writes the index that all read
            self._spawn(server)
            self.wait_for(lambda: not self._awaited, deadline)
        for consumer in self.crowd:
            self._spawn(consumer)
        self.wait_for(lambda: min(self.committed()) > 0, deadline)

    def wait_for(self, done: Callable[[], bool], deadline: float) -> None:
        """Run the fleet until ``done`` returns True.

        Raises:
            UsageError: a process ended without a fault, or the deadline has passed.
        """
        while not done():
            self.restart(time.monotonic())
            if self.failures:
                raise UsageError(self.failures[0])
            if time.monotonic() > deadline:
                raise UsageError(f"no batches in time; the server: {self.server.last_lines()}")
            time.sleep(0.05)

    def restart(self, now: float) -> None:
        """Restart what has ended, remove such further workers, note unexpected ends."""
        for server in [place for place in self._awaited if port_file(place).exists()]:
            self._awaited.remove(server)
            self.ready_at.append(now)
        for place in self.everyone:
            status = None if place.process is None else place.process.poll()
            if status is None:
                continue
            if not place.expected:
                self.failures.append(f"{place.name} ended unasked, status {status}: {place.last_lines()}")
            if place in self.further_workers:
                self.further_workers.remove(place)
            else:
                self._spawn(place)

    def add_worker(self) -> None:
        """Start one more worker, as from another host."""
        place = self._worker(f"further{self._added}")
        self._added += 1
        self._spawn(place)
        self.further_workers.append(place)

    def _worker(self, name: str) -> Process:
        folder = self.folder / name
        folder.mkdir()
        module = ["v2v_server.commands.worker"]
        if self.further_bytes:
            write_limit(folder / "limits", self.further_bytes)
            module = [LIMITED_WORKER, str(folder / "limits")]
        command = [
            *(*self.elsewhere, sys.executable, "-m", *module),
            *("--connect", ",".join(self.worker_addresses), "--videos", str(self.videos), "--name", name),
        ]
        return Process(f"worker {name}", command, folder, side="worker")

    @contextmanager
    def attacked(self, kind: str, *, last: bool = True) -> Iterator[subprocess.Popen[bytes]]:
        """Run hostile peers of that kind (:mod:`bench.chaos.hostile`), inside ``with``.

        Args:
            last: they get the lowest priority.
        """
        command = [sys.executable, "-m", "bench.chaos.hostile", "--address", self.address, "--kind", kind]
        if self.keyed:
            command += ["--worker-address", self.worker_address, "--revoked", str(self.key("revoked"))]
        peers = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env=self._environment("consumer"),
            start_new_session=True,
            preexec_fn=last_in_line if last else None,
        )
        try:
            yield peers
        finally:
            peers.kill()
            peers.wait()

    def cached_pieces(self) -> list[Path]:
        """Return the files of the cache of decoded clips."""
        return [] if self.clip_cache is None else sorted(self.clip_cache.glob("??/*"))

    def server_workers(self) -> list[int]:
        """Return the process ids of the server's workers."""
        return [] if self.server.pid is None else workers_of(self.server.pid)

    def committed(self) -> list[int]:
        """Return the number of batches that each consumer has committed."""
        states = [place.folder / "state.json" for place in self.crowd]
        return [json.loads(file.read_text(encoding="utf-8"))["committed"] if file.exists() else 0 for file in states]

    def logged_bytes(self) -> int:
        """Return the length of all consumers' logs, which grows with every batch."""
        logs = [log_path(place.folder) for place in self.crowd]
        return sum(path.stat().st_size for path in logs if path.exists())

    def _spawn(self, place: Process) -> None:
        if place in self.servers:
            port_file(place).unlink(missing_ok=True)
            self._awaited = [*(each for each in self._awaited if each is not place), place]
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
        key = str(self.key(side)) if self.keyed and side else ""
        return os.environ | {MARK: self.token, "TMPDIR": str(self.tmp), TALLY: str(self.tally), KEY_VARIABLE: key}

    def stop(self) -> list[str]:
        """Stop all processes by SIGTERM, consumers first.

        Returns:
            leftovers: processes that did not end or ended badly, and those of :meth:`traces`.
        """
        left = []
        for place in (*self.crowd, *self.further_workers, *self.pool, *self.servers):
            if place.process is None:
                continue
            if place.pid is not None:
                place.process.send_signal(signal.SIGCONT)
                place.process.terminate()
            try:
                status = place.process.wait(_STOP_SECONDS)
            except subprocess.TimeoutExpired:
                place.process.send_signal(signal.SIGABRT)  # consumers dump their stacks
                with suppress(subprocess.TimeoutExpired):
                    place.process.wait(_LAST_WORDS_SECONDS)
                place.process.kill()
                place.process.wait()
                left.append(f"{place.name} did not end within {_STOP_SECONDS:g} s of SIGTERM: {place.last_lines(30)}")
                continue
            if status not in (0, -signal.SIGTERM):
                left.append(f"{place.name} ended with status {status}: {place.last_lines()}")
        return left + self.traces()

    def kill(self) -> None:
        """Kill all processes."""
        for place in self.everyone:
            if place.process is not None:
                place.process.kill()
                place.process.wait()
        for process in self.marked():
            process.kill()

    def traces(self) -> list[str]:
        """Return what the ended processes left behind: processes, listening sockets, files."""
        _, alive = psutil.wait_procs(self.marked(), timeout=5.0)
        left = [f"process {process.pid}: {' '.join(process.info['cmdline'] or ())[:200]}" for process in alive]
        left += [f"zombie {each.pid}" for each in psutil.Process().children() if each.status() == psutil.STATUS_ZOMBIE]
        for port in (int(address.rpartition(":")[2]) for address in (*self.addresses, *self.worker_addresses)):
            with socket.socket() as probe:
                if probe.connect_ex((self.host, port)) == 0:
                    left.append(f"port {port} still listens")
        left += [f"file {path.relative_to(self.folder)}" for path in sorted(self.tmp.rglob("*")) if path.is_file()]
        left += [
            f"file {path.name}" for path in self.cache.iterdir() if path.name.endswith(("-wal", "-shm", "-journal"))
        ]
        left += [f"the port file of {place.name}" for place in self.servers if port_file(place).exists()]
        return left

    def marked(self) -> list[psutil.Process]:
        """Return the living processes of this run, whatever their parent."""
        # psutil gives None for another user's process, and leaves out those that have ended.
        return [
            process
            for process in psutil.process_iter(["environ", "cmdline"])
            if process.pid != os.getpid() and (process.info["environ"] or {}).get(MARK) == self.token
        ]
