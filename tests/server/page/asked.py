"""An application (ASGI) asked without a network, and a client without a server."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from tests.server.status.services import Published
from v2v_protocol.errors import ServerLost
from v2v_server.page.app import App


@dataclass
class Answer:
    status: int = 0
    headers: dict[str, str] = field(default_factory=dict)
    body: bytes = b""

    @property
    def text(self) -> str:
        return self.body.decode()


def ask(
    app: App, path: str, headers: Mapping[str, str] | None = None, *, method: str = "GET", most_parts: int = 0
) -> Answer:
    """The answer to a request; of an endless one so many parts."""
    return asyncio.run(asked(app, path, headers, method=method, most_parts=most_parts))


async def asked(
    app: App, path: str, headers: Mapping[str, str] | None = None, *, method: str = "GET", most_parts: int = 0
) -> Answer:
    answer, parts, enough = Answer(), 0, asyncio.Event()
    given = {"host": "127.0.0.1:5580"} | dict(headers or {})
    scope = {
        "type": "http", "method": method, "path": path, "raw_path": path.encode(), "query_string": b"",
        "headers": [(name.encode(), value.encode()) for name, value in given.items()],
        "http_version": "1.1", "scheme": "http", "server": ("127.0.0.1", 5580), "client": ("127.0.0.1", 1),
        "root_path": "",
    }  # fmt: skip

    async def receive() -> dict[str, Any]:
        await enough.wait()
        return {"type": "http.disconnect"}

    async def send(message: Any) -> None:
        nonlocal parts
        if message["type"] == "http.response.start":
            answer.status = message["status"]
            answer.headers = {name.decode(): value.decode() for name, value in message["headers"]}
            return
        answer.body += message.get("body", b"")
        parts += 1
        if parts == most_parts or not message.get("more_body"):
            enough.set()

    await app(scope, receive, send)
    return answer


class FakeClient:
    """Gets the status of a published service without a wire, and counts the requests; None: it does not answer."""

    def __init__(self, service: Published | None) -> None:
        self.service = service
        self.requests = 0

    def get_status(self, timeout_seconds: float) -> dict[str, Any]:
        self.requests += 1
        if self.service is None:
            raise ServerLost("tcp://127.0.0.1:5555: no answer for 3 s; is v2v-serve running there?")
        return self.service.plain()
