"""``v2v-bench NAME ...``: one command for everything that measures.

A benchmark is a module of this package with a ``main``; it is imported only when asked for, so that one benchmark does
not need the packages of another. ``v2v-bench NAME --help`` shows its flags. Exit status: 0 success, 1 a stated bar of
the benchmark missed, 2 wrong usage or input, 130 interrupted.
"""

from __future__ import annotations

import ast
import importlib
import signal
import sys
import textwrap
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from v2v_protocol.command import INTERRUPTED, WRONG_USAGE, version_of
from v2v_protocol.errors import V2VError
from v2v_protocol.settings import nearest

_LINE_WIDTH = 104
_HERE = Path(__file__).parent

BENCHMARKS = {
    "throughput": "speed.throughput",
    "kernel": "speed.kernel",
    "transport": "speed.transport",
    "scaling": "speed.scaling",
    "fleet": "fleet.fleet",
    "gpu_feed": "speed.gpu_feed",
    "released": "speed.released",
    "watched": "speed.watched",
    "link": "link.slow",
    "curve": "link.curve",
    "step": "step",
    "cache": "cache",
    "store": "tradeoff.store",
    "tradeoff": "tradeoff.tradeoff",
    "training_trade": "tradeoff.training_trade",
    "matters": "tradeoff.matters",
    "flow": "accuracy.flow",
    "physics": "accuracy.physics",
    "sensor": "accuracy.sensor",
    "extremes": "accuracy.extremes",
    "scene": "accuracy.scene",
    "learn": "accuracy.learn",
    "chaos": "chaos.chaos",
    "chaos_across": "link.across",
    "chaos_check": "chaos.check",
    "siege": "chaos.siege",
    "soak": "chaos.soak",
    "fuzz": "fuzz.fuzz",
    "limits": "limits",
    "catalogue": "catalogue",
    "corpus": "corpus",
}
"""Module of each benchmark, below this package."""

_EXAMPLES = ("examples:", "  v2v-bench throughput --videos clips/", "  v2v-bench kernel --json kernel.json")


def names() -> dict[str, str]:
    """What can be run: name and beginning of its docstring, read from the source without importing anything."""
    found = {}
    for name, module in BENCHMARKS.items():
        tree = ast.parse(_HERE.joinpath(*module.split(".")).with_suffix(".py").read_text(encoding="utf-8"))
        paragraph = (ast.get_docstring(tree) or "").split("\n\n")[0]
        found[name] = textwrap.shorten(paragraph, _LINE_WIDTH, placeholder=" ...")
    return found


def usage() -> str:
    """The list of benchmarks."""
    lines = [f"  {name:14s} {line}" for name, line in names().items()]
    return "\n".join(["usage: v2v-bench NAME [flags]     v2v-bench NAME --help", "", *lines, "", *_EXAMPLES])


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line."""
    name, *rest = list(sys.argv[1:] if arguments is None else arguments) or ["--help"]
    if name in ("-h", "--help"):
        print(usage())
        return 0
    if name == "--version":
        print(version_of("v2v-bench"))
        return 0
    if name not in BENCHMARKS:
        near, known = nearest(name, BENCHMARKS), ", ".join(BENCHMARKS)
        print(f"v2v-bench: no benchmark {name!r}{near}; known: {known}", file=sys.stderr)
        return WRONG_USAGE
    # Each main reads the command line itself, the way it does as a module of its own.
    before, sys.argv = sys.argv, [f"v2v-bench {name}", *rest]
    try:
        with _ended_by_sigterm():
            status = importlib.import_module(f"bench.{BENCHMARKS[name]}").main()
    except (V2VError, OSError) as error:  # of a result that was printed and cannot be written, say
        print(f"v2v-bench {name}: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"v2v-bench {name}: interrupted", file=sys.stderr)
        return INTERRUPTED
    finally:
        sys.argv = before
    return int(status)


@contextmanager
def _ended_by_sigterm() -> Iterator[None]:
    """A SIGTERM ends a benchmark as an exception does, so that everything that was started is ended too."""
    before = signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


if __name__ == "__main__":
    sys.exit(main())
