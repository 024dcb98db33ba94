"""The process of the page, which a server starts after binding its port (:mod:`v2v_server.page.child`): the answer for
each path.

/          the page, for people; /static has its parts
/healthz   200 if the server answers; for a liveness probe, which restarts it
/readyz    200 if a worker can make samples; for a readiness probe, which sends consumers to it
/metrics   for Prometheus
/state     the newest status, JSON
/events    every new status, as server-sent events
/fields    what each number of the status means, JSON

Every web site that a user visits can make the user's browser send requests to a page on this host, under the site's own
name if that name resolves to this host (DNS rebinding). So only names that others cannot own are accepted: IP
addresses, localhost, this host's own name, and names that the operator gives. The page shows untrusted text (names of
files and peers): only this server's own scripts may run, and nothing may be sent elsewhere.

Metrics follow Prometheus's convention of names (base units, ``_total`` for counters). Every field with a metric is
walked (:mod:`v2v_server.system.log`). Consumers and workers have labels. A consumer's label is its display
name, which stays the same in each epoch; consumers with the same name are merged.
"""

from __future__ import annotations

import argparse
import asyncio
import ipaddress
import json
import os
import platform
import socket
import sys
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable, Iterator, Mapping, MutableMapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import uvicorn
from prometheus_client import CollectorRegistry
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.exposition import choose_encoder
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, PlainTextResponse, Response, StreamingResponse
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles
from uvicorn.protocols.http.h11_impl import H11Protocol

from v2v_protocol.errors import V2VError
from v2v_protocol.link.user import OwnUser
from v2v_server.status.client import StatusClient
from v2v_server.status.snapshot import PARTS, StatusFields, meanings_at, rows_at
from v2v_server.system.log import GIB, Log, Meaning
from v2v_server.system.process import die_with_parent

FRESH_SECONDS = 0.4
"""A status of at most this age is reused."""
_ANSWER_SECONDS = 3.0
KNOWN_SECONDS = 15.0
"""A health check accepts a status of this age."""


AsgiMessage: TypeAlias = MutableMapping[str, Any]
Receive: TypeAlias = Callable[[], Awaitable[AsgiMessage]]
AsgiSend: TypeAlias = Callable[[AsgiMessage], Awaitable[None]]
App: TypeAlias = Callable[[AsgiMessage, Receive, AsgiSend], Awaitable[None]]
HEADERS = {
    "content-security-policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; font-src 'self'; "
        "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "referrer-policy": "no-referrer",
    "x-content-type-options": "nosniff",
    "cache-control": "no-store",
}
_PREFIXES = {"workers": "v2v_worker_", "consumers": "v2v_consumer_", "cache": "v2v_cache_"}
_LABELS = {"workers": {"worker": "name", "host": "host"}, "consumers": {"consumer": "name", "host": "host"}}
_HELP = {
    "v2v_worker_seconds": "Wall-clock time of workers, by activity.",
    "v2v_time_ratio": "Shares of time over the last ten seconds: consumers waited, broker busy, workers at each part.",
}
"""Texts of metrics that several fields share, each under its own label."""
_RULE = "the page serves only root and the server's user; give --insecure to let every user of this host watch"
STATIC = Path(__file__).parent / "static"
EVENT_SECONDS = 0.5
MOST_PAGE_CONNECTIONS = 256
"""Open connections; a further one is closed at once."""
_PAUSE_SECONDS = 5.0
"""Time until connections are accepted again after there were no descriptors for one."""
MOST_EVENT_STREAMS = 64
"""Browsers that receive every status. One that stops reading occupies its connection and the memory of one status."""


@dataclass(frozen=True, slots=True)
class LatestStatus:
    """The last answer of the server.

    Attributes:
        status: see :mod:`v2v_server.status.snapshot`; None if the server did not answer.
        trouble: why it did not answer; empty if it did.
        at: time of the answer, seconds.
    """

    status: dict[str, Any] | None
    trouble: str
    at: float


