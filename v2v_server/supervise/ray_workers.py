"""Workers on a Ray cluster: Ray places an actor for each of them, and starts it again elsewhere when its node dies.

    RayWorkers (in the server) ──Ray──► RayWorker (an actor, one for each worker) ──► v2v-worker, unchanged
                  ▲                                                                      │
                  └───────────────────── ZeroMQ: leases and samples ─────────────────────┘

Ray carries no sample. The actor is :mod:`v2v_server.supervise.ray_actor`; it and this module are the only ones that
import Ray (the extra ``ray``).
"""

from __future__ import annotations

import contextlib
import math
import signal
import socket
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import ray
from ray.autoscaler.sdk import request_resources
from ray.exceptions import ActorDiedError, ActorUnavailableError, RayError

from v2v_protocol.errors import UsageError
from v2v_protocol.keys import PeerKey
from v2v_server.broker.blame import Cause, Loss
from v2v_server.broker.leases import Stall
from v2v_server.supervise.child import STOPPED, hung
from v2v_server.supervise.protocol import Death
from v2v_server.supervise.ray_actor import RayWorker, Sight
from v2v_server.supervise.restarts import Restarts

WORKER_BYTES = 1 << 30
"""Memory that Ray sets aside for a worker, besides one CPU."""
_FIRST_LOOK_SECONDS = 1.0
_LOOK_SECONDS = 5.0
"""From one look at a worker's process to the next; what is known of it is that old at most."""
_STALE_SECONDS = 3 * _LOOK_SECONDS
_AGAIN_SECONDS = 1.0
_NEWS_SECONDS = 10.0
_CONNECT_SECONDS = 10.0
_CALLS_AT_ONCE = 4
"""In an actor: to run the process, to look at it, and to signal it."""


@dataclass(slots=True, eq=False)
class _Berth:
    """The place of one worker, be it now here and now there."""

    number: int
    actor: Any
    generation: int = 0
    name: str = ""
    run: Any = None
    looking: Any = None
    seen: Sight | None = None
    seen_at: float = 0.0
    look_at: float = 0.0
    start_at: float = 0.0
    given_up: bool = False
    leaving: bool = False


