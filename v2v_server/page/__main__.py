"""The process of the page. A server starts it after binding its port: ``v2v_server.page.child``."""

from __future__ import annotations

import argparse
import socket
import sys
from collections.abc import Sequence
from typing import Any, ClassVar

import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

from v2v_protocol.link.user import OwnUser
from v2v_server.page.app import Source, make_app
from v2v_server.status.client import StatusClient
from v2v_server.system.log import Log
from v2v_server.system.process import die_with_parent

_RULE = "the page serves only root and the server's user; give --insecure to let every user of this host watch"


class OwnUserProtocol(H11Protocol):
    """Close connections of other users of this host before they send a request."""

    own_user: ClassVar[OwnUser]

    def connection_made(self, transport: Any) -> None:
        """Check a new connection, see asyncio.Protocol."""
        super().connection_made(transport)
        if not self.own_user.admits(transport.get_extra_info("socket")):
            transport.abort()


def main(argv: Sequence[str] | None = None) -> int:
    """Serve until told to stop, or until the server ends."""
    parser = argparse.ArgumentParser(prog="python -m v2v_server.page", description=(__doc__ or "").split("\n")[0])
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
    is_open = arguments.insecure or sys.platform != "linux"
    if not is_open:
        OwnUserProtocol.own_user = OwnUser(_RULE, Log(is_json=arguments.log_format == "json").say)
    config = uvicorn.Config(
        make_app(source, filter(None, arguments.names.split(","))),
        log_level="warning",
        access_log=False,
        server_header=False,
        lifespan="off",
        ws="none",
        timeout_graceful_shutdown=1,
        limit_concurrency=256,
        http=H11Protocol if is_open else OwnUserProtocol,
    )
    with socket.socket(fileno=arguments.fd) as listening:
        uvicorn.Server(config).run(sockets=[listening])
    return 0


if __name__ == "__main__":
    sys.exit(main())
