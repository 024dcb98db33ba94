"""Who may ask the page, and what a browser may do with the answer.

A page of this host can be asked by every web site that its user visits: the browser does it, under the site's own name,
if that name is made to stand for this host (DNS rebinding). So only names that nobody else can have are answered:
addresses, localhost, this host's own, and those that the operator gives. What is shown comes from strangers (names of
files and peers): nothing but this server's own files may run, and nothing may be sent elsewhere.
"""

from __future__ import annotations

import ipaddress
import platform
from collections.abc import Awaitable, Callable, Iterable, MutableMapping
from typing import Any, TypeAlias

from starlette.responses import PlainTextResponse

Message: TypeAlias = MutableMapping[str, Any]
Receive: TypeAlias = Callable[[], Awaitable[Message]]
Send: TypeAlias = Callable[[Message], Awaitable[None]]
App: TypeAlias = Callable[[Message, Receive, Send], Awaitable[None]]

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


class Guard:
    """Stands before an application (ASGI).

    Args:
        app: what it guards.
        names: that may be asked by, besides addresses, localhost and this host's own.
    """

    def __init__(self, app: App, names: Iterable[str] = ()) -> None:
        self._app = app
        self._names = {"localhost", platform.node().lower(), *(name.lower() for name in names)} - {""}
        self._headers = [(name.encode(), value.encode()) for name, value in HEADERS.items()]

    async def __call__(self, scope: Message, receive: Receive, send: Send) -> None:
        """See ASGI."""
        if scope["type"] != "http":
            if scope["type"] == "lifespan":
                await self._app(scope, receive, send)
            return

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                given = {name for name, _ in message["headers"]}
                message["headers"] = [*message["headers"], *(each for each in self._headers if each[0] not in given)]
            await send(message)

        hosts = [value.decode("latin-1") for name, value in scope["headers"] if name == b"host"]
        if len(hosts) == 1 and self.admits(hosts[0]):
            await self._app(scope, receive, send_with_headers)
            return
        refusal = PlainTextResponse(
            "this page is not asked by that name; ask by an address, or start v2v-serve with --page-names NAME\n", 421
        )
        await refusal(scope, receive, send_with_headers)

    def admits(self, host: str) -> bool:
        """Whether a Host header names this host in a way that nobody else can."""
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
