"""The kernels of a worker: one process compiles them, the others load what it has left in the cache.

Compiling takes tens of seconds of processor time. Workers that are all started at once on a new host would each spend
them, since none finds the work of another. So the first takes a lock, which the operating system gives back should it
die, and the others wait. Once everything is in the cache a file there says so, and nobody takes the lock any more.

Both are hints. If that file is wrong, because somebody has emptied the cache around it, or if there are no locks on
that file system, or the holder of the lock does not get on, each process compiles for itself.

The compiler needs about 90 MB that it never gives back. They go with the child process in which it runs.

Kernels that only some streams need (``simulation/variants.py``) are had in the same way, when the first of them comes.
By then a worker is confined (:mod:`v2v_server.system.sandbox`) and may start no process: the one whose turn it is
compiles in its own memory.
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

from v2v_server.simulation.pixel import simulate_pixels
from v2v_server.simulation.variants import Variant, load, warm_up
from v2v_server.system.compile_cache import sources_digest
from v2v_server.system.process import die_with_parent

_LONGEST_WAIT_SECONDS = 300.0
_POLL_SECONDS = 0.1


def warm_up_in_turn() -> None:
    """Load what every worker runs; before that, compiles it or waits for another process that does."""
    with one_compiles(*_place()) as is_to_compile:
        if is_to_compile:
            _compile_apart()
        load_kernels()


def load_in_turn(variant: Variant) -> None:
    """The same for a variant of the kernels that is not among the usual ones."""
    with one_compiles(*_place(variant)) as is_to_compile:
        if is_to_compile:
            print(f"compiling the kernel for {variant}, once on this host", file=sys.stderr, flush=True)
            _compile_apart(*map(str, (variant.voxel_dtype, int(variant.effects), variant.precision)))
        load(variant)


def is_compiled(variant: Variant) -> bool:
    """Whether a process is known to have compiled it, so that to load it takes no time to speak of."""
    folder, key = _place(variant)
    return _mark(folder, key).exists()


def load_kernels() -> None:
    """Load from the cache, or compiles, what every worker runs."""
    warm_up()
    import_module("v2v_server.video.full_range")  # importing it compiles, or loads, what is in it


def _place(variant: Variant | None = None) -> tuple[Path, str]:
    """Where the compiled code is kept, and a name for what is compiled."""
    kernel: Any = simulate_pixels
    # Numba keeps apart what was compiled by other Pythons and for other processors, and so do we.
    processor = kernel.targetctx.codegen().magic_tuple()
    key = repr((sources_digest(), sys.implementation.cache_tag, processor, *(variant or ())))
    return Path(kernel.stats.cache_path), hashlib.sha256(key.encode()).hexdigest()[:12]


def _compile_apart(*variant: str) -> None:
    """Compile in a child process. Should that fail, so will the caller's loading, or it does the work."""
    command = [sys.executable, "-m", __name__, str(os.getpid()), *variant]
    with suppress(PermissionError):  # a confined worker starts no program: its loading compiles, and keeps the memory
        subprocess.run(command, stdin=subprocess.DEVNULL, check=False)


def _mark(folder: Path, key: str) -> Path:
    return folder / f"{key}.complete"


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
    complete = _mark(folder, key)
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
    """Hold a lock on the file, or none after that time or where there are no locks."""
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
    if asked := sys.argv[2:]:
        load(Variant(asked[0], asked[1] == "1", asked[2]))
    else:
        load_kernels()
