"""Load a worker's kernels: one process compiles them, the others load them from the cache.

Compiling takes tens of seconds of processor time. Workers that start together on a new host would each spend it,
because none finds the results of another. So the first takes a lock, which the operating system releases if it dies,
and the others wait. Once everything is in the cache, a marker file there says so, and the lock is not taken any more.

Both are hints. Each process compiles for itself if the marker file is wrong (the cache was emptied), if the file system
has no locks, or if the holder of the lock makes no progress.

The compiler needs about 90 MB that it never frees. This memory goes with the child process that compiles.

Kernels that only some streams need (``simulation/precision.py``) are compiled in the same way when they are first
needed. By then a worker is confined (:mod:`v2v_server.system.sandbox`) and cannot start a process, so it compiles in
its own memory.
"""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from importlib import import_module
from pathlib import Path
from typing import Any

from v2v_server.motion import load as load_motion
from v2v_server.simulation.forms import load, warm_up
from v2v_server.simulation.pixel import simulate_pixels
from v2v_server.simulation.precision import Variant
from v2v_server.system.compile_cache import sources_digest
from v2v_server.system.process import die_with_parent, locked
from v2v_server.worlds.clip import load as load_worlds

_LONGEST_WAIT_SECONDS = 300.0


def warm_up_in_turn() -> None:
    """Load the kernels that every worker runs, after compiling them or waiting for another process that does."""
    with one_compiles(_mark()) as is_to_compile:
        if is_to_compile:
            _compile_apart()
        load_kernels()


def load_in_turn(variant: Variant) -> None:
    """Load one variant of the kernels in the same way."""
    with one_compiles(_mark(variant)) as is_to_compile:
        if is_to_compile:
            print(f"compiling the kernel for {variant}, once on this host", file=sys.stderr, flush=True)
            _compile_apart(json.dumps(variant))
        _load(variant)


def is_compiled(variant: Variant) -> bool:
    """Return whether a variant is known to be compiled, so that loading it is quick."""
    return _mark(variant).exists()


def _load(variant: Variant) -> None:
    load(variant)
    if variant.is_divided:
        load_motion()
    if variant.is_rendered:
        load_worlds()


def load_kernels() -> None:
    """Load the kernels that every worker runs from the cache; compile those that are missing."""
    with _without_scipy():
        warm_up()
    import_module("v2v_server.video.levels")  # importing it compiles or loads its functions


@contextmanager
def _without_scipy() -> Iterator[None]:
    """Make numba find no ``scipy.linalg``. It imports it for linear algebra, which no kernel uses, in a third of the
    time.
    """
    if "scipy.linalg" in sys.modules:
        yield
        return
    sys.modules["scipy.linalg"] = None  # type: ignore[assignment]
    try:
        yield
    finally:
        del sys.modules["scipy.linalg"]


def _mark(variant: Variant | None = None) -> Path:
    """Return the file that says, beside the compiled code, that compiling it was completed."""
    kernel: Any = simulate_pixels
    # As Numba does, separate code compiled by other Pythons or for other processors.
    processor = kernel.targetctx.codegen().magic_tuple()
    key = repr((sources_digest(), sys.implementation.cache_tag, processor, *(variant or ())))
    return Path(kernel.stats.cache_path, f"{hashlib.sha256(key.encode()).hexdigest()[:12]}.complete")


def _compile_apart(*variant: str) -> None:
    """Compile in a child process. If that fails, loading in the caller compiles, or fails with the reason."""
    command = [sys.executable, "-m", __name__, str(os.getpid()), *variant]
    with suppress(PermissionError):  # a confined worker cannot start programs; loading then compiles
        subprocess.run(command, stdin=subprocess.DEVNULL, check=False)


@contextmanager
def one_compiles(complete: Path, longest_wait_seconds: float = _LONGEST_WAIT_SECONDS) -> Iterator[bool]:
    """Let one process at a time run the body until one has completed it; later ones run it without a lock.

    Args:
        complete: the file that says that it is completed, in the folder of the cache; each has its own lock.
        longest_wait_seconds: longest wait for other processes.

    Yields:
        whether no process is known to have completed it.
    """
    with ExitStack() as turn:
        if not complete.exists():
            # A folder of another user, a file system without locks, or a wait that is over: compile without one.
            with suppress(OSError):
                turn.enter_context(locked(complete.with_suffix(".lock"), longest_wait_seconds))
        is_first = not complete.exists()
        if not is_first:
            turn.close()
        yield is_first
        with suppress(OSError):  # full disk or folder of another user: the next process takes the lock again
            complete.touch()


if __name__ == "__main__":
    die_with_parent(int(sys.argv[1]))
    if asked := sys.argv[2:]:
        _load(Variant(*json.loads(asked[0])))
    else:
        load_kernels()
