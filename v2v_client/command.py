"""From what a command did to its exit status. An error of ours is one line on stderr; ``--debug`` shows its trace."""

from __future__ import annotations

import argparse
import signal
import sys
import traceback
from collections.abc import Callable, Sequence

from v2v_protocol.errors import V2VError

FAILED = 1
WRONG_USAGE = 2
INTERRUPTED = 128 + signal.SIGINT


def run_command(
    parser: argparse.ArgumentParser,
    run: Callable[[argparse.Namespace], int],
    argv: Sequence[str] | None,
    *,
    failures: tuple[type[V2VError], ...] = (),
    interrupted: str = "interrupted",
) -> int:
    """Parses and runs.

    Args:
        parser: of a command with a flag ``--debug``.
        run: returns the exit status.
        argv: the command line; None takes that of the process.
        failures: errors that say that the work failed (status 1); all others say that it could not be done (status 2).
        interrupted: what to say of a Ctrl-C.

    Returns:
        what ``run`` returned, else 1 or 2 after an error, 130 after a Ctrl-C.

    Raises:
        SystemExit: argparse's own, for flags that it does not understand.
    """
    arguments = parser.parse_args(argv)
    try:
        return run(arguments)
    except V2VError as error:
        if arguments.debug:
            traceback.print_exc()
        print(f"{parser.prog}: {' '.join(str(error).split())}", file=sys.stderr)
        return FAILED if isinstance(error, failures) else WRONG_USAGE
    except KeyboardInterrupt:
        print(f"{parser.prog}: {interrupted}", file=sys.stderr)
        return INTERRUPTED
