"""Run one server from start to stop: catalogue, sockets, workers, the loop, and a clean end. One thread, one loop."""

from __future__ import annotations

import contextlib
import gc
import math
import os
import secrets
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from v2v_protocol.arena import give_back_freed_memory
from v2v_protocol.errors import CorpusError, IndexUnreadable, V2VError, VideoChanged, VideoError, VideoGone
from v2v_protocol.link.router import ConsumerGone, FromConsumer, FromWorker, InFlight, Sockets
from v2v_protocol.link.user import OwnUser
from v2v_protocol.progress import Progress
from v2v_protocol.write_aside import write_file
from v2v_server.broker.dispatcher import Dispatcher
from v2v_server.broker.leases import REST_SECONDS, Cause, Loss, Request, clean_name
from v2v_server.broker.state import (
    Action,
    AddToQuarantine,
    Broker,
    CheckVideo,
    Disconnect,
    GiveUp,
    Grant,
    ReportRefusal,
    SendStatus,
    ToConsumer,
    ToWorker,
)
from v2v_server.config import ServeConfig
from v2v_server.corpus.catalogue import Catalogue, complete_lease, open_catalogue
from v2v_server.corpus.scenes.picture_check import check_in_background
from v2v_server.corpus_words import corpus_summary, notes_of
from v2v_server.keys import KeyFolder
from v2v_server.page.child import PageProcess
from v2v_server.quarantine import QuarantineEntry, quarantine_path, read_quarantine, write_entry
from v2v_server.schedule import SequenceTable
from v2v_server.status.snapshot import StatusPublisher
from v2v_server.status.terminal import StatusView, format_shutdown_summary
from v2v_server.store.cache import make_cache
from v2v_server.supervise.local_host import WorkerProcess
from v2v_server.supervise.pool import Pool, Scaling, make_pool, question_workers
from v2v_server.system.log import GIB, Level, Log
from v2v_server.system.process import keep_freed_memory, most_connections, open_many_files, usable_cores
from v2v_server.video.fingerprint import CHANGED
from v2v_server.video.rows import Rows

_LONGEST_TURN_SECONDS = 1.0
"""A longer step than this counts as time in which the process was stopped."""
_FILES_A_WORKER = 7
_TURN_SECONDS = 0.1
"""Longest wait of the loop without a message; also the interval of checks of deadlines and workers."""
_SOON_SECONDS = 5.0
"""Time after which blocked leases are reported."""
_GIVE_BACK_SECONDS = 12.0
"""Time from the end of a connection until its memory is returned to the kernel; its session is forgotten by then."""
_RECORD_SECONDS = 2.0
"""Longest time to retry writing a quarantine entry while another process writes to the file."""
_OWN_USER_RULE = (
    "without keys this server serves only root and its own user; make keys with v2v-keys init and give --keys, or give "
    "--insecure to serve every user of this host"
)


def load_catalogue(config: ServeConfig) -> Catalogue:
    """Open the catalogue that the configuration asks for, with its progress on stderr.

    Raises:
        CorpusError: there are no videos, or no usable ones.
    """
    cores = usable_cores()
    log = Log(is_json=config.log_format == "json")
    with Progress("probing videos", say=log.say if log.is_json else None) as progress:
        catalogue = open_catalogue(
            config.videos,
            list_file=config.list or None,
            rows=Rows.parse(config.rows),
            cache_dir=config.cache_dir or None,
            copies=config.copies or None,
            copies_gib=config.copies_gib,
            kind=config.kind,
            scene=config.spec.scene != "off",
            # Without local workers all cores are free for probing.
            processes=min(config.most_workers or cores, cores),
            progress=progress,
            notice=progress.notice,
        )
    gc.collect()
    give_back_freed_memory()  # opening a catalogue of a million names leaves tens of megabytes unused
    return catalogue


