"""One server from start to stop: catalogue, sockets, workers, the loop, and a clean end."""

from __future__ import annotations

import contextlib
import math
import os
import secrets
import signal
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

from v2v_protocol.errors import CorpusError, UsageError, VideoError
from v2v_server.broker.actions import GiveUp, Instruction, LookFor, Record
from v2v_server.broker.blame import Cause, Loss
from v2v_server.broker.dispatcher import Dispatcher
from v2v_server.broker.quarantine import Quarantine, Verdict, quarantine_path, read_quarantine, write_verdict
from v2v_server.broker.sockets import Broker
from v2v_server.broker.worker_registry import REST_SECONDS
from v2v_server.catalogue.catalogue import Catalogue, open_catalogue
from v2v_server.config import ServeConfig
from v2v_server.console.progress import catalogue_progress
from v2v_server.console.status import StatusLine, summary, write
from v2v_server.schedule.sequences import SequenceTable
from v2v_server.supervise.local_pool import Pool
from v2v_server.system.process import keep_freed_memory, open_many_files, usable_cores
from v2v_server.video.fingerprint import check_fingerprint
from v2v_server.video.rows import Rows


def load_catalogue(config: ServeConfig) -> Catalogue:
    """The catalogue the configuration asks for, with its progress on stderr.

    Raises:
        CorpusError: nothing there, or nothing that can be used.
    """
    cores = usable_cores()
    with catalogue_progress() as progress:
        return open_catalogue(
            config.videos,
            list_file=config.list or None,
            rows=Rows.parse(config.rows),
            cache_dir=config.cache_dir or None,
            scene=config.spec.scene != "off",
            # A host whose workers are all elsewhere has its cores to itself.
            processes=min(config.workers or cores, cores),
            progress=progress,
            notice=progress.notice,
        )


def serve(config: ServeConfig) -> None:
    """Runs a server until SIGINT or SIGTERM.

    Raises:
        CorpusError: the corpus gives no sequence.
        UsageError: an address cannot be bound, or the port file not written.
        WorkerCrashLoop: the workers die without finishing anything.
    """
    keep_freed_memory()
    open_many_files()
    catalogue = load_catalogue(config)
    for note in catalogue.notes:
        _say(note)
    table = SequenceTable(catalogue.videos, catalogue.rows, config.spec)
    for line in summary(catalogue, config.spec, table):
        _say(line)
    if not table.count:
        raise CorpusError(f"--videos {config.videos}: no video gives a sequence under the recipe, see above")
    quarantine_file = quarantine_path(catalogue.root, config.cache_dir or None)
    quarantine = read_quarantine(quarantine_file)
    for verdict in quarantine.verdicts(quarantine.latest):
        _say(f"in quarantine: {verdict}")
    dispatcher = Dispatcher(
        catalogue,
        config.spec,
        quarantine=quarantine,
        wall_clock=_utc_now,
        lease_deadline_seconds=config.lease_deadline_seconds,
        session_idle_seconds=config.session_idle_seconds,
        max_credit_bytes=config.max_credit_bytes,
        expected_workers=max(config.workers, config.expect_workers),
    )
    label = f"w{secrets.token_hex(4)}"
    stop = threading.Event()
    with _stop_on_signals(stop):
        broker = Broker(config.bind, config.worker_bind or _private_address(label))
        pool = Pool(config.workers, catalogue.root, broker.worker_address, label)
        running = _Running(config, catalogue, dispatcher, broker, pool, quarantine, quarantine_file)

        def stopping() -> bool:
            return stop.is_set() or (config.parent_pid != 0 and os.getppid() != config.parent_pid)

        try:
            broker.run(
                dispatcher,
                give_up=running.give_up,
                record=running.record,
                look_for=running.look_for,
                watched=pool.watches,
                every_tick=running.every_tick,
                stopping=stopping,
            )
        finally:
            running.status.close()
            broker.say_farewell(dispatcher.stop_workers())
            pool.stop()
            broker.close()
            catalogue.close()
            if running.port_file_written:
                with contextlib.suppress(OSError):  # its folder is gone, say: nothing that a server could mend
                    Path(config.port_file).unlink(missing_ok=True)


