"""`v2v-top`: the state of a server, its workers and its consumers on a terminal."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from typing import Any

from rich.console import Console
from rich.live import Live

from v2v_protocol.command import Parser, run_command
from v2v_protocol.errors import ServerLost, V2VError
from v2v_server.status.client import StatusClient
from v2v_server.status.terminal import draw, line

_LIVE_SECONDS, _LINE_SECONDS = 1.0, 10.0


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    parser = Parser(
        "v2v-top", "[flags]",
        "Show the state of a running server: its bottleneck, its workers and its consumers. Ctrl-C ends it.",
        ["v2v-top --connect tcp://node7:5555 --keys gpu.key", "v2v-top --once"],
    )  # fmt: skip
    what = parser.group("Watching")
    what.add_argument(
        "--connect",
        default="tcp://127.0.0.1:5555",
        metavar="ADDRESS",
        help="address of the server for consumers (default %(default)s)",
    )
    what.add_argument("--keys", metavar="FILE", help="a consumer's key (default: what V2V_KEYS names)")
    what.add_argument(
        "--insecure", action="store_true", help="without a key, also show another user's server on this host"
    )
    what.add_argument(
        "--once", action="store_true", help="show the current state and exit; status 1 if the server does not answer"
    )
    what.add_argument(
        "--timeout-seconds", type=float, default=10.0, metavar="S", help="wait for an answer, seconds (default 10)"
    )
    return run_command(parser, _run, argv, failures=(V2VError,), interrupted="")


def _run(arguments: argparse.Namespace) -> None:
    console = Console()
    with StatusClient(arguments.connect, arguments.keys, insecure=arguments.insecure) as client:
        state = client.get_status(arguments.timeout_seconds)  # report an absent server at once
        if not console.is_terminal:
            _lines(client, state, arguments)
        elif arguments.once:
            console.print(draw(state))
        else:
            _live(console, client, state, arguments.timeout_seconds)


def _lines(client: StatusClient, state: dict[str, Any], arguments: argparse.Namespace) -> None:
    print(line(state), flush=True)
    while not arguments.once:
        time.sleep(_LINE_SECONDS)
        print(line(client.get_status(arguments.timeout_seconds)), flush=True)


def _live(console: Console, client: StatusClient, state: dict[str, Any], timeout_seconds: float) -> None:
    with Live(draw(state), console=console, screen=True, auto_refresh=False) as live:
        while True:
            time.sleep(_LIVE_SECONDS)
            note = ""
            try:
                state = client.get_status(timeout_seconds)
            except ServerLost as error:  # the server may come back
                note = f"{error} The state shown is old."
            live.update(draw(state, note), refresh=True)


if __name__ == "__main__":
    sys.exit(main())