def serve(config: ServeConfig, standbys: list[WorkerProcess] | None = None, debug: bool = False) -> int:
    """Run a server until SIGINT or SIGTERM.

    Returns:
        the number of the signal; 0 if its parent has ended.

    Args:
        standbys: see :func:`v2v_server.supervise.pool.make_pool`.
        debug: whether its workers show the traceback of an error.

    Raises:
        CorpusError: the corpus gives no sequence.
        UsageError: an address cannot be bound, the port file cannot be written, or the engine is not available.
        WorkerCrashLoop: the workers die without finishing anything.
    """
    keep_freed_memory()
    open_many_files()
    log, label = Log(is_json=config.log_format == "json"), f"w{secrets.token_hex(4)}"
    # All that may be refused comes before the videos, which can take minutes to catalogue.
    keys = KeyFolder(Path(config.keys)) if config.keys else None
    if config.cache:
        make_cache(Path(config.cache).absolute())
    with contextlib.ExitStack() as opened:
        page = None
        if config.page:
            page = PageProcess(
                config.page_host, config.page, config.page_names, config.log_format, is_insecure=config.insecure
            )
            opened.callback(page.stop)
        is_open = bool(keys or config.insecure or sys.platform != "linux")
        sockets = Sockets(
            config.bind,
            config.worker_bind or _private_address(label),
            most_connections=most_connections(_FILES_A_WORKER * config.workers_in_all),
            keys=keys,
            local_bind=_private_address(label),
            admits=None if is_open else OwnUser(_OWN_USER_RULE, log.say).admits,
        )
        opened.callback(sockets.close)
        catalogue = load_catalogue(config)
        table = SequenceTable(catalogue.videos, catalogue.rows, config.spec)
        summary = corpus_summary(catalogue, config.spec, table, list_refused=config.list_refused)
        for line in (*notes_of(catalogue), *summary):
            log.say(line)
        config.spec.recipe.warn(log.say)
        catalogue.fail_fast()
        if not table.count:
            raise CorpusError(f"--videos {config.videos}: no video gives a sequence under the recipe, see above")
        quarantine_file = quarantine_path(catalogue.source.name, config.cache_dir or None)
        quarantine = read_quarantine(quarantine_file)
        for entry in quarantine.entries(quarantine.latest):
            log.say(f"in quarantine: {entry}")
        broker = Broker(
            catalogue.facts,
            config.spec,
            quarantine=quarantine,
            wall_clock=utc_now,
            lease_deadline_seconds=config.lease_deadline_seconds,
            max_credit_bytes=config.max_credit_bytes,
            expected_workers=config.workers_in_all,
            share_bytes=int(config.share_gib * GIB),
        )
        # Workers of this host use an address that requires no key.
        worker_flags = [*(["--keys", ""] if config.engine == "local" else []), "--log-format", config.log_format]
        if config.cache:
            worker_flags += ["--cache", str(Path(config.cache).absolute()), "--cache-gib", str(config.cache_gib)]
        worker_flags += ["--debug"] * debug + ["--insecure"] * config.insecure
        if copies := catalogue.source.copies:
            worker_flags += ["--copies", str(copies.folder), "--copies-gib", str(copies.most_bytes / GIB)]
        stop = threading.Event()
        sockets.has_session = broker.has_session
        signals = opened.enter_context(stop_on_signals(stop))
        pool = make_pool(config, catalogue.source, label, worker_flags, keys, standbys)
        opened.callback(catalogue.close)
        server = Server(config, catalogue, Dispatcher(broker), sockets, pool, quarantine_file, page=page, log=log)
        opened.callback(server.close)
        if pool.is_local and (question := question_workers(config.most_workers, usable_cores())):
            log.say(question, "warning")
        pool.start(sockets.local_address if pool.is_local else sockets.worker_address)
        pool.scale(config.least_workers)
        check_in_background(catalogue, config.spec, stop, log.say)
        if page is not None:
            page.start(sockets.local_address)
            log.say(f"page: {page.url}")
        while not stop.is_set() and config.parent_pid in (0, os.getppid()):
            server.turn(_TURN_SECONDS)
    return signals[0] if signals else 0