@dataclass(slots=True)
class _Running:
    """What a running server does to the world: reap and kill workers, write verdicts, talk to its operator."""

    config: ServeConfig
    catalogue: Catalogue
    dispatcher: Dispatcher
    broker: Broker
    pool: Pool
    quarantine: Quarantine
    quarantine_file: Path
    status: StatusLine = field(default_factory=lambda: StatusLine(sys.stderr))  # that of now, not of the import
    announced: bool = False
    port_file_written: bool = False
    missing_told: float = -math.inf

    def every_tick(self, now: float) -> list[Instruction]:
        """Reaps the dead, starts what is due, announces, and shows the status."""
        instructions: list[Instruction] = []
        for death in self.pool.check(now, self.dispatcher.counters.samples):
            self._say(f"worker {death.identity.decode()} {death.loss.text}; its work is given to others")
            instructions += self.dispatcher.worker_lost(death.identity, death.loss, now)
        for refusal in self.dispatcher.take_refusals():
            self._say(f"passed over {refusal}")
        if not self.announced and (self.dispatcher.workers or not self.config.workers):
            self.announced = True
            self._say(f"ready: consumers connect to {self.broker.address}, workers to {self.broker.worker_address}")
            if self.config.port_file:
                _write_port_file(self.config.port_file, self.broker.address)
                self.port_file_written = True
        if self.announced:
            self.status.update(now, self.dispatcher, self.pool.running)
        return instructions

    def give_up(self, hopeless: GiveUp) -> Loss:
        """Ends the process of a worker that hangs, if it is one of ours."""
        elsewhere = Loss(Cause.UNEXPLAINED, hopeless.reason)
        loss = self.pool.give_up(hopeless.identity, hopeless.reason) or elsewhere
        name = hopeless.identity.decode(errors="replace")
        self._say(f"worker {name} {hopeless.reason}: {loss.text}; its work is given to others")
        return loss

    def look_for(self, missing: LookFor) -> bool:
        """Whether this host has the video as it was catalogued. If so, the operator is told of the host that has not,
        once in a while: all workers of a host fail alike."""
        try:
            check_fingerprint(self.catalogue.path(missing.video), missing.fingerprint)
        except (VideoError, CorpusError):
            return False
        now = time.monotonic()
        if now >= self.missing_told + REST_SECONDS:
            self.missing_told = now
            name = missing.identity.decode(errors="replace")
            self._say(
                f"worker {name} failed on {missing.video}, which is on this host as it was catalogued: "
                f"{missing.reason}; others make the sample, and it gets no work for {REST_SECONDS:g} s. Look at "
                "--videos on its host"
            )
        return True

    def record(self, instruction: Record) -> list[Verdict]:
        """Writes a verdict down. A server that cannot write goes on: its operator is told what that costs."""
        try:
            written = write_verdict(self.quarantine_file, instruction.verdict, self.quarantine)
        except (OSError, CorpusError) as error:
            verdict = instruction.verdict
            self._say(
                f"{verdict.path} from frame {verdict.frame}: {verdict.reason}; it is passed over this once and comes "
                f"again, because the quarantine cannot be written: {error}"
            )
            return []
        for verdict in written:
            self._say(f"quarantine: {verdict}")
        return written

    def _say(self, text: str) -> None:
        self.status.interrupt()
        _say(text)


def _private_address(label: str) -> str:
    """Where local workers connect: a socket without a file, so that nothing is left even after a kill -9."""
    return f"ipc://@v2v-{label}-{secrets.token_hex(8)}" if sys.platform.startswith("linux") else "tcp://127.0.0.1:*"


def _write_port_file(file: str, address: str) -> None:
    """Writes the address in one step: whoever sees the file sees all of it."""
    path = Path(file)
    partial = path.parent / f".{path.name}.{os.getpid()}"
    try:
        partial.write_text(address + "\n", encoding="utf-8")
        partial.replace(path)
    except OSError as error:
        with contextlib.suppress(OSError):
            partial.unlink()
        raise UsageError(f"--port-file {file}: {error.strerror}") from error


@contextlib.contextmanager
def _stop_on_signals(stop: threading.Event) -> Iterator[None]:
    """The first SIGINT or SIGTERM asks for a clean stop; a second one of them does what it always did."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def on_signal(number: int, frame: object) -> None:
        for each, handler in before.items():
            signal.signal(each, handler)
        stop.set()

    for number in before:
        signal.signal(number, on_signal)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _utc_now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


def _say(text: str) -> None:
    write(sys.stderr, text + "\n")
