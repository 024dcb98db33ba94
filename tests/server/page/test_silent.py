"""Connections that send nothing do not keep out those that ask."""

from __future__ import annotations

import contextlib
import http.client
import socket
import threading
from collections.abc import Iterator

import pytest
import uvicorn
from starlette.applications import Starlette
from starlette.responses import PlainTextResponse
from starlette.routing import Route

from tests.waiting import until
from v2v_server.page.silent import MOST_SILENT, BoundedProtocol


@pytest.fixture
def port() -> Iterator[int]:
    app = Starlette(routes=[Route("/healthz", lambda request: PlainTextResponse("ok"))])
    config = uvicorn.Config(
        app, http=BoundedProtocol, log_level="critical", lifespan="off", limit_concurrency=MOST_SILENT + 8
    )
    server = uvicorn.Server(config)
    with socket.create_server(("127.0.0.1", 0)) as listening:
        thread = threading.Thread(target=server.run, args=([listening],))
        thread.start()
        until(lambda: server.started)
        yield listening.getsockname()[1]
        server.should_exit = True
        thread.join()


def test_silent_connections_are_bounded_and_requests_are_answered(port: int) -> None:
    more = 16
    with contextlib.ExitStack() as stack:
        silent = [
            stack.enter_context(socket.create_connection(("127.0.0.1", port), timeout=60))
            for _ in range(MOST_SILENT + more)
        ]
        for oldest in silent[:more]:
            with contextlib.suppress(ConnectionResetError):
                assert oldest.recv(1) == b""
        asking = http.client.HTTPConnection("127.0.0.1", port, timeout=60)
        with contextlib.closing(asking):
            asking.request("GET", "/healthz")
            assert asking.getresponse().status == 200
