"""Workers on a Ray cluster: Ray places an actor for each slot, and starts it again elsewhere when its node dies.

    Pool ──► RayHost (in the server) ──Ray──► RayWorker (one actor for each slot) ──► v2v-worker, unchanged
                  ▲                                                                      │
                  └───────────────────── ZeroMQ: leases and samples ─────────────────────┘

Ray carries no sample. The actor starts the worker's process on its node, observes it, and reports its end: a decoder
that crashes ends the process, never the actor. Only this module imports Ray (the extra ``ray``).
"""

from __future__ import annotations

import contextlib
import math
import signal
import socket
import threading
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import ray
from ray.autoscaler.sdk import request_resources
from ray.exceptions import ActorDiedError, ActorUnavailableError, RayError

from v2v_protocol.errors import UsageError
from v2v_protocol.keys import PeerKey
from v2v_server.broker.leases import Cause, Loss
from v2v_server.config import ServeConfig
from v2v_server.lease_memory import WORKER_BYTES
from v2v_server.supervise.local_host import LocalHost
from v2v_server.supervise.pool import Exit, ProcessStatus

_FIRST_STATUS_SECONDS = 1.0
_AGAIN_SECONDS = 1.0
_NEWS_SECONDS = 10.0
_CONNECT_SECONDS = 10.0
_CALLS_AT_ONCE = 4
"""In an actor: to run the process, to observe it, and to signal it."""


@dataclass(frozen=True, slots=True)
class ActorStatus:
    """What an actor observes.

    Attributes:
        node: its node.
        name: name of its worker; empty if none runs.
        process: the worker's process.
    """

    node: str
    name: str = ""
    process: ProcessStatus = field(default_factory=ProcessStatus)


class RayWorker:
    """The actor.

    Args:
        root: the corpus, a folder of its node or an address.
        flags: further flags of the worker.
        key: key of the worker; None: the key that ``V2V_KEYS`` names on its node.
    """

    def __init__(self, root: str, flags: Sequence[str], key: PeerKey | None = None) -> None:
        self._host = LocalHost(root, flags, key=key)
        self._lock = threading.Lock()
        self._place, self._name = self._host.place(0), ""

    def run(self, name: str, address: str) -> Exit:
        """Run one worker from its start to its end; return how it ended."""
        with self._lock:
            self._place.release()  # the result of the call that started an earlier one was lost on its way
            place = self._place = self._host.place(0)
            place.start(name, address)
            self._name = name
        place.wait(None)
        with self._lock:
            end = place.take_exit() or Exit(Loss(Cause.KILLED, "was replaced"))
        return replace(end, loss=replace(end.loss, text=f"{end.loss.text} on {node()}"))

    def status(self) -> ActorStatus:
        """Observe the worker's process."""
        with self._lock:
            self._host.refresh(time.monotonic())
            seen = self._place.status(0.0)
            return ActorStatus(node()) if seen is None else ActorStatus(node(), self._name, seen)

    def signal(self, name: str, number: int) -> None:
        """Send a worker a signal, if it still runs."""
        with self._lock:
            if self._name == name:
                self._place.signal(number)


def node() -> str:
    """Return the name of this node for logs."""
    context = ray.get_runtime_context()
    return f"{socket.gethostname()} ({context.get_node_id()[:6]})"


def make_host(
    config: ServeConfig, root: str, label: str, flags: Sequence[str], key: PeerKey | None, standbys: object
) -> RayHost:
    """Return the host that the configuration asks for.

    Raises:
        UsageError: there is no cluster.
    """
    return RayHost(root, label, flags, config.ray_address, config.ray_labels, key)


class RayHost:
    """A Ray cluster.

    Args:
        root: the corpus, a folder that every node has under this path, or an address.
        label: prefix of the actors' names, unique to this server.
        flags: further flags of each worker.
        address: address of the cluster, HOST:PORT; "auto" is the cluster that this host is a node of.
        selector: labels of the nodes that may have workers.
        key: key of the workers; None: the key that ``V2V_KEYS`` names on each node.

    Raises:
        UsageError: there is no cluster.
    """

    is_local = False
    status_seconds = 5.0

    def __init__(
        self,
        root: str,
        label: str,
        flags: Sequence[str] = (),
        address: str = "auto",
        selector: Mapping[str, str] | None = None,
        key: PeerKey | None = None,
    ) -> None:
        self._arguments = root, list(flags), key
        self._label = label
        self._selector = dict(selector or {})
        self._places: list[RayPlace] = []
        self._news: list[str] = []
        self._reported = ""
        self._report_at = -math.inf
        self._complete_at = math.inf  # when all workers last had a node; at first the time of the first check
        self._is_ours = not ray.is_initialized()
        if self._is_ours:
            _connect(address)

    def place(self, number: int) -> RayPlace:
        """Return a place for the worker of a slot: an actor, which Ray places on a node as soon as it can."""
        self._places.append(RayPlace(self, number))
        return self._places[-1]

    def request(self, workers: int) -> None:
        """Ask the cluster's autoscaler, if it has one, for nodes for this number of workers."""
        with contextlib.suppress(RayError, OSError):
            request_resources(bundles=[{"CPU": 1.0, "memory": float(WORKER_BYTES)} for _ in range(workers)])

    def refresh(self, now: float) -> None:
        """Read what the actors have reported, and ask for their status where that is due."""
        calls = [call for place in self._places for call in place.calls]
        done = set(ray.wait(calls, num_returns=len(calls), timeout=0)[0]) if calls else set()
        for place in self._places:
            place.refresh(done, now)
        self._report_nodes(now)

    def wait(self, places: Sequence[RayPlace], seconds: float) -> list[RayPlace]:
        """Wait until the workers have ended; return the places of those that have not."""
        runs = [place.run for place in places if place.run is not None]
        left = ray.wait(runs, num_returns=len(runs), timeout=seconds)[1] if runs else []
        return [place for place in places if place.run in left]

    def news(self) -> list[str]:
        """Return lines on where the workers are, since the last call."""
        news, self._news = self._news, []
        return news

    def close(self) -> None:
        """Withdraw the request for nodes, and leave the cluster."""
        self.request(0)
        if self._is_ours:
            ray.shutdown()

    def make_actor(self, number: int) -> Any:
        """Return a new actor for the worker of a slot."""
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

    def forget(self, place: RayPlace) -> None:
        """Drop a place that was given up."""
        self._places.remove(place)

    def _report_nodes(self, now: float) -> None:
        """Report where the workers are if that has changed, and if some have had no node for long."""
        nodes = Counter(place.seen.node for place in self._places if place.seen is not None)
        lacking = len(self._places) - nodes.total()
        if not lacking or self._complete_at == math.inf:
            self._complete_at = now
        if now < self._report_at or (lacking and now - self._complete_at < _NEWS_SECONDS):
            return
        counts = ", ".join(f"{node} {count}" for node, count in sorted(nodes.items())) or "none"
        text = f"ray: {nodes.total()} of {len(self._places)} workers have a place on {len(nodes)} nodes: {counts}"
        if lacking:
            text += f"; the others wait, each for 1 CPU and {WORKER_BYTES >> 30} GiB"
        if text != self._reported:
            self._reported, self._report_at = text, now + _NEWS_SECONDS
            self._news.append(text)