class RayWorkers:
    """Keeps a number of workers running on a cluster: a :class:`v2v_server.supervise.protocol.Supervisor`.

    Args:
        root: the corpus, a folder that every node has under this path, or an address.
        label: prefix of the workers' names, unique to this server.
        flags: more of them for each worker.
        address: of the cluster, HOST:PORT; "auto" is the one that this host is a node of.
        selector: labels of the nodes that may have workers.
        key: of the workers; None: what ``V2V_KEYS`` names on each node.

    Raises:
        UsageError: there is no cluster.
    """

    def __init__(
        self,
        root: str,
        label: str,
        flags: Sequence[str] = (),
        address: str = "auto",
        selector: dict[str, str] | None = None,
        key: PeerKey | None = None,
    ) -> None:
        self._arguments = root, list(flags), key
        self._label = label
        self._selector = selector or {}
        self._address = ""
        self._berths: list[_Berth] = []
        self._numbered = 0
        self._restarts = Restarts()
        self._stalled: dict[bytes, Stall] = {}
        self._news: list[str] = []
        self._told = ""
        self._tell_at = -math.inf
        self._complete_at = math.inf  # when all had a place, last; at first from the first look on
        self._now = 0.0
        self._is_ours = not ray.is_initialized()
        if self._is_ours:
            _connect(address)

    @property
    def running(self) -> int:
        """Workers whose process was seen and has not ended."""
        return sum(_is_up(berth) for berth in self._berths)

    @property
    def restarts(self) -> dict[bytes, int]:
        """How often the place of each worker was filled before."""
        return {berth.name.encode(): berth.generation - 1 for berth in self._berths if berth.run is not None}

    def start(self, address: str) -> None:
        """Workers that :meth:`watch` starts connect to ``address``; for one of all interfaces, to this node's own."""
        for everywhere in ("//0.0.0.0:", "//[::]:"):
            address = address.replace(everywhere, f"//{ray.util.get_node_ip_address()}:")
        self._address = address

    def scale(self, workers: int) -> None:
        """There shall be so many; the cluster is asked for room, and its autoscaler too where it has one."""
        staying = [berth for berth in self._berths if not berth.leaving]
        for _ in range(workers - len(staying)):
            self._berths.append(_Berth(self._numbered, self._actor(self._numbered)))
            self._numbered += 1
        for berth in staying[workers:]:
            berth.leaving = True
            if _is_up(berth):
                # It finishes its sample and gives back the others.
                berth.actor.signal.remote(berth.name, signal.SIGTERM)
            else:
                self._end(berth)
        with contextlib.suppress(RayError, OSError):
            request_resources(bundles=[_needs() for _ in range(workers)])

    def watches(self, identity: bytes) -> bool:
        """Whether :meth:`watch` will report how that worker ends."""
        return any(berth.name.encode() == identity and berth.run and not berth.given_up for berth in self._berths)

    def watch(self, now: float, samples: int) -> list[Death]:
        """Takes in what the actors say, and starts what is due.

        Raises:
            WorkerCrashLoop: the workers die again and again without finishing anything.
        """
        self._now = now
        self._restarts.progress(samples)
        calls = [call for berth in self._berths for call in (berth.run, berth.looking) if call is not None]
        done = set(ray.wait(calls, num_returns=len(calls), timeout=0)[0]) if calls else set()
        deaths: list[Death] = []
        for berth in list(self._berths):
            if berth.looking in done:
                self._seen(berth, now)
            if berth.run in done:
                deaths += self._ended(berth, now)
        for berth in self._berths:
            if berth.run is None and not berth.leaving and now >= berth.start_at:
                berth.generation += 1
                berth.name = f"{self._label}-{berth.number}.{berth.generation}"
                berth.given_up, berth.seen, berth.look_at = False, None, now
                berth.run = berth.actor.run.remote(berth.name, self._address)
            if berth.looking is None and now >= berth.look_at:
                berth.looking = berth.actor.look.remote()
                berth.look_at = now + (_LOOK_SECONDS if _is_up(berth) else _FIRST_LOOK_SECONDS)
        self._tell(now)
        return deaths

    def stalled(self, now: float) -> dict[bytes, Stall]:
        """Workers that were seen kept from working, and how long since they were last looked at."""
        stalled, self._stalled = self._stalled, {}
        return stalled

    def give_up(self, identity: bytes, reason: str) -> Loss | None:
        """Kills a worker that hangs. What it was at is known as of the last look; of one whose node does not answer
        either, nothing is: that is no video's doing."""
        for berth in self._berths:
            if berth.name.encode() == identity and berth.run is not None:
                berth.given_up = True
                berth.actor.signal.remote(berth.name, signal.SIGKILL)
                seen = berth.seen
                if seen is None or seen.name != berth.name or self._now - berth.seen_at > _STALE_SECONDS:
                    return Loss(Cause.UNEXPLAINED, f"{reason}, nor does its node answer", for_all=False)
                return hung(seen.status, reason, seen.lease, decodes=seen.decodes)
        return None

    def news(self) -> list[str]:
        """Lines on where the workers are, since the last call."""
        news, self._news = self._news, []
        return news

    def stop(self, join_seconds: float = 5.0, terminate_seconds: float = 2.0) -> None:
        """Ends every worker: waits for those that were told to stop, then terminates, then kills, actors and all."""
        running = [berth.run for berth in self._berths if _is_up(berth)]
        left = _wait(running, join_seconds)
        for berth in self._berths:
            if berth.run in left:
                berth.actor.signal.remote(berth.name, signal.SIGTERM)
        _wait(left, terminate_seconds)
        for berth in list(self._berths):
            self._end(berth)  # which skips all handlers of the actor; a child that is left dies with it
        with contextlib.suppress(RayError, OSError):
            request_resources(bundles=[])
        if self._is_ours:
            ray.shutdown()

    def _actor(self, number: int) -> Any:
        return (
            ray.remote(RayWorker)
            .options(
                name=f"{self._label}-{number}",  # as the dashboard shows it
                num_cpus=1,
                memory=WORKER_BYTES,
                max_restarts=-1,
                max_concurrency=_CALLS_AT_ONCE,
                scheduling_strategy="SPREAD",
                **({"label_selector": self._selector} if self._selector else {}),
            )
            .remote(*self._arguments)
        )

    def _end(self, berth: _Berth) -> None:
        self._berths.remove(berth)
        ray.kill(berth.actor, no_restart=True)

    def _seen(self, berth: _Berth, now: float) -> None:
        """An actor says what it sees; one that is away says nothing, and is asked again."""
        call, berth.looking = berth.looking, None
        try:
            seen = ray.get(call)
        except RayError:
            return
        if seen.name == berth.name:
            since = now - berth.seen_at if berth.seen is not None else _FIRST_LOOK_SECONDS
            stopped = min(since, 2 * _LOOK_SECONDS) if seen.status in STOPPED else 0.0
            queued = seen.queued_seconds - (berth.seen.queued_seconds if berth.seen is not None else 0.0)
            self._stalled[berth.name.encode()] = Stall(stopped, max(0.0, min(queued, since - stopped)))
        berth.seen, berth.seen_at = seen, now

    def _ended(self, berth: _Berth, now: float) -> Iterable[Death]:
        """A worker's process has ended, or its actor was lost along with it."""
        was_up, given_up, call = _is_up(berth), berth.given_up, berth.run
        where = berth.seen.node if berth.seen is not None else "the cluster"
        berth.run = None
        returncode: int | None = None
        try:
            returncode, loss = ray.get(call)
            delay = 0.0
        except ActorUnavailableError:
            # Ray starts the actor again, here or elsewhere.
            loss, delay = Loss(Cause.KILLED, f"was lost with its actor on {where}"), _AGAIN_SECONDS
            given_up = given_up or not was_up
        except ActorDiedError as error:
            loss = Loss(Cause.KILLED, f"has no actor any more: {_first_line(error)}")
            delay = 0.0
            if not berth.leaving:
                berth.actor = self._actor(berth.number)
        except RayError as error:
            loss, delay = Loss(Cause.KILLED, f"could not be started on {where}: {_first_line(error)}"), 0.0
        if berth.leaving:
            self._end(berth)
            as_told = returncode in (0, -signal.SIGTERM)
            return [] if as_told or given_up else [Death(berth.name.encode(), loss)]
        berth.start_at = now + (delay or self._restarts.delay(len(self._berths), loss))
        return [] if given_up else [Death(berth.name.encode(), loss)]

    def _tell(self, now: float) -> None:
        """Notes where the workers are, when that has changed, and that some have had no place for long."""
        nodes = Counter(berth.seen.node for berth in self._berths if berth.seen is not None)
        lacking = len(self._berths) - nodes.total()
        if not lacking or self._complete_at == math.inf:
            self._complete_at = now
        if now < self._tell_at or (lacking and now - self._complete_at < _NEWS_SECONDS):
            return
        places = ", ".join(f"{place} {count}" for place, count in sorted(nodes.items())) or "none"
        text = f"ray: {nodes.total()} of {len(self._berths)} workers have a place on {len(nodes)} nodes: {places}"
        if lacking:
            text += f"; the others wait, each for 1 CPU and {WORKER_BYTES >> 30} GiB"
        if text != self._told:
            self._told, self._tell_at = text, now + _NEWS_SECONDS
            self._news.append(text)


