"""Put off Ctrl-C and SIGTERM until a file is in a state to be left."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator


@contextlib.contextmanager
def late_signals() -> Iterator[Callable[[], None]]:
    """Yield a function that raises KeyboardInterrupt if a Ctrl-C or SIGTERM has come; it comes at no other place.

    Python would raise it in the functions by which HDF5 writes, and HDF5 then ends the process.

    Raises:
        KeyboardInterrupt: at the end of the block too.
    """
    came: list[int] = []
    is_main = threading.current_thread() is threading.main_thread()
    numbers = (signal.SIGINT, signal.SIGTERM) if is_main else ()
    before = {number: signal.signal(number, lambda number, _: came.append(number)) for number in numbers}

    def check() -> None:
        if came:
            raise KeyboardInterrupt

    try:
        yield check
        check()
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