class RayPlace:
    """The place of one worker, on whatever node Ray chooses.

    Attributes:
        run: the call that runs the worker's process; None if no worker is started.
        seen: the actor's latest report; None if there is none since the worker was started.
    """

    def __init__(self, host: RayHost, number: int) -> None:
        self._host, self._number = host, number
        self._actor = host.make_actor(number)
        self._name = ""
        self._is_leaving = False
        self._exit: Exit | None = None
        self._asked: Any = None  # the call for the actor's status
        self._ask_at = 0.0
        self.run: Any = None
        self.seen: ActorStatus | None = None

    @property
    def calls(self) -> list[Any]:
        """Return the calls that have not returned."""
        return [call for call in (self.run, self._asked) if call is not None]

    @property
    def is_running(self) -> bool:
        """Return whether the worker's process was observed and has not ended."""
        return self.run is not None and self.seen is not None and self.seen.name == self._name

    def start(self, name: str, address: str) -> None:
        """Start a worker; instead of all interfaces it connects to this node's own address."""
        for everywhere in ("//0.0.0.0:", "//[::]:"):
            address = address.replace(everywhere, f"//{ray.util.get_node_ip_address()}:")
        self._name, self.seen, self._ask_at = name, None, 0.0
        self.run = self._actor.run.remote(name, address)

    def take_exit(self) -> Exit | None:
        """Return once how the worker ended; None while it has not ended."""
        end, self._exit = self._exit, None
        return end

    def status(self, now: float) -> ProcessStatus | None:
        """Return the latest observation of the worker's process; None without one."""
        return self.seen.process if self.is_running and self.seen is not None else None

    def lend(self, arena: str) -> None:
        """Do nothing: a worker on the consumer's host opens the arena by its name."""

    def leave(self) -> bool:
        """Tell the worker to finish its sample and exit; return False if there is none to tell."""
        self._is_leaving = True
        if self.is_running:
            self.signal(signal.SIGTERM)
        return self.is_running

    def signal(self, number: int) -> None:
        """Send the worker's process a signal, if it runs."""
        self._actor.signal.remote(self._name, number)

    def release(self) -> None:
        """Kill the actor and the worker's process, without the orderly shutdown."""
        self._host.forget(self)
        ray.kill(self._actor, no_restart=True)

    def refresh(self, done: set[Any], now: float) -> None:
        """Read the calls that have returned, and ask for the actor's status if that is due."""
        if self._asked in done:
            asked, self._asked = self._asked, None
            with contextlib.suppress(RayError):  # an actor that is away is asked again
                report: ActorStatus = ray.get(asked)
                self.seen = replace(report, process=replace(report.process, seen_at=now))
        if self.run in done:
            self._exit = self._read_exit()
            self.run = None
        if self._asked is None and now >= self._ask_at:
            self._asked = self._actor.status.remote()
            self._ask_at = now + (self._host.status_seconds if self.is_running else _FIRST_STATUS_SECONDS)

    def _read_exit(self) -> Exit:
        """Return how the worker's process ended, or that its actor was lost along with it."""
        node = self.seen.node if self.seen is not None else "the cluster"
        try:
            end: Exit = ray.get(self.run)
            return end
        except ActorUnavailableError:
            # Ray starts the actor again, here or elsewhere.
            loss = Loss(Cause.KILLED, f"was lost with its actor on {node}")
            return Exit(loss, retry_seconds=_AGAIN_SECONDS, is_loss=self.is_running)
        except ActorDiedError as error:
            if not self._is_leaving:
                self._actor = self._host.make_actor(self._number)
            return Exit(Loss(Cause.KILLED, f"has no actor any more: {_first_line(error)}"))
        except RayError as error:
            return Exit(Loss(Cause.KILLED, f"could not be started on {node}: {_first_line(error)}"))


def _first_line(error: BaseException) -> str:
    return str(error).strip().partition("\n")[0][:300]


def _connect(address: str) -> None:
    """Join the cluster.

    Raises:
        UsageError: there is none.
    """
    # Ray replaces the handler of SIGTERM; the server needs its own.
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        if address != "auto":
            # Ray itself would try for minutes.
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
