"""The process of the page. A server starts it after binding its port: ``v2v_server.page.child``."""

from __future__ import annotations

import argparse
import socket
import sys
from collections.abc import Sequence

import uvicorn

from v2v_server.page.app import make_app
from v2v_server.page.silent import BoundedProtocol
from v2v_server.page.source import Source
from v2v_server.status.client import StatusClient
from v2v_server.system.process import die_with_parent


def main(argv: Sequence[str] | None = None) -> int:
    """Serve until told to stop, or until the server ends."""
    parser = argparse.ArgumentParser(prog="python -m v2v_server.page", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--connect", required=True, metavar="ADDRESS", help="address for the server's own workers")
    parser.add_argument("--fd", required=True, type=int, help="file descriptor of the listening socket")
    parser.add_argument(
        "--parent-pid", required=True, type=int, help="process id of the server, with which this process ends"
    )
    parser.add_argument("--names", default="", help="host names to accept, separated by commas")
    arguments = parser.parse_args(argv)
    die_with_parent(arguments.parent_pid)
    # No key: this address admits the server's own user, see v2v_server.page.child.
    source = Source(StatusClient(arguments.connect, keys=""))
    config = uvicorn.Config(
        make_app(source, filter(None, arguments.names.split(","))),
        log_level="warning",
        access_log=False,
        server_header=False,
        lifespan="off",
        ws="none",
        timeout_graceful_shutdown=1,
        limit_concurrency=256,
        http=BoundedProtocol,
    )
    with socket.socket(fileno=arguments.fd) as listening:
        uvicorn.Server(config).run(sockets=[listening])
    return 0


if __name__ == "__main__":
    sys.exit(main())
