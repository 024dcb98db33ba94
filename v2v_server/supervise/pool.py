"""Keep a number of workers running: start, watch, restart with backoff, stop; and choose that number.

    slot   empty --start--> started --exit--> empty (started again after a delay)
                               |
                               `--too many--> leaving --exit--> gone

A worker that dies is started again after a delay that doubles with every death in a row. If the workers die repeatedly
and not one sample is finished, something is wrong that restarting does not repair, and the pool says so.

The pool decides when a worker starts, leaves or is given up. A :class:`Host` knows how: as processes of this host
(:mod:`v2v_server.supervise.local_host`) or on a Ray cluster (:mod:`v2v_server.supervise.ray_host`). No method waits for
a worker, except ``wait``, ``release`` and ``close``.
"""

from __future__ import annotations

import math
import signal
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any, Protocol, TypeVar

import psutil

from v2v_protocol.errors import UsageError, WorkerCrashLoop
from v2v_protocol.programs import name_extra
from v2v_server.broker.leases import Cause, Loss, Stall
from v2v_server.config import ENGINES, ServeConfig
from v2v_server.corpus.sources.source import VideoSource
from v2v_server.keys import KeyFolder

_FIRST_BACKOFF_SECONDS = 0.2
_LONGEST_BACKOFF_SECONDS = 10.0
_STALL_SECONDS = 1.0
"""Time from one check for stalled workers to the next."""
_STALE_SECONDS = 15.0
"""Age at which an observation says nothing about a process any more."""
_WAITING = 0.5
_BUSY = 0.1
_IDLE = 0.35
_LEFT_BUSY = 0.8
_GROWTH = 1.5
_PARTS = 6
_MANY_WORKERS_A_CORE = 4
_STOPPED = (psutil.STATUS_STOPPED, psutil.STATUS_TRACING_STOP)


@dataclass(frozen=True, slots=True)
class ProcessStatus:
    """A worker's process, as its host sees it.

    Attributes:
        status: of the process, in psutil's words.
        queued_seconds: time that it has waited for a core since it started.
        lease: the lease in work by its logbook, 0 for no lease; None if it never wrote one.
        decodes: whether it decodes a video, by its logbook.
        seen_at: monotonic time of the observation, seconds.
    """

    status: str = ""
    queued_seconds: float = 0.0
    lease: int | None = None
    decodes: bool = False
    seen_at: float = 0.0


@dataclass(frozen=True, slots=True)
class Exit:
    """End of a worker's process, or a start that failed.

    Attributes:
        loss: what it says about the sample in work.
        returncode: exit status of the process; None if it is not known.
        retry_seconds: time until the next start; None: the usual delay, which grows with every loss in a row.
        is_loss: whether a worker was lost; False if it had not started.
    """

    loss: Loss
    returncode: int | None = None
    retry_seconds: float | None = None
    is_loss: bool = True


class WorkerPlace(Protocol):
    """Where the worker of one slot runs."""

    @property
    def is_running(self) -> bool:
        """Return whether its process runs, as far as is known."""

    def start(self, name: str, address: str) -> None:
        """Start a worker that connects to ``address``. A failure is reported by :meth:`take_exit`."""

    def take_exit(self) -> Exit | None:
        """Return once how the worker ended; None while it has not ended."""

    def status(self, now: float) -> ProcessStatus | None:
        """Return the latest observation of the worker's process; None without one."""

    def lend(self, arena: str) -> None:
        """Pass the worker the arena of its next lease, if it is a process of this host."""

    def leave(self) -> bool:
        """Tell the worker to finish its sample and exit; return False if there is none to tell."""

    def signal(self, number: int) -> None:
        """Send the worker's process a signal, if it runs."""

    def release(self) -> None:
        """End the worker's process, if it runs, and give the place up."""


AnyPlace = TypeVar("AnyPlace", bound=WorkerPlace)


class Host(Protocol[AnyPlace]):
    """Runs workers' processes.

    Attributes:
        is_local: whether all workers run on this host.
        status_seconds: time from one observation of a process to the next.
    """

    is_local: bool
    status_seconds: float

    def place(self, number: int) -> AnyPlace:
        """Return a place for the worker of a slot."""

    def request(self, workers: int) -> None:
        """Note how many workers there should be."""

    def refresh(self, now: float) -> None:
        """Read what has happened since the last call. Called a few times a second."""

    def wait(self, places: Sequence[AnyPlace], seconds: float) -> list[AnyPlace]:
        """Wait until the workers have ended; return the places of those that have not."""

    def news(self) -> list[str]:
        """Return lines for the operator since the last call."""

    def close(self) -> None:
        """Release what the host holds, after its places."""