def _needs() -> dict[str, float]:
    """Of one worker, as the autoscaler counts."""
    return {"CPU": 1.0, "memory": float(WORKER_BYTES)}


def _is_up(berth: _Berth) -> bool:
    return berth.run is not None and berth.seen is not None and berth.seen.name == berth.name


def _wait(calls: list[Any], seconds: float) -> list[Any]:
    """Waits for all of them; returns those that are not done."""
    return list(ray.wait(calls, num_returns=len(calls), timeout=seconds)[1]) if calls else []


def _first_line(error: BaseException) -> str:
    return str(error).strip().partition("\n")[0][:300]


def _connect(address: str) -> None:
    """Joins the cluster.

    Raises:
        UsageError: there is none.
    """
    # Ray takes over SIGTERM, of which the server has its own idea.
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        if address != "auto":
            # Ray itself would ask for minutes.
            host, _, port = address.rpartition(":") if ":" in address else (address, ":", "6379")
            socket.create_connection((host, int(port)), _CONNECT_SECONDS).close()
            address = f"{host}:{port}"
        ray.init(address=address, namespace="v2v", logging_level="warning")
    except (OSError, RayError, ValueError, RuntimeError) as error:
        raise UsageError(
            f"--ray-address {address}: {_first_line(error)}; start a cluster with `ray start --head`, and make this "
            "host a node of it with `ray start --address HOST:6379 --num-cpus 0`"
        ) from error
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
