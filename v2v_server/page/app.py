"""Answer each path.

/          the page, for people; /static has its parts
/healthz   200 if the server answers; for a liveness probe, which restarts it
/readyz    200 if a worker can make samples; for a readiness probe, which sends consumers to it
/metrics   for Prometheus
/state     the newest status, JSON
/events    every new status, as server-sent events
/fields    what each number of the status means, JSON
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Iterable
from pathlib import Path

from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, PlainTextResponse, Response, StreamingResponse
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles

from v2v_server.page.guard import App, Guard
from v2v_server.page.metrics import exposition
from v2v_server.page.source import Source
from v2v_server.status.parts import PARTS, meanings_at

STATIC = Path(__file__).parent / "static"
EVENT_SECONDS = 0.5
MOST_STREAMS = 64
"""Browsers that receive every status. One that stops reading occupies its connection and the memory of one status."""


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
        if self._streams >= MOST_STREAMS:
            return PlainTextResponse(
                f"too many viewers: {MOST_STREAMS} are connected, the limit; close one and reload\n", 503
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