def crash_budget(workers: int) -> int:
    """Return how many deaths in a row, without any finished sample between them, this number of workers may have."""
    return 3 * workers + 4


class Restarts:
    """Count deaths in a row."""

    def __init__(self) -> None:
        self._deaths_in_a_row = 0
        self._samples_seen = 0

    def progress(self, samples: int) -> None:
        """Update the number of samples finished so far; any increase resets the count of deaths."""
        if samples > self._samples_seen:
            self._samples_seen = samples
            self._deaths_in_a_row = 0

    def delay(self, workers: int, loss: Loss) -> float:
        """Count a death.

        Args:
            workers: number of workers that there should be.
            loss: what happened to the worker.

        Returns:
            seconds until its successor may be started.

        Raises:
            WorkerCrashLoop: the crash budget is used up.
        """
        self._deaths_in_a_row += 1
        if self._deaths_in_a_row > crash_budget(workers):
            raise WorkerCrashLoop(
                f"{self._deaths_in_a_row} server workers died in a row without finishing a sample (limit "
                f"{crash_budget(workers)}); the last one {loss.text}. What they printed is above; "
                f"`v2v-simulate` on one of the videos shows the same in one process"
            )
        # Bounded before the power: a large pool may have hundreds of deaths in a row, which would overflow a float.
        doublings = min(self._deaths_in_a_row - 1, 16)
        return float(min(_FIRST_BACKOFF_SECONDS * 2**doublings, _LONGEST_BACKOFF_SECONDS))


@dataclass(frozen=True, slots=True)
class Death:
    """A worker that ended without being told to, or that could not be started.

    Attributes:
        identity: the worker's name, as in its hello.
        loss: what its end says about the sample in work.
    """

    identity: bytes
    loss: Loss


@dataclass(slots=True, eq=False)
class WorkerSlot:
    """A place for one worker at a time.

    Attributes:
        number: of the slot; part of its workers' names.
        place: where its worker runs.
        generation: number of workers started so far.
        name: name of the latest worker.
        is_started: whether that worker has not ended, as far as is known.
        is_given_up: whether it hung; its end is not reported again.
        is_leaving: whether the slot ends with its worker.
        start_at: time of the next start.
        seen: observation at the last check for stalled workers.
    """

    number: int
    place: WorkerPlace
    generation: int = 0
    name: str = ""
    is_started: bool = False
    is_given_up: bool = False
    is_leaving: bool = False
    start_at: float = 0.0
    seen: ProcessStatus = field(default_factory=ProcessStatus)


