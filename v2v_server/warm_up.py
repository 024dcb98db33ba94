"""The kernels of a worker at its start: one process compiles them, the others load what it has left in the cache.

Compiling takes tens of seconds of processor time. Workers that are all started at once on a new host would each spend
them, since none finds the work of another. So the first takes a lock, which the operating system gives back should it
die, and the others wait. Once everything is in the cache a file there says so, and nobody takes the lock any more.

Both are hints. If that file is wrong, because somebody has emptied the cache around it, or if there are no locks on
that file system, or the holder of the lock does not get on, each process compiles for itself.

The compiler needs about 90 MB that it never gives back. They go with the child process in which it runs.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from importlib import import_module
from pathlib import Path
from typing import Any

from v2v_server.compile_cache import sources_digest
from v2v_server.process import die_with_parent
from v2v_server.simulation.clip import warm_up
from v2v_server.simulation.pixel import simulate_pixels

_LONGEST_WAIT_SECONDS = 300.0
_POLL_SECONDS = 0.1


def warm_up_in_turn() -> None:
    """Loads the kernels; before that, compiles them or waits for another process that does."""
    kernel: Any = simulate_pixels
    # Numba keeps apart what was compiled by other Pythons and for other processors, and so do we.
    processor = kernel.targetctx.codegen().magic_tuple()
    key = repr((sources_digest(), sys.implementation.cache_tag, processor))
    folder = Path(kernel.stats.cache_path)
    with one_compiles(folder, hashlib.sha256(key.encode()).hexdigest()[:12]) as is_to_compile:
        if is_to_compile:
            # Should it fail, so will the next line, or it does the work.
            subprocess.run([sys.executable, "-m", __name__, str(os.getpid())], stdin=subprocess.DEVNULL, check=False)
        load_kernels()


def load_kernels() -> None:
    """Loads from the cache, or compiles, what every worker runs."""
    warm_up()
    import_module("v2v_server.simulation.full_range")  # importing it compiles, or loads, what is in it


@contextmanager
def one_compiles(folder: Path, key: str, longest_wait_seconds: float = _LONGEST_WAIT_SECONDS) -> Iterator[bool]:
    """What is done inside is done by one process at a time until one has come to its end; after that by all at once.

    Args:
        folder: the cache.
        key: names what is compiled; another key has another lock.
        longest_wait_seconds: after that we no longer wait for the others.

    Yields:
        whether none is known to have come to its end.
    """
    complete = folder / f"{key}.complete"
    with ExitStack() as turn:
        if not complete.exists():
            turn.enter_context(_lock(folder / f"{key}.lock", longest_wait_seconds))
        is_first = not complete.exists()
        if not is_first:
            turn.close()
        yield is_first
        with suppress(OSError):  # a full disk, a folder of another user: then the next process takes the lock again
            complete.touch()


@contextmanager
def _lock(path: Path, longest_wait_seconds: float) -> Iterator[None]:
    """Holds a lock on the file, or none after that time or where there are no locks."""
    try:
        file = path.open("ab")
    except OSError:
        yield
        return
    with file:
        give_up = time.monotonic() + longest_wait_seconds
        while True:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                if time.monotonic() < give_up:
                    time.sleep(_POLL_SECONDS)
                    continue
            except OSError:
                pass  # no locks on this file system
            break
        yield


if __name__ == "__main__":
    die_with_parent(int(sys.argv[1]))
    load_kernels()
