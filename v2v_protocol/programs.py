"""Entry points of the installed programs, and how they print. A program whose packages are missing says so in one line.
Programs that one starts run from the same installation. Text may come from files: it is printed without characters that
steer a terminal.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import TextIO

_OURS = frozenset({"v2v_protocol", "v2v_server", "v2v_client", "trainer"})

Program = Callable[[], int | None]
"""A function that returns the exit status; None is success."""


# C0 and C1 controls, separators of lines, what changes the direction of text (Unicode 16, UAX 9), and surrogates that
# stand for no byte.
_STEERING = re.compile(
    "[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ufeff\ud800-\udc7f\udd00-\udfff]"
)


def printable(text: str) -> str:
    """Return a line that can be shown: bytes that are not UTF-8, and control and bidirectional characters, escaped."""
    if text.isascii() and text.isprintable():  # as nearly all names are, and there may be a million of them
        return text
    text = _STEERING.sub(lambda found: found[0].encode("unicode_escape").decode(), text)
    return os.fsencode(text).decode("utf-8", "backslashreplace")


def show(text: str, stream: TextIO | None = None) -> None:
    """Print lines on standard output, or on another stream, without characters that steer a terminal."""
    print("\n".join(map(printable, text.split("\n"))), file=stream or sys.stdout, flush=True)


def open_standard_streams() -> None:
    """Open the null device in place of standard streams that are closed (``2>&-``). Otherwise the next file that the
    process opens takes their number, and gets what others print.
    """
    while (null := os.open(os.devnull, os.O_RDWR)) <= 2:
        os.set_inheritable(null, True)
    os.close(null)
    sys.stdout, sys.stderr = (each or open(os.devnull, "w") for each in (sys.stdout, sys.stderr))  # noqa: SIM115


def _program(name: str, module: str, function: str, extra: str) -> Program:
    """Return a program whose modules are imported when it runs.

    Args:
        name: name of the command.
        module, function: what it runs.
        extra: the extra of the distribution that installs its imports.
    """

    def run() -> int | None:
        try:
            status: int | None = getattr(import_module(module), function)()
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
