"""Entry points of the installed programs, and how they print. A program whose packages are missing says so in one line.
Programs that one starts run from the same installation. Text may come from files: it is printed without characters that
steer a terminal.
"""

from __future__ import annotations

import json
import os
import re
import shlex
import signal
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TextIO
from urllib.parse import unquote, urlsplit

from v2v_protocol import NUMERICS_VERSION, PROTOCOL_VERSION, __version__
from v2v_protocol.settings import nearest

_OURS = frozenset({"v2v_protocol", "v2v_server", "v2v_tools", "v2v_client", "trainer"})

Program = Callable[[], int | None]
"""A function that returns the exit status; None is success."""
COMPLETION = "V2V_COMPLETION"
"""Variable of the environment that asks for a shell's completion script in place of the command."""


_OF_V2V = {
    "bash": r"""
_v2v() {
  if ((COMP_CWORD == 1)); then
    mapfile -t COMPREPLY < <(compgen -W "NAMES" -- "${COMP_WORDS[1]}")
  else
    COMP_WORDS=("v2v-${COMP_WORDS[1]}" "${COMP_WORDS[@]:2}")
    ((COMP_CWORD--))
    local function="_shtab_${COMP_WORDS[0]//-/_}"
    declare -F "$function" > /dev/null && "$function"
  fi
}
complete -o bashdefault -F _v2v v2v""",
    "zsh": r"""
_v2v() {
  if ((CURRENT == 2)); then
    compadd NAMES
  else
    shift words
    words[1]="v2v-$words[1]"
    ((CURRENT--))
    _normal
  fi
}
compdef _v2v v2v""",
}
"""How a shell completes `v2v`: the name of a command, then as that command's own script does."""


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


def counted(number: int, noun: str, nouns: str = "") -> str:
    """Return a number with its noun: "1 video", "2 videos".

    Args:
        nouns: the plural, and the verb if ``noun`` has one; by default the noun with an s.
    """
    return f"{number} {noun if number == 1 else nouns or f'{noun}s'}"


def name_extra(needs: str, package: str, extra: str) -> str:
    """Return a message that names the missing package and how to install it.

    Args:
        needs: what needs it.
        package: name of the module that could not be imported.
        extra: extra of the distribution that brings it.
    """
    return (
        f"{needs} needs the Python package {package.partition('.')[0]}, which is not installed; the extra '{extra}' "
        f"brings it: {install_line(extra)}"
    )


def install_line(extras: str) -> str:
    """Return the command that installs extras of this distribution, from where it was installed: a package index, a
    wheel or a checkout (``direct_url.json`` of PEP 610).

    Args:
        extras: names of extras, with commas between them.
    """
    from importlib import metadata  # only an error needs it, and it imports much

    wanted = f"v2v-stream[{extras}]"
    with suppress(metadata.PackageNotFoundError):
        origin = json.loads(metadata.distribution("v2v-stream").read_text("direct_url.json") or "{}")
        if origin.get("dir_info", {}).get("editable"):
            folder = unquote(urlsplit(origin["url"]).path)
            return f"pip install --editable {shlex.quote(f'{folder}[{extras}]')}"
        if origin:
            system = origin.get("vcs_info", {}).get("vcs")
            wanted += f" @ {system}+{origin['url']}" if system else f" @ {origin['url']}"
    return f"pip install {shlex.quote(wanted)}"


def version_of(name: str) -> str:
    """Return the version line of a command: versions of the program, the protocol and the numerics."""
    return f"{name} {__version__} (protocol {PROTOCOL_VERSION}, numerics {NUMERICS_VERSION})"


def show(text: str, stream: TextIO | None = None) -> None:
    """Print lines on standard output, or on another stream, without characters that steer a terminal.

    Raises:
        SystemExit: what reads the stream has left, as ``head`` does; with the status of a program that SIGPIPE ends.
    """
    stream = stream or sys.stdout
    try:
        print("\n".join(map(printable, text.split("\n"))), file=stream, flush=True)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())  # what is still in its buffer goes there at the end
        raise SystemExit(128 + signal.SIGPIPE) from None


def open_standard_streams() -> None:
    """Open the null device in place of standard streams that are closed (``2>&-``). Otherwise the next file that the
    process opens takes their number, and gets what others print.
    """
    while (null := os.open(os.devnull, os.O_RDWR)) <= 2:
        os.set_inheritable(null, True)
    os.close(null)
    sys.stdout, sys.stderr = (each or open(os.devnull, "w") for each in (sys.stdout, sys.stderr))  # noqa: SIM115