class Server:
    """The loop: pass messages to the dispatcher, and carry out its actions.

    Args:
        dispatcher: decides what to do.
        sockets: of consumers and workers.
        pool: runs the workers' processes.
        quarantine_file: file that new entries are written to.
        clock: returns the time, seconds; None: a :class:`v2v_server.serve.Clock`.
        page: the status page; None: no page.
        log: where other threads write lines too; None: a new one.
    """

    def __init__(
        self,
        config: ServeConfig,
        catalogue: Catalogue,
        dispatcher: Dispatcher,
        sockets: Sockets,
        pool: Pool,
        quarantine_file: Path,
        clock: Callable[[], float] | None = None,
        page: PageProcess | None = None,
        log: Log | None = None,
    ) -> None:
        self._page = page
        self._log = log or Log(is_json=config.log_format == "json")
        self._config = config
        self._catalogue = catalogue
        self._dispatcher = dispatcher
        self._broker = dispatcher.broker
        self._sockets = sockets
        self._pool = pool
        self._clock = clock or Clock()
        self._quarantine_file = quarantine_file
        self._unreadable_said = -math.inf
        self._unrecorded: list[tuple[AddToQuarantine, float]] = []  # until when each is tried
        self._next_tick = self._clock()
        is_fixed = config.least_workers == config.most_workers
        self._scaling = None if is_fixed else Scaling(*config.workers, config.scale_seconds)
        self._view = StatusView(self._log, sys.stderr)
        self._publisher = StatusPublisher(config, catalogue, self._broker, pool, sockets, self._clock(), utc_now)
        self._announced = False
        self._port_file: Path | None = None
        self._blocked_due: float | None = None
        self._give_back_at = math.inf

    def turn(self, longest_wait_seconds: float) -> None:
        """Handle the available messages, waiting for one if there are none, and do what is due.

        Raises:
            WorkerCrashLoop: the workers die without finishing anything.
            UsageError: the port file cannot be written.
        """
        arrivals = self._sockets.receive(longest_wait_seconds)
        now = self._clock()
        for arrival in arrivals:
            match arrival:
                case FromWorker(identity, frames, user):
                    self._carry_out(self._dispatcher.from_worker(identity, frames, now, user))
                case FromConsumer(identity, frames, user):
                    self._carry_out(self._dispatcher.from_consumer(identity, frames, now, user))
                case InFlight(identity, nbytes):
                    self._carry_out(self._dispatcher.in_flight(identity, nbytes, now))
                case ConsumerGone(identity):
                    self._dispatcher.consumer_gone(identity, now)
                    self._give_back_at = min(self._give_back_at, now + _GIVE_BACK_SECONDS)
        if now >= self._next_tick:
            self._next_tick = now + _TURN_SECONDS
            for name, stalled in self._pool.stalled(now).items():
                self._dispatcher.worker_stalled(self._route(name), stalled)
            self._carry_out(self._retry())
            self._carry_out(self._dispatcher.tick(now))
            for death in self._pool.watch(now, self._broker.counters.samples):
                self._say(
                    f"worker {death.identity.decode()} {death.loss.text}; its leases go to other workers", "warning"
                )
                self._carry_out(self._dispatcher.worker_lost(self._route(death.identity), death.loss, now))
            if now >= self._give_back_at:
                self._give_back_at = math.inf
                give_back_freed_memory()
            for line in [*self._pool.news(), *(self._page.watch(now) if self._page is not None else [])]:
                self._say(line)
            self._warn_if_blocked(now)
            self._scale(now)
            self._carry_out([*self._publisher.tick(now)])
            self._show(now)

    def close(self) -> None:
        """Stop and end the workers, and close all connections."""
        self._view.close()
        if self._announced:
            status = self._publisher.status(self._clock())
            for line in format_shutdown_summary(status):
                self._log.say(line)
            if self._log.is_json:
                self._log.say("the end", totals=status["totals"], uptime_seconds=status["uptime_seconds"])
        for stop in self._dispatcher.stop_workers():
            self._sockets.send(stop.identity, stop.frames, to_worker=True)
        self._pool.stop()
        self._sockets.close()
        if self._port_file is not None:
            with contextlib.suppress(OSError):  # for instance, its folder is gone; the server cannot repair that
                self._port_file.unlink(missing_ok=True)

    def _carry_out(self, actions: list[Action]) -> None:
        """Carry out the dispatcher's actions in order, and report the results to it."""
        dispatcher, now = self._dispatcher, self._clock
        todo = deque(actions)
        while todo:
            match todo.popleft():
                case ToConsumer(identity, frames):
                    if not self._sockets.send(identity, frames):
                        dispatcher.consumer_lost(identity)
                case ToWorker(identity, frames, arena):
                    if arena:
                        self._pool.lend(self._name(identity), arena)
                    is_sent = self._sockets.send(identity, frames, to_worker=True)
                    if not is_sent and not self._pool.watches(self._name(identity)):
                        todo.extend(dispatcher.worker_gone(identity, now()))
                case Grant() as grant:
                    try:
                        todo.extend(grant.messages(complete_lease(grant.leases[0], self._catalogue, grant.spec)))
                    except IndexUnreadable as error:  # none of the others can be completed either
                        grants = [grant, *(each for each in todo if isinstance(each, Grant))]
                        todo = deque(each for each in todo if not isinstance(each, Grant))
                        todo.extend(dispatcher.not_granted(grants, error, now()))
                    except V2VError as error:
                        todo.extend(dispatcher.not_granted([grant], error, now()))
                case Disconnect(identity):
                    self._sockets.cut(identity)
                case GiveUp() as hopeless:
                    todo.extend(dispatcher.worker_lost(hopeless.identity, self._give_up(hopeless), now()))
                case AddToQuarantine() as record:
                    # Before anything that follows is sent.
                    todo.extendleft(reversed(self._record(record)))
                case CheckVideo() as missing:
                    # The loop reads no sidecar: one that a worker of this host cannot read is unreadable on this host.
                    is_here = bool(missing.sidecar) and self._catalogue.source.is_local and self._pool.is_local
                    is_here = is_here and self._pool.watches(self._name(missing.identity))
                    found = not is_here and self._check_video(missing)
                    todo.extend(dispatcher.video_checked(missing, found, now()))
                case ReportRefusal(refusal, request):
                    self._say(f"passed over {refusal}", "warning", request, video=refusal.video)
                case SendStatus() as request:
                    self._publisher.ask(request)

    def _record(self, record: AddToQuarantine, until: float | None = None) -> list[Action]:
        """Write a quarantine entry. If that fails, the server continues and logs the consequence.

        Args:
            record: the entry.
            until: time until which :meth:`_retry` repeats it while another process writes; None: for a short time.

        Returns:
            what the dispatcher does about it; nothing while it is retried.
        """
        entry, now = record.entry, self._clock()
        until = now + _RECORD_SECONDS if until is None else until
        latest = self._broker.quarantine.latest
        if self._broker.quarantine.refusal(latest, entry.path, entry.fingerprint, entry.frame, entry.spec) is not None:
            # Another worker ended over it while the file was locked. A second entry would refuse the whole video.
            return self._dispatcher.quarantine_recorded(record, [], now)
        written: list[QuarantineEntry] = []
        try:
            written = write_entry(self._quarantine_file, entry, self._broker.quarantine, wait_seconds=0.0)
        except (OSError, CorpusError) as error:
            if isinstance(error, BlockingIOError) and now < until:
                self._unrecorded.append((record, until))
                return []
            self._say(
                f"{entry.path} from frame {entry.frame}: {entry.reason}; the sequence is skipped once and will "
                f"be tried again, because the quarantine cannot be written: {error}",
                "error",
                record.request,
                video=entry.path,
            )
        for line in written:
            self._say(f"quarantine: {line}", "warning", record.request, video=line.path)
        return self._dispatcher.quarantine_recorded(record, written, now)

    def _retry(self) -> list[Action]:
        """Repeat the writing of entries that another process delayed. Call a few times a second."""
        unrecorded, self._unrecorded = self._unrecorded, []
        return [action for record, until in unrecorded for action in self._record(record, until)]

    def _check_video(self, missing: CheckVideo) -> bool:
        """Check the file against the catalogue. If it matches, warn (rate-limited, since all workers of a host fail
        alike) that the worker's host does not have it.
        """
        try:
            self._catalogue.check(missing.video, missing.fingerprint, missing.sidecar)
            if missing.reason.startswith(CHANGED) and not missing.sidecar:  # a worker has read it
                self._catalogue.check_state(missing.video)
        except (VideoChanged, VideoGone):
            if not missing.sidecar:
                self._catalogue.mark_stale(missing.video)
            return False
        except (VideoError, CorpusError):
            return False
        now = self._clock()
        if now >= self._unreadable_said + REST_SECONDS:
            self._unreadable_said = now
            name = clean_name(self._broker.registry.name_of(missing.identity))
            is_local = self._catalogue.source.is_local
            file = f"the sidecar {missing.sidecar} of {missing.video}" if missing.sidecar else missing.video
            self._say(
                f"worker {name} failed on {file}, which "
                f"{'is on this host as catalogued' if is_local else 'is not known to be gone or changed'}: "
                f"{missing.reason}; other workers make the sample, and this one gets no work for {REST_SECONDS:g} s. "
                "Check --videos on its host",
                "warning",
                missing.request,
                video=missing.video,
            )
        return True

    def _give_up(self, hopeless: GiveUp) -> Loss:
        """End the process of a hung worker, if it is one of ours."""
        name = self._name(hopeless.identity)
        loss = self._pool.give_up(name, hopeless.reason) or Loss(Cause.UNEXPLAINED, hopeless.reason, for_all=False)
        happened = ": ".join(dict.fromkeys((hopeless.reason, loss.text)))
        self._say(f"worker {clean_name(name.decode())} {happened}; its leases go to other workers", "warning")
        return loss

    def _name(self, identity: bytes) -> bytes:
        """Return the name by which the pool knows a worker; empty if it has not said hello."""
        return self._broker.registry.name_of(identity).encode()

    def _route(self, name: bytes) -> bytes:
        """Return the routing id of a worker of the pool; empty if it has not said hello."""
        return self._broker.registry.named(name.decode()) or b""

    def _warn_if_blocked(self, now: float) -> None:
        """Warn once if leases stay blocked. Another server that writes blocks the index only briefly."""
        if not self._broker.blocked_reason:
            self._blocked_due = None
        elif self._blocked_due is None:
            self._blocked_due = now + _SOON_SECONDS
        elif now >= self._blocked_due:
            self._blocked_due = math.inf
            self._say(f"no samples are started: {self._broker.blocked_reason}", "warning")

    def _scale(self, now: float) -> None:
        """Change the number of workers if it is not fixed and the load requires it."""
        if self._scaling is None:
            return
        seen = self._broker
        decision = self._scaling.decide(now, seen.waiting_share, seen.idle_share, seen.workers)
        if decision is not None:
            self._pool.scale(decision.workers)
            self._say(f"workers: {decision.workers} from now on, because {decision.reason}")

    def _show(self, now: float) -> None:
        """Announce once that the server is ready; then update the status."""
        if not self._announced and (self._broker.workers or not self._config.least_workers):
            self._announced = True
            address, worker_address = self._sockets.address, self._sockets.worker_address
            # Workers on other hosts cannot use a private address.
            workers = "" if worker_address.startswith("ipc:") else f", workers to {worker_address}"
            self._say(f"ready: consumers connect to {address}{workers}", address=address)
            if self._config.port_file:
                write_file(Path(self._config.port_file), address + "\n", "--port-file")
                self._port_file = Path(self._config.port_file)
            self._publisher.is_ready = True
        if self._announced and self._view.is_due(now):
            self._view.show(now, self._publisher.status(now))

    def _say(self, text: str, level: Level = "info", sample: Request | None = None, **about: Any) -> None:
        """Write a log line.

        Args:
            text, level: the line.
            sample: the request that the line is about.
            about: additional fields for programs.
        """
        identity = None if sample is None or not self._log.is_json else self._broker.identity_of(sample)
        if identity is not None:
            about["sample"] = asdict(identity)
        self._log.say(text, level, **about)


