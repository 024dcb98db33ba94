"""Decide which requests the page answers, and what a browser may do with the answer.

Every web site that a user visits can make the user's browser send requests to a page on this host, under the site's own
name if that name resolves to this host (DNS rebinding). So only names that others cannot own are accepted: IP
addresses, localhost, this host's own name, and names that the operator gives. The page shows untrusted text (names of
files and peers): only this server's own scripts may run, and nothing may be sent elsewhere.
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
    """Middleware before an application (ASGI).

    Args:
        app: the application.
        names: host names that it accepts, in addition to IP addresses, localhost and this host's own name.
    """

    def __init__(self, app: App, names: Iterable[str] = ()) -> None:
        self._app = app
        self._names = {"localhost", platform.node().lower(), *(name.lower() for name in names)} - {""}
        self._headers = [(name.encode(), value.encode()) for name, value in HEADERS.items()]

    async def __call__(self, scope: Message, receive: Receive, send: Send) -> None:
        """Handle a request, see ASGI."""
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
