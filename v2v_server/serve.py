"""One server from start to stop: catalogue, sockets, workers, the loop, and a clean end."""

from __future__ import annotations

import contextlib
import os
import secrets
import signal
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

from v2v_protocol.errors import CorpusError, UsageError
from v2v_server.broker import Broker
from v2v_server.config import ServeConfig
from v2v_server.dispatcher import Dispatcher, Instruction
from v2v_server.pool import Pool
from v2v_server.process import keep_freed_memory
from v2v_server.progress import catalogue_progress
from v2v_server.sequences import SequenceTable
from v2v_server.status import StatusLine, summary
from v2v_server.video.catalogue import Catalogue, open_catalogue
from v2v_server.video.rows import Rows


def load_catalogue(config: ServeConfig) -> Catalogue:
    """The catalogue the configuration asks for, with a progress bar on stderr while new files are probed.

    Raises:
        CorpusError: nothing there, or nothing that can be used.
    """
    with catalogue_progress() as progress:
        return open_catalogue(
            config.videos,
            list_file=config.list or None,
            rows=Rows.parse(config.rows),
            cache_dir=config.cache_dir or None,
            processes=max(1, min(config.workers, os.cpu_count() or 1)),
            progress=progress,
        )


def serve(config: ServeConfig) -> None:
    """Runs a server until SIGINT or SIGTERM.

    Raises:
        CorpusError: the corpus gives no sequence.
        UsageError: an address cannot be bound, or the port file not written.
        WorkerCrashLoop: the workers die without finishing anything.
    """
    keep_freed_memory()
    catalogue = load_catalogue(config)
    for note in catalogue.notes:
        _say(note)
    table = SequenceTable(catalogue.videos, catalogue.rows, config.spec)
    for line in summary(catalogue, config.spec, table):
        _say(line)
    if not table.count:
        raise CorpusError(f"--videos {config.videos}: no video gives a sequence under the recipe, see above")
    dispatcher = Dispatcher(
        catalogue,
        config.spec,
        lease_deadline_seconds=config.lease_deadline_seconds,
        session_idle_seconds=config.session_idle_seconds,
        max_credit_bytes=config.max_credit_bytes,
    )
    label = f"w{secrets.token_hex(4)}"
    stop = threading.Event()
    with _stop_on_signals(stop):
        broker = Broker(config.bind, config.worker_bind or _private_address(label))
        pool = Pool(config.workers, catalogue.root, broker.worker_address, label)
        try:
            _loop(config, dispatcher, broker, pool, stop)
        finally:
            broker.carry_out(dispatcher, dispatcher.stop_workers())
            pool.stop()
            broker.close()
            catalogue.close()
            if config.port_file:
                Path(config.port_file).unlink(missing_ok=True)


def _loop(config: ServeConfig, dispatcher: Dispatcher, broker: Broker, pool: Pool, stop: threading.Event) -> None:
    status = StatusLine()
    announced = False

    def every_tick(now: float) -> list[Instruction]:
        nonlocal announced
        instructions: list[Instruction] = []
        for death in pool.check(now, dispatcher.counters.samples):
            _say(f"worker {death.identity.decode()} {death.status}; its work is given to others")
            instructions += dispatcher.worker_lost(death.identity, death.blame, now)
        for refusal in dispatcher.take_refusals():
            _say(f"passed over {refusal}")
        if not announced and (dispatcher.workers or not config.workers):
            announced = True
            _say(f"ready: consumers connect to {broker.address}, workers to {broker.worker_address}")
            if config.port_file:
                _write_port_file(config.port_file, broker.address)
        if announced:
            status.update(now, dispatcher, pool.running)
        return instructions

    def stopping() -> bool:
        return stop.is_set() or (config.parent_pid != 0 and os.getppid() != config.parent_pid)

    try:
        broker.run(dispatcher, give_up=pool.give_up, every_tick=every_tick, stopping=stopping)
    finally:
        status.close()


def _private_address(label: str) -> str:
    """Where local workers connect: a socket without a file, so that nothing is left even after a kill -9."""
    return f"ipc://@v2v-{label}-{secrets.token_hex(8)}" if sys.platform.startswith("linux") else "tcp://127.0.0.1:*"


def _write_port_file(file: str, address: str) -> None:
    """Writes the address in one step: whoever sees the file sees all of it."""
    path = Path(file)
    partial = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        partial.write_text(address + "\n", encoding="utf-8")
        partial.replace(path)
    except OSError as error:
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


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)