def _private_address(label: str) -> str:
    """Return an address for local workers: a socket without a file, so that nothing is left even after a kill -9."""
    return f"ipc://@v2v-{label}-{secrets.token_hex(8)}" if sys.platform.startswith("linux") else "tcp://127.0.0.1:*"


class Clock:
    """Seconds during which this process was running.

    A stopped process (in a terminal, by a batch system, with its whole machine) receives no answers, and its peers may
    be stopped as well. So a deadline that expires meanwhile does not count.
    """

    def __init__(self) -> None:
        self._seen = time.monotonic()
        self._away = 0.0

    def __call__(self) -> float:
        seen, self._seen = self._seen, time.monotonic()
        self._away += max(0.0, self._seen - seen - _LONGEST_TURN_SECONDS)
        return self._seen - self._away


@contextlib.contextmanager
def stop_on_signals(stop: threading.Event) -> Iterator[list[int]]:
    """Set ``stop`` at the first SIGINT or SIGTERM, and yield a list that then holds its number; a second signal ends
    the process at once.
    """
    signals: list[int] = []
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def on_signal(number: int, frame: object) -> None:
        for each in before:
            signal.signal(each, signal.SIG_DFL)
        signals.append(number)
        stop.set()

    for number in before:
        signal.signal(number, on_signal)
    try:
        yield signals
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def utc_now() -> str:
    """Return the time of day, ISO 8601, UTC, in whole seconds."""
    return datetime.now(UTC).isoformat(timespec="seconds")