class Pool:
    """The workers of one server.

    Args:
        host: runs the processes.
        label: prefix of the workers' names, unique to this server.
    """

    def __init__(self, host: Host[Any], label: str) -> None:
        self._host = host
        self._label = label
        self._slots: list[WorkerSlot] = []
        self._workers = 0
        self._numbered = 0
        self._address = ""
        self._restarts = Restarts()
        self._now = 0.0
        self._checked_at = -math.inf

    @property
    def is_local(self) -> bool:
        """Return whether all workers run on this host."""
        return self._host.is_local

    @property
    def running(self) -> int:
        """Return the number of workers whose process runs."""
        return sum(slot.place.is_running for slot in self._slots)

    @property
    def restarts(self) -> dict[bytes, int]:
        """Return the number of earlier workers in the slot of each worker."""
        return {slot.name.encode(): slot.generation - 1 for slot in self._slots if slot.is_started}

    def start(self, address: str) -> None:
        """Set the address that workers connect to; :meth:`watch` starts them."""
        self._address = address

    def scale(self, workers: int) -> None:
        """Set the number of workers. Surplus workers finish their current sample and exit."""
        self._workers = workers
        staying = [slot for slot in self._slots if not slot.is_leaving]
        for _ in range(workers - len(staying)):
            self._slots.append(WorkerSlot(self._numbered, self._host.place(self._numbered)))
            self._numbered += 1
        for slot in staying[workers:]:
            slot.is_leaving = slot.place.leave()
            if not slot.is_leaving:
                self._release(slot)
        self._host.request(workers)

    def watches(self, identity: bytes) -> bool:
        """Return whether :meth:`watch` will report how a worker ends."""
        slot = self._slot_of(identity)
        return slot is not None and not slot.is_given_up

    def watch(self, now: float, samples: int) -> list[Death]:
        """Return the workers that have died, and start those that are due. Call it a few times a second.

        Args:
            now: monotonic time, seconds.
            samples: samples finished so far by all workers; any progress resets the count of deaths in a row.

        Raises:
            WorkerCrashLoop: the crash budget is used up.
        """
        self._now = now
        self._restarts.progress(samples)
        self._host.refresh(now)
        deaths = [death for slot in list(self._slots) for death in self._ended(slot)]
        for slot in self._slots:
            if not slot.is_started and now >= slot.start_at:
                self._start(slot)
                deaths += self._ended(slot)
        return deaths

    def stalled(self, now: float) -> dict[bytes, Stall]:
        """Return the workers that could not run since the last call, and for how long. No deadline counts that time."""
        if now - self._checked_at < _STALL_SECONDS:
            return {}
        self._checked_at = now
        found = {}
        for slot in self._slots:
            seen = slot.place.status(now) if slot.is_started else None
            if seen is None:
                continue
            before, slot.seen = slot.seen, seen
            since = seen.seen_at - before.seen_at
            stopped = min(since, 2 * self._host.status_seconds) if seen.status in _STOPPED else 0.0
            queued = max(0.0, min(since - stopped, seen.queued_seconds - before.queued_seconds))
            if stopped or queued:
                found[slot.name.encode()] = Stall(stopped, queued)
        return found

    def lend(self, identity: bytes, arena: str) -> None:
        """Pass a worker the arena of its next lease. Call it before the lease is sent."""
        slot = self._slot_of(identity)
        if slot is not None:
            slot.place.lend(arena)

    def give_up(self, identity: bytes, reason: str) -> Loss | None:
        """Kill a worker that hangs.

        Returns:
            what its loss means, which :meth:`watch` does not report again; None if it is not a worker of this pool.
        """
        slot = self._slot_of(identity)
        if slot is None:
            return None
        slot.is_given_up = True
        seen = slot.place.status(self._now)
        slot.place.signal(signal.SIGKILL)
        if seen is None or self._now - seen.seen_at > _STALE_SECONDS:
            return Loss(Cause.UNEXPLAINED, f"{reason}, nor does its node answer", for_all=False)
        if seen.status in _STOPPED:
            return Loss(Cause.KILLED, "was stopped from outside and killed")
        if seen.status == psutil.STATUS_DISK_SLEEP:
            # If the server of a network file system is away, every worker waits, each at a sound clip.
            return Loss(Cause.UNEXPLAINED, f"waited for its storage and {reason}", seen.lease, seen.decodes)
        return Loss(Cause.HUNG, reason, seen.lease, seen.decodes)

    def news(self) -> list[str]:
        """Return lines for the operator since the last call, such as where workers are placed."""
        return self._host.news()

    def stop(self, join_seconds: float = 5.0, terminate_seconds: float = 2.0) -> None:
        """End every worker: wait for those that were told to stop, then terminate, then kill."""
        left = self._host.wait([slot.place for slot in self._slots if slot.place.is_running], join_seconds)
        for place in left:
            place.signal(signal.SIGTERM)
        self._host.wait(left, terminate_seconds)
        for slot in list(self._slots):
            self._release(slot)
        self._host.close()

    def _slot_of(self, identity: bytes) -> WorkerSlot | None:
        return next((slot for slot in self._slots if slot.is_started and slot.name.encode() == identity), None)

    def _start(self, slot: WorkerSlot) -> None:
        slot.generation += 1
        slot.name = f"{self._label}-{slot.number}.{slot.generation}"
        slot.is_started, slot.is_given_up, slot.seen = True, False, ProcessStatus(seen_at=self._now)
        slot.place.start(slot.name, self._address)

    def _ended(self, slot: WorkerSlot) -> list[Death]:
        """Handle the end of a slot's worker, if it has ended, and return the death to report.

        Raises:
            WorkerCrashLoop: the crash budget is used up.
        """
        end = slot.place.take_exit() if slot.is_started else None
        if end is None:
            return []
        slot.is_started = False
        if slot.is_leaving:
            self._release(slot)
        else:
            delay = self._restarts.delay(self._workers, end.loss) if end.retry_seconds is None else end.retry_seconds
            slot.start_at = self._now + delay
        is_expected = slot.is_given_up or (slot.is_leaving and end.returncode in (0, -signal.SIGTERM))
        return [Death(slot.name.encode(), end.loss)] if end.is_loss and not is_expected else []

    def _release(self, slot: WorkerSlot) -> None:
        self._slots.remove(slot)
        slot.place.release()


