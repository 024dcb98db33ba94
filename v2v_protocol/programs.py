"""Entry points of the installed programs. A program whose packages are missing says so in one line. Programs that one
starts run from the same installation.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable
from functools import partial
from importlib import import_module
from pathlib import Path

_OURS = frozenset({"v2v_protocol", "v2v_server", "v2v_client", "trainer"})

Program = Callable[[], int | None]
"""A function that returns the exit status; None is success."""


def _program(name: str, module: str, function: str, extra: str) -> Program:
    """Return a program whose modules are imported when it runs.

    Args:
        name: name of the command.
        module, function: what it runs.
        extra: the extra of the distribution that installs its imports.
    """

    def run() -> int | None:
        before = signal.getsignal(signal.SIGINT)
        if before is signal.default_int_handler:
            signal.signal(signal.SIGINT, partial(_end_at_once, name))
        try:
            main = getattr(import_module(module), function)
            signal.signal(signal.SIGINT, before or signal.SIG_DFL)
            status: int | None = main()
        except ModuleNotFoundError as error:
            package = (error.name or "").partition(".")[0]
            if package in _OURS:
                raise
            print(
                f"{name}: needs the Python package {package}, which is not installed; the extra '{extra}' brings it: "
                f"pip install '.[{extra}]' in a checkout of v2v-stream",
                file=sys.stderr,
            )
            return 2
        return status

    return run


def _end_at_once(name: str, *_: object) -> None:
    """Answer a Ctrl-C while modules are imported: an error would be raised in the middle of one of them."""
    os.write(2, f"{name}: interrupted\n".encode())
    os._exit(128 + signal.SIGINT)


def environment() -> dict[str, str]:
    """Return the environment in which one of our processes starts another by ``python -m``.

    By default ``python -m`` looks for modules in the current folder first: it may hold another version of this package,
    or a file named like a module. The new process looks there only if this process did.
    """
    try:
        is_home = Path(__file__).parents[1].samefile(os.curdir)
    except OSError:  # the current folder was deleted
        is_home = False
    return dict(os.environ) if is_home else os.environ | {"PYTHONSAFEPATH": "1"}


serve = _program("v2v-serve", "v2v_server.commands.serve", "main", "server")
worker = _program("v2v-worker", "v2v_server.commands.worker", "main", "server")
simulate = _program("v2v-simulate", "v2v_server.commands.simulate", "main", "server")
preview = _program("v2v-preview", "v2v_server.commands.preview", "main", "server")
prepare = _program("v2v-prepare", "v2v_server.commands.prepare", "main", "server")
top = _program("v2v-top", "v2v_server.commands.top", "main", "server")
catalogue = _program("v2v-catalogue", "v2v_server.commands.catalogue", "main", "server")
quarantine = _program("v2v-quarantine", "v2v_server.commands.quarantine", "main", "server")
doctor = _program("v2v-doctor", "v2v_server.commands.doctor", "main", "server")
keys = _program("v2v-keys", "v2v_server.commands.keys", "main", "server")
tradeoff = _program("v2v-tradeoff", "v2v_server.commands.tradeoff", "main", "server")
fit = _program("v2v-fit", "v2v_server.commands.fit", "main", "server")
loadtest = _program("v2v-loadtest", "v2v_client.tools.loadtest", "main", "client")
train = _program("v2v-train", "trainer.train", "main", "trainer")
evaluate = _program("v2v-eval", "trainer.evaluation.cli", "main", "trainer")
convert = _program("v2v-convert", "trainer.convert.cli", "main", "convert")