def _run(name: str) -> int | None:
    """Run a program of :data:`COMMANDS`, whose modules are imported now; return its exit status."""
    module, extra, _ = COMMANDS[name]
    before = signal.getsignal(signal.SIGINT)
    if before is signal.default_int_handler:
        signal.signal(signal.SIGINT, partial(_end_at_once, f"v2v-{name}"))
    try:
        main = import_module(module).main
        signal.signal(signal.SIGINT, before or signal.SIG_DFL)
        status: int | None = main()
    except KeyboardInterrupt:  # while the command line is read; the command itself answers it
        _end_at_once(f"v2v-{name}")
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package in _OURS:
            raise
        if os.environ.get(COMPLETION):
            return None  # a shell completes the commands that are installed
        print(name_extra(f"v2v-{name}:", package, extra), file=sys.stderr)
        return 2
    return status


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


def __getattr__(name: str) -> Program:
    """Return a program by its name, with ``evaluate`` for ``v2v-eval``."""
    name = {"evaluate": "eval"}.get(name, name)
    if name not in COMMANDS:
        raise AttributeError(f"there is no program {name!r}")
    return partial(_run, name)


def v2v() -> int | None:
    """Run ``v2v``: list the commands, run one of them, or print completions for a shell."""
    name, *rest = sys.argv[1:] or ["--help"]
    if name in COMMANDS:
        sys.argv = [f"v2v-{name}", *rest]
        return _run(name)
    if name == "completion" and rest in (["bash"], ["zsh"]):
        os.environ[COMPLETION] = rest[0]
        failed = any(map(_run, COMMANDS))
        print("" if failed else _OF_V2V[rest[0]].replace("NAMES", " ".join(COMMANDS)))
        return 2 if failed else 0
    if name in ("-h", "--help"):
        print(_USAGE)
        return 0
    if name == "--version":
        print(version_of("v2v"))
        return 0
    print(f"v2v: unknown command {name!r}{nearest(name, COMMANDS)}; v2v --help lists the commands", file=sys.stderr)
    return 2


_GROUPS: dict[str, dict[str, tuple[str, str, str]]] = {
    "Look at videos": {
        "preview": ("v2v_tools.preview", "server", "draw what a recipe makes of videos"),
        "simulate": ("v2v_tools.simulate", "server", "write one sample to a file, its events too"),
        "doctor": ("v2v_tools.doctor.command", "server", "check installation, machine and videos"),
        "fit": ("v2v_tools.fit.command", "server", "fit a virtual camera to a recording, or measure one"),
    },
    "Stream": {
        "serve": ("v2v_server.commands.serve", "server", "stream samples to trainers"),
        "worker": ("v2v_server.commands.worker", "server", "work for a server on another host"),
        "top": ("v2v_server.commands.top", "server", "show a running server on a terminal"),
        "loadtest": ("v2v_client.loadtest", "client", "measure how fast a server feeds a trainer"),
    },
    "Manage a corpus": {
        "prepare": ("v2v_server.commands.prepare", "server", "decode videos once, into a store that reads fast"),
        "tradeoff": ("v2v_tools.tradeoff.command", "server", "compare speed, disk space and accuracy"),
        "catalogue": ("v2v_server.commands.catalogue", "server", "catalogue videos ahead of time"),
        "quarantine": ("v2v_server.commands.quarantine", "server", "list what crashed workers, or clear the list"),
        "keys": ("v2v_server.commands.keys", "server", "create and revoke the keys of a server"),
    },
    "Train": {
        "train": ("trainer.train", "trainer", "train a network on the stream"),
        "eval": ("trainer.evaluation.cli", "trainer", "score a network on recordings"),
        "convert": ("trainer.convert.cli", "convert", "convert recordings for v2v-eval"),
    },
}
COMMANDS = {name: command for group in _GROUPS.values() for name, command in group.items()}
"""Module, extra of the distribution that installs its imports, and purpose of each ``v2v-NAME``."""
_USAGE = "\n".join([
    "usage: v2v COMMAND [flags]   or   v2v-COMMAND [flags];   v2v COMMAND --help explains one",
    *(
        line
        for title, group in _GROUPS.items()
        for line in (f"\n{title}:", *(f"  {name:12s}{says}" for name, (_, _, says) in group.items()))
    ),
    "\nTab completion: eval \"$(v2v completion bash)\", or zsh",
])  # fmt: skip

if __name__ == "__main__":
    sys.exit(v2v())
