"""What a service needs of its host: an orderly stop, a file that states its address, the time of day."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

from v2v_protocol.write_aside import write_file


@contextlib.contextmanager
def stop_on_signals(stop: threading.Event) -> Iterator[None]:
    """Set ``stop`` at the first SIGINT or SIGTERM; a second signal has its usual effect."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def on_signal(number: int, frame: object) -> None:
        for each, handler in before.items():
            signal.signal(each, handler)
        stop.set()

    for number in before:
        signal.signal(number, on_signal)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def write_port_file(file: str, address: str) -> None:
    """Write the address in one step, so that readers see the whole content or no file.

    Raises:
        UsageError: the file cannot be written.
    """
    write_file(Path(file), address + "\n", "--port-file")


def utc_now() -> str:
    """Return the time of day, ISO 8601, UTC, in whole seconds."""
    return datetime.now(UTC).isoformat(timespec="seconds")