class Source:
    """Request the status from a server, one request at a time and at most a few per second.

    Args:
        client: sends the requests; used by one thread at a time.
        clock: returns monotonic time, seconds.
    """

    def __init__(self, client: StatusClient, clock: Callable[[], float] = time.monotonic) -> None:
        self._client = client
        self._clock = clock
        self._lock = asyncio.Lock()
        self._latest: LatestStatus | None = None
        self._answered: LatestStatus | None = None
        self._asking: asyncio.Future[LatestStatus] | None = None

    async def latest(self) -> LatestStatus:
        """Return the newest status, which is at most :data:`FRESH_SECONDS` old."""
        async with self._lock:
            if self._latest is None or self._clock() - self._latest.at >= FRESH_SECONDS:
                self._latest = await asyncio.to_thread(self._request)
            return self._latest

    async def known(self) -> LatestStatus:
        """Return what is known without waiting for the server, unless nothing recent is known.

        A status up to :data:`KNOWN_SECONDS` old counts; the next one is asked for in the background.
        """
        if self._asking is None or self._asking.done():
            self._asking = asyncio.ensure_future(self.latest())
        if self._answered is not None and self._clock() - self._answered.at < KNOWN_SECONDS:
            return self._answered
        if self._latest is not None and self._clock() - self._latest.at < KNOWN_SECONDS:
            return self._latest
        return await asyncio.shield(self._asking)

    def _request(self) -> LatestStatus:
        try:
            status = self._client.get_status(_ANSWER_SECONDS)
        except V2VError as error:
            return LatestStatus(None, str(error), self._clock())
        answered = self._answered = LatestStatus(status, "", self._clock())
        return answered


class Guard:
    """Middleware before an application (ASGI).

    Args:
        app: the application.
        names: host names that it accepts, in addition to IP addresses, localhost and this host's own name.
    """

    def __init__(self, app: App, names: Iterable[str] = ()) -> None:
        self._app = app
        self._names = {"localhost", platform.node().lower(), *(name.lower() for name in names)} - {""}
        self._headers = [(name.encode(), value.encode()) for name, value in HEADERS.items()]

    async def __call__(self, scope: AsgiMessage, receive: Receive, send: AsgiSend) -> None:
        """Handle a request, see ASGI."""
        if scope["type"] != "http":
            if scope["type"] == "lifespan":
                await self._app(scope, receive, send)
            return

        async def send_with_headers(message: AsgiMessage) -> None:
            if message["type"] == "http.response.start":
                given = {name for name, _ in message["headers"]}
                message["headers"] = [*message["headers"], *(each for each in self._headers if each[0] not in given)]
            await send(message)

        hosts = [value.decode("latin-1") for name, value in scope["headers"] if name == b"host"]
        if len(hosts) == 1 and self.admits(hosts[0]):
            await self._app(scope, receive, send_with_headers)
            return
        refusal = PlainTextResponse(
            "Unknown Host header. Use an IP address, or allow the name with v2v-serve --page-names NAME.\n", 421
        )
        await refusal(scope, receive, send_with_headers)

    def admits(self, host: str) -> bool:
        """Return whether a Host header names this host in a way that others cannot."""
        name = _without_port(host).lower()
        if name in self._names:
            return True
        try:
            ipaddress.ip_address(name)
        except ValueError:
            return False
        return True


def _without_port(host: str) -> str:
    if host.startswith("["):
        return host[1 : host.find("]")] if "]" in host else ""
    return host.rpartition(":")[0] if ":" in host else host


class StatusCollector:
    """Collector of the metrics of one status.

    Args:
        status: the status; None if the server does not answer.
    """

    def __init__(self, status: StatusFields | None) -> None:
        self._status = status

    def collect(self) -> Iterator[Metric]:
        """Yield every metric."""
        yield GaugeMetricFamily("v2v_up", "Whether the server answers.", value=float(self._status is not None))
        if self._status is None:
            return
        info = GaugeMetricFamily("v2v_info", "Versions.", labels=("program", "protocol"))
        info.add_metric((self._status["program"], str(self._status["protocol"])), 1.0)
        yield info
        families: dict[str, Any] = {}
        for place in PARTS:
            rows = rows_at(self._status, place)
            for key, meaning in meanings_at(place).items():
                if meaning.kind != "text" and meaning.metric != "":
                    _add(families, place, key, meaning, rows)
        yield from families.values()


