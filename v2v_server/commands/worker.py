"""`v2v-worker`: arguments -> call."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from v2v_protocol.command import Parser, run_command
from v2v_protocol.errors import V2VError
from v2v_server.catalogue.files import corpus_root
from v2v_server.worker.process import run_worker, unshared_name


def main(argv: Sequence[str] | None = None) -> int:
    """The command line; returns the exit status."""
    parser = Parser(
        "v2v-worker", "--connect ADDRESS --videos DIR [flags]", "Work for a server: take leases, make samples.",
        ["v2v-worker --connect tcp://10.0.0.5:5556 --videos /data/webvid"],
    )  # fmt: skip
    work = parser.group("Work")
    work.add_argument("--connect", required=True, metavar="ADDRESS", help="where the server listens for workers")
    work.add_argument("--videos", required=True, metavar="DIR", help="the corpus on this host: what the server's is")
    work.add_argument("--name", help="how its name begins in logs (default: host and process id)")
    parser.add_argument("--parent-pid", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--logbook-fd", type=int, help=argparse.SUPPRESS)
    return run_command(parser, _run, argv, failures=(V2VError,), interrupted="")


def _run(arguments: argparse.Namespace) -> None:
    # Its own workers a server names itself, and knows them by it.
    name = arguments.name if arguments.logbook_fd is not None else unshared_name(arguments.name)
    root = corpus_root(Path(arguments.videos))
    run_worker(arguments.connect, root, name, arguments.parent_pid, arguments.logbook_fd)


if __name__ == "__main__":
    sys.exit(main())
