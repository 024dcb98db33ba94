"""`v2v-worker`: arguments -> call."""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from v2v_protocol.command import Parser, run_command
from v2v_protocol.errors import V2VError
from v2v_protocol.keys import addresses
from v2v_protocol.programs import environment
from v2v_server.config import ServeConfig
from v2v_server.corpus.sources.source import COPIES_GIB, SourceOptions, open_source
from v2v_server.store.cache import Cache, make_cache
from v2v_server.system.log import GIB, Log, report_errors
from v2v_server.system.process import die_with_parent, relayed_output
from v2v_server.worker.process import run_worker, unshared_name
from v2v_server.worker.warm_up import warm_up_in_turn


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status.

    ``--standby PID``, from a server, gets ready and then reads the arguments from standard input.
    """
    argv = sys.argv[1:] if argv is None else argv
    if argv[:1] == ["--standby"]:
        die_with_parent(int(argv[1]))
        warm_up_in_turn()
        argv = sys.stdin.buffer.read().decode().split("\0")
        if argv == [""]:
            return 0
    parser = Parser(
        "v2v-worker", "--connect ADDRESS --videos DIR [flags]", "Work for servers: take leases, make samples.",
        [
            "v2v-worker --connect tcp://10.0.0.5:5556 --videos /data/webvid",
            "v2v-worker --connect tcp://a:5556,tcp://b:5556 --videos /data/webvid",
        ],
    )  # fmt: skip
    work = parser.group("Work")
    work.add_argument(
        "--connect", required=True, metavar="ADDRESS",
        help="where the server listens for workers; several, separated by commas, are served in turns",
    )  # fmt: skip
    work.add_argument(
        "--videos", required=True, metavar="DIR", help="the corpus on this host, the same as the server's, or s3://..."
    )
    work.add_argument("--name", help="prefix of the worker's name in logs (default: host and process id)")
    work.add_argument(
        "--keys", metavar="FILE", help="its key file, see v2v-keys (default: the file that V2V_KEYS names)"
    )
    work.add_argument(
        "--insecure", action="store_true", help="without a key, also work for another user's server on this host"
    )
    parser.add_settings(ServeConfig, "cache", "cache_gib", "copies", "copies_gib", "log_format")
    parser.add_argument("--parent-pid", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--logbook-fd", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--arenas-fd", type=int, help=argparse.SUPPRESS)
    return run_command(
        parser, report_errors(lambda given: _run(given, argv)), argv, failures=(V2VError,), interrupted=""
    )


def _run(arguments: argparse.Namespace, argv: Sequence[str]) -> None:
    if arguments.parent_pid is None and any(map(os.isatty, range(3))):
        # Apart from the terminal, which a process that a video has taken over could read and steer.
        sys.exit(
            subprocess.call(
                [sys.executable, "-m", "v2v_server.commands.worker", *argv, "--parent-pid", str(os.getpid())],
                stdin=subprocess.DEVNULL,
                stdout=relayed_output().fileno(),
                stderr=subprocess.STDOUT,
                env=environment(),
                start_new_session=True,
            )
        )
    # A server names its own workers, and recognises them by these names.
    name = arguments.name if arguments.logbook_fd is not None else unshared_name(arguments.name)
    source = open_source(
        arguments.videos, SourceOptions(copies=arguments.copies, copies_gib=arguments.copies_gib or COPIES_GIB)
    )
    if source.copies is not None:
        source.copies.make()
    cache = None
    if arguments.cache is not None:
        folder = Path(arguments.cache)
        if arguments.logbook_fd is None:  # a server has already made the name of its own workers unique
            make_cache(folder)
        cache = Cache(folder, int((100.0 if arguments.cache_gib is None else arguments.cache_gib) * GIB))
    log = Log(is_json=arguments.log_format == "json")
    run_worker(
        addresses(arguments.connect), source, name, arguments.parent_pid, arguments.logbook_fd, cache, arguments.keys,
        log, arguments.arenas_fd, insecure=arguments.insecure,
    )  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())