def exposition(status: StatusFields | None, accept: str = "") -> tuple[bytes, str]:
    """Return the metrics of a status, and their content type.

    Args:
        status: see :class:`StatusCollector`.
        accept: the request's Accept header.
    """
    registry = CollectorRegistry(auto_describe=False)
    registry.register(StatusCollector(status))
    encode, content_type = choose_encoder(accept)
    return encode(registry), content_type


def _add(families: dict[str, Any], place: str, key: str, meaning: Meaning, rows: list[StatusFields]) -> None:
    """Add the samples of one field to the family of its metric."""
    name = _PREFIXES.get(place, "v2v_") + (key if meaning.metric is None else meaning.metric)
    labels = _LABELS.get(place, {})
    names = (*labels, "part") if meaning.part else tuple(labels)
    samples: dict[tuple[str, ...], float] = {}
    if meaning.kind == "states":
        name, names = f"v2v_{meaning.metric}", (key,)
        samples = {(state,): sum(row[key] == state for row in rows) for state in meaning.states}
    else:
        for label, values in _merged(key, labels, rows).items():
            samples[(*label, meaning.part) if meaning.part else label] = meaning.merge(values)
    kind = CounterMetricFamily if meaning.kind == "counter" else GaugeMetricFamily
    family = families.setdefault(name, kind(name, _HELP.get(name, meaning.help), labels=names))
    for label, value in samples.items():
        family.add_metric(label, value * (GIB if meaning.unit == "GiB" else 1))


def _merged(key: str, labels: Mapping[str, str], rows: list[StatusFields]) -> dict[tuple[str, ...], list[Any]]:
    """Return the known values of a field by the labels of their rows."""
    found: dict[tuple[str, ...], list[Any]] = {}
    for row in rows:
        if row[key] is not None and row.get("state") != "gone":
            found.setdefault(tuple(row[of] for of in labels.values()), []).append(row[key])
    return found


class Pages:
    """Handlers of the paths.

    Args:
        source: where statuses come from.
    """

    def __init__(self, source: Source) -> None:
        self._source = source
        self._streams = 0

    async def page(self, request: Request) -> Response:
        """Return the page for people."""
        return FileResponse(STATIC / "index.html")

    async def healthz(self, request: Request) -> Response:
        """Report whether the server answers."""
        latest = await self._source.known()
        return _said(latest.trouble)

    async def readyz(self, request: Request) -> Response:
        """Report whether a worker can make samples."""
        latest = await self._source.known()
        if latest.status is None:
            return _said(latest.trouble)
        return _said("" if latest.status["is_ready"] and latest.status["worker_count"] else "no worker is connected")

    async def metrics(self, request: Request) -> Response:
        """Return the metrics; if the server does not answer, ``v2v_up`` is 0."""
        latest = await self._source.latest()
        content, content_type = exposition(latest.status, request.headers.get("accept", ""))
        return Response(content, headers={"content-type": content_type})

    async def state(self, request: Request) -> Response:
        """Return the newest status."""
        latest = await self._source.latest()
        if latest.status is None:
            return JSONResponse({"trouble": latest.trouble}, 503)
        return JSONResponse(latest.status)

    async def fields(self, request: Request) -> Response:
        """Return the place, name, help and unit of each field."""
        return JSONResponse(
            [
                {"place": place, "name": name, "words": meaning.words or name.replace("_", " ")}
                | {"help": meaning.help, "unit": meaning.unit, "kind": meaning.kind}
                for place in PARTS
                for name, meaning in meanings_at(place).items()
            ]
        )

    async def events(self, request: Request) -> Response:
        """Stream every status: ``event: state``, or ``event: trouble`` if the server does not answer."""
        if self._streams >= MOST_EVENT_STREAMS:
            return PlainTextResponse(
                f"too many viewers: {MOST_EVENT_STREAMS} are connected, the limit; close one and reload\n", 503
            )
        return StreamingResponse(self._events(), media_type="text/event-stream")

    async def _events(self) -> AsyncIterator[bytes]:
        self._streams += 1
        try:
            while True:
                latest = await self._source.latest()
                kind = "state" if latest.status is not None else "trouble"
                data = json.dumps(latest.status if latest.status is not None else {"trouble": latest.trouble})
                yield f"event: {kind}\ndata: {data}\n\n".encode()
                await asyncio.sleep(EVENT_SECONDS)
        finally:
            self._streams -= 1


