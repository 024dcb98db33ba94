"""The process of the page. Started by a server, which has bound its port already: ``v2v_server.page.child``."""

from __future__ import annotations

import argparse
import os
import socket
import sys
from collections.abc import Sequence

import uvicorn

from v2v_server.console.asking import Looker
from v2v_server.page.app import make_app
from v2v_server.page.silent import BoundedProtocol
from v2v_server.page.source import Source
from v2v_server.system.process import die_with_parent

_NICE = 10
"""What watches takes no time from what is watched."""


def main(argv: Sequence[str] | None = None) -> int:
    """Serve until it is told to stop, or the server ends."""
    parser = argparse.ArgumentParser(prog="python -m v2v_server.page", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--connect", required=True, metavar="ADDRESS", help="where the server's own workers connect")
    parser.add_argument("--fd", required=True, type=int, help="descriptor of the socket that listens")
    parser.add_argument("--parent-pid", required=True, type=int, help="the server, with which this process ends")
    parser.add_argument("--names", default="", help="names that the page may be asked by, with commas between")
    arguments = parser.parse_args(argv)
    die_with_parent(arguments.parent_pid)
    os.nice(_NICE)
    # No key: the server lets in its own user here, see v2v_server.page.child.
    source = Source(Looker(arguments.connect, keys=""))
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