def make_pool(
    config: ServeConfig,
    source: VideoSource,
    label: str,
    flags: list[str],
    keys: KeyFolder | None = None,
    standbys: list[Any] | None = None,
) -> Pool:
    """Return the pool that the configuration asks for.

    Args:
        config: of the server.
        source: where the videos come from; workers open it by its name.
        label: prefix of the workers' names, unique to this server.
        flags: further flags of each worker.
        keys: keys of the server, which lends one to workers on other hosts.
        standbys: workers of this host that are started already; the pool takes them from the list.

    Raises:
        UsageError: the engine is not installed, or there is no cluster.
    """
    name = config.engine
    try:
        engine = import_module(ENGINES[name])
    except ModuleNotFoundError as error:
        if error.name != name:
            raise
        raise UsageError(
            f"{name_extra(f'--engine {name}', name, name)}, here and on every node of the cluster"
        ) from error
    key = None if keys is None or name == "local" else keys.lend(f"{name}-{label}", "worker")
    return Pool(engine.make_host(config, source.name, label, flags, key, standbys), label)


@dataclass(frozen=True, slots=True)
class Decision:
    """A change.

    Attributes:
        workers: the new number.
        reason: why, in words.
    """

    workers: int
    reason: str


class Scaling:
    """Choose the number of workers within bounds, from waiting consumers and idle workers. Pure.

        waiting share   consumers that have requests without a worker, of all consumers
        idle share      workers without any lease, of all workers

    The load of the processors says nothing: a decoder keeps its core busy whether a consumer waits or not.

        more     at least half of the consumers wait, and at most a tenth of the workers are idle: half as many again
        fewer    more than a third of the workers are idle: as many as would be busy four fifths of the time, but at
                 least half of the present number

    Between the two the number stays, so it does not oscillate: after a reduction a fifth of the workers are idle, well
    above the tenth that allows an increase. Each change restarts the measurement, and more workers are requested only
    once those requested before are present.

    Args:
        least, most: bounds of the number of workers.
        seconds: time that workers must have been idle before some leave; a sixth of it is enough for an increase.
    """

    def __init__(self, least: int, most: int, seconds: float) -> None:
        self._least, self._most = least, most
        self._part_seconds = seconds / _PARTS
        self._target = least
        self._parts: deque[tuple[float, float]] = deque(maxlen=_PARTS)  # shares in each sixth of the time
        self._since, self._lacking = math.nan, False

    def decide(self, now: float, waiting: float, idle: float, present: int) -> Decision | None:
        """Return the change to make, if there is one. Call it a few times a second.

        Args:
            now: monotonic time, seconds.
            waiting, idle: the shares, 0 to 1.
            present: number of workers that are connected.
        """
        if math.isnan(self._since):
            self._begin(now)
        self._calls += 1
        self._waiting += waiting
        self._idle += idle if present else 0.0
        self._lacking = self._lacking or present < self._target
        if now - self._since < self._part_seconds:
            return None
        shares, lacking = (self._waiting / self._calls, self._idle / self._calls), self._lacking
        self._parts.append(shares)
        self._begin(now)
        decision = (None if lacking else self._more(*shares)) or self._fewer()
        if decision is not None:
            self._target = decision.workers
            self._parts.clear()
        return decision

    def _begin(self, now: float) -> None:
        """Begin the next sixth of the time."""
        self._since = now
        self._calls = 0
        self._waiting = self._idle = 0.0
        self._lacking = False

    def _more(self, waiting: float, idle: float) -> Decision | None:
        if self._target >= self._most or waiting < _WAITING or idle > _BUSY:
            return None
        target = min(self._most, max(self._target + 1, math.ceil(self._target * _GROWTH)))
        return Decision(target, _reason(waiting, idle, self._part_seconds))

    def _fewer(self) -> Decision | None:
        # The busiest part counts: a pause, or its end, must not stop workers that are needed.
        waiting, idle = max(share for share, _ in self._parts), min(share for _, share in self._parts)
        if len(self._parts) < _PARTS or idle <= _IDLE:
            return None
        # Slightly less: a rounding error in the sum of shares must not keep one worker more.
        needed = math.ceil(self._target * (1.0 - idle) / _LEFT_BUSY - 1e-9)
        needed = max(needed, 1) if idle < 1.0 else 0  # the last one stays while there are requests
        target = max(self._least, self._target // 2, needed)
        if target >= self._target:
            return None
        return Decision(target, "at the busiest " + _reason(waiting, idle, self._part_seconds))


def _reason(waiting: float, idle: float, seconds: float) -> str:
    return f"{waiting:.0%} of consumers waited and {idle:.0%} of workers were idle in {seconds:.3g} s"


def question_workers(workers: int, cores: int) -> str:
    """Return a warning if there are more workers than cores; empty otherwise."""
    if workers <= _MANY_WORKERS_A_CORE * cores:
        return ""
    return (
        f"warning: --workers {workers} on {cores} cores: each uses one core, and more than {cores} only "
        f"cost memory; --workers {cores} makes as many samples"
    )
