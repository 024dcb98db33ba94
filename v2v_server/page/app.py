"""What is answered to which path.

/          the page, for a person; /static has its parts
/healthz   200 where the server answers; for a probe that starts it again
/readyz    200 where somebody can make samples; for a probe that sends consumers to it
/metrics   for Prometheus
/state     the newest state, JSON
/events    every new state, as server-sent events
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

STATIC = Path(__file__).parent / "static"
EVENT_SECONDS = 0.5
MOST_STREAMS = 64
"""Browsers that are told of every state. One that stops reading holds its own connection, and a state of memory."""


class Pages:
    """The answers.

    Args:
        source: of states.
    """

    def __init__(self, source: Source) -> None:
        self._source = source
        self._streams = 0

    async def page(self, request: Request) -> Response:
        """For a person."""
        return FileResponse(STATIC / "index.html")

    async def healthz(self, request: Request) -> Response:
        """Whether the server answers."""
        sight = await self._source.known()
        return _said(sight.trouble)

    async def readyz(self, request: Request) -> Response:
        """Whether somebody can make samples."""
        sight = await self._source.known()
        if sight.state is None:
            return _said(sight.trouble)
        return _said("" if sight.state["is_ready"] and sight.state["worker_count"] else "no worker is connected")

    async def metrics(self, request: Request) -> Response:
        """For Prometheus; also where the server does not answer, which ``v2v_up`` then says."""
        sight = await self._source.latest()
        content, content_type = exposition(sight.state, request.headers.get("accept", ""))
        return Response(content, headers={"content-type": content_type})

    async def state(self, request: Request) -> Response:
        """The newest state."""
        sight = await self._source.latest()
        if sight.state is None:
            return JSONResponse({"trouble": sight.trouble}, 503)
        return JSONResponse(sight.state)

    async def events(self, request: Request) -> Response:
        """States as they come: ``event: state``; ``event: trouble`` where the server does not answer."""
        if self._streams >= MOST_STREAMS:
            return PlainTextResponse(f"{MOST_STREAMS} others look on already\n", 503)
        return StreamingResponse(self._events(), media_type="text/event-stream")

    async def _events(self) -> AsyncIterator[bytes]:
        self._streams += 1
        try:
            while True:
                sight = await self._source.latest()
                kind = "state" if sight.state is not None else "trouble"
                data = json.dumps(sight.state if sight.state is not None else {"trouble": sight.trouble})
                yield f"event: {kind}\ndata: {data}\n\n".encode()
                await asyncio.sleep(EVENT_SECONDS)
        finally:
            self._streams -= 1


def make_app(source: Source, names: Iterable[str] = ()) -> App:
    """The application.

    Args:
        source: of states.
        names: that the page may be asked by, besides addresses and this host's own.
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
    ]
    return Guard(Starlette(routes=routes), names)


def _said(trouble: str) -> Response:
    return PlainTextResponse(f"{trouble or 'ok'}\n", 503 if trouble else 200)
