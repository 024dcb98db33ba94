"""Run a bench: ``python -m bench NAME [flags]``.

A bench is a module with a docstring, ``add_flags`` and ``measure``, and perhaps ``plot``; only the named one is
imported. ``IN_OWN_NETWORK = True`` runs it in its own network namespace. Exit status: 0 success, 1 a stated bar was
missed, 2 wrong usage or input, 130 interrupted.
"""

from __future__ import annotations

import ast
import signal
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from importlib import import_module
from pathlib import Path

from bench.cable import in_own_network
from bench.frame import parser_of, report
from v2v_protocol.command import WRONG_USAGE, Parser, run_command
from v2v_protocol.settings import nearest

_HERE = Path(__file__).parent
BENCHES = {
    "corpus": "corpus",
    "throughput": "speed.throughput",
    "kernel": "speed.kernel",
    "scaling": "speed.scaling",
    "catalogue": "speed.catalogue",
    "sharing": "speed.sharing",
    "pool": "speed.pool",
    "cache": "speed.cache",
    "store": "speed.store",
    "photographs": "speed.photographs",
    "sequences": "speed.sequences",
    "savings": "speed.savings",
    "link": "speed.link",
    "step": "speed.step",
    "evt3": "speed.evt3",
    "whole": "speed.whole",
    "recorded": "speed.recorded",
    "physics": "accuracy.physics",
    "motion": "speed.motion",
    "substeps": "accuracy.substeps",
    "worlds": "accuracy.worlds",
    "fit": "accuracy.fit",
    "sensor": "accuracy.sensor",
    "noise": "accuracy.noise",
    "scene": "accuracy.scene",
    "defects": "accuracy.defects",
    "flow": "accuracy.flow",
    "learn": "accuracy.learn",
    "learn_flow": "accuracy.learn_flow",
    "recordings": "accuracy.recordings",
    "tradeoff": "accuracy.tradeoff",
    "chaos": "chaos.chaos",
    "chaos_across": "chaos.across",
    "siege": "chaos.siege",
    "soak": "chaos.soak",
    "fuzz": "chaos.fuzz",
}
"""Module of each bench, below this package."""


def parser_for(name: str) -> Parser:
    """Return the parser of a bench."""
    return parser_of(name, import_module(f"bench.{BENCHES[name]}"))


def usage() -> str:
    """Return the list of benches, read from the source: no bench is imported."""
    sources = {name: _HERE.joinpath(*module.split(".")).with_suffix(".py") for name, module in BENCHES.items()}
    titles = {name: ast.get_docstring(ast.parse(source.read_text("utf-8"))) or "" for name, source in sources.items()}
    lines = (f"  {name:13s} {title.partition(chr(10))[0]}" for name, title in titles.items())
    return "\n".join(["usage: python -m bench NAME [flags]     python -m bench NAME --help", "", *lines])


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the bench that the command line names; return the exit status."""
    name, *rest = list(sys.argv[1:] if arguments is None else arguments) or ["--help"]
    if name in ("-h", "--help"):
        print(usage())
        return 0
    if name not in BENCHES:
        known = ", ".join(BENCHES)
        print(f"python -m bench: no bench {name!r}{nearest(name, BENCHES)}; known: {known}", file=sys.stderr)
        return WRONG_USAGE
    bench = import_module(f"bench.{BENCHES[name]}")
    work = partial(report, bench)
    if getattr(bench, "IN_OWN_NETWORK", False):
        work = partial(in_own_network, work, [name, *rest])
    with _exit_on_sigterm():
        return run_command(parser_for(name), work, rest)


@contextmanager
def _exit_on_sigterm() -> Iterator[None]:
    """Turn SIGTERM into SystemExit, so that the processes that a bench started are stopped."""
    before = signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


if __name__ == "__main__":
    sys.exit(main())