def make_app(source: Source, names: Iterable[str] = ()) -> App:
    """Build the application.

    Args:
        source: where statuses come from.
        names: host names that it accepts, in addition to IP addresses and this host's own name.
    """
    pages = Pages(source)
    routes = [
        Route("/", pages.page),
        Mount("/static", StaticFiles(directory=STATIC)),
        Route("/healthz", pages.healthz),
        Route("/readyz", pages.readyz),
        Route("/metrics", pages.metrics),
        Route("/state", pages.state),
        Route("/events", pages.events),
        Route("/fields", pages.fields),
    ]
    return Guard(Starlette(routes=routes), names)


def _said(trouble: str) -> Response:
    return PlainTextResponse(f"{trouble or 'ok'}\n", 503 if trouble else 200)


class PageServer(uvicorn.Server):
    """A server that accepts its connections itself. One that may not stay takes nothing but its descriptor until it is
    closed. asyncio's own loop writes a traceback for each connection that waits while there are no descriptors.

    Args:
        admits: whether a connection may stay.
        say: writes a line.
    """

    def __init__(
        self, config: uvicorn.Config, admits: Callable[[socket.socket], bool], say: Callable[..., object]
    ) -> None:
        super().__init__(config)
        self._admits, self._say, self._protocol = admits, say, partial(H11Protocol, config, self.server_state, {})

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Begin to accept connections, see uvicorn."""
        await super().startup([])
        self._accepting = [asyncio.create_task(self._accept(listening)) for listening in sockets or ()]

    async def _accept(self, listening: socket.socket) -> None:
        while True:
            try:
                link, _ = await asyncio.get_running_loop().sock_accept(listening)
                os.close(os.dup(link.fileno()))  # an error if no descriptor is left to ask for its user
                if len(self.server_state.connections) < MOST_PAGE_CONNECTIONS and self._admits(link):
                    await asyncio.get_running_loop().connect_accepted_socket(self._protocol, link)
                else:
                    link.close()
            except OSError as error:
                self._say(f"the page accepts no connections for {_PAUSE_SECONDS:g} s: {error.strerror}", "warning")
                await asyncio.sleep(_PAUSE_SECONDS)


def main(argv: Sequence[str] | None = None) -> int:
    """Serve until told to stop, or until the server ends."""
    parser = argparse.ArgumentParser(
        prog="python -m v2v_server.page.app", description="Answer HTTP for a server, which starts this."
    )
    parser.add_argument("--connect", required=True, metavar="ADDRESS", help="address for the server's own workers")
    parser.add_argument("--fd", required=True, type=int, help="file descriptor of the listening socket")
    parser.add_argument(
        "--parent-pid", required=True, type=int, help="process id of the server, with which this process ends"
    )
    parser.add_argument("--names", default="", help="host names to accept, separated by commas")
    parser.add_argument("--log-format", default="text", help="text or json")
    parser.add_argument("--insecure", action="store_true", help="serve every user")
    arguments = parser.parse_args(argv)
    die_with_parent(arguments.parent_pid)
    # No key: this address admits the server's own user, see v2v_server.page.child.
    source = Source(StatusClient(arguments.connect, keys=""))
    log = Log(is_json=arguments.log_format == "json")
    is_open = arguments.insecure or sys.platform != "linux"
    admits = (lambda _: True) if is_open else OwnUser(_RULE, log.say).admits
    config = uvicorn.Config(
        make_app(source, filter(None, arguments.names.split(","))),
        log_level="warning",
        access_log=False,
        server_header=False,
        lifespan="off",
        ws="none",
        timeout_graceful_shutdown=1,
        http=H11Protocol,
    )
    with socket.socket(fileno=arguments.fd) as listening:
        listening.setblocking(False)
        PageServer(config, admits, log.say).run([listening])
    return 0


if __name__ == "__main__":
    sys.exit(main())
