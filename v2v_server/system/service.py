"""What a service needs of its host: an orderly stop, a file that states its address, the time of day."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

from v2v_protocol.errors import UsageError
from v2v_protocol.write_aside import write_aside_and_rename


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
    try:
        with write_aside_and_rename(Path(file)) as partial:
            partial.write_text(address + "\n", encoding="utf-8")
    except OSError as error:
        raise UsageError(f"--port-file {file}: {error.strerror}; give a file in a folder that you can write") from error


def utc_now() -> str:
    """Return the time of day, ISO 8601, UTC, in whole seconds."""
    return datetime.now(UTC).isoformat(timespec="seconds")
