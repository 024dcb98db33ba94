"""A clean end on Ctrl-C, on SIGTERM, at a time limit or without data: after the same step on all ranks.

The signal handler only sets a flag, so a step is never interrupted. While the loop waits for data, which may never come
(the same Ctrl-C reaches a server in the same terminal), the handler ends the wait.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterable, Iterator
from types import FrameType
from typing import TypeVar

from v2v_protocol.errors import V2VError

_Item = TypeVar("_Item")

_LAUNCHED = "TORCHELASTIC_RUN_ID"
"""Variable of the environment that torchrun sets. It forwards the Ctrl-C that its processes already had from the
terminal, so two signals may be one Ctrl-C."""


class _StopWaiting(BaseException):
    """Ends the wait for data. Not an Exception, so that no handler of errors catches it."""


class StopRequest:
    """A request to end the run, from ``with`` on (in the main thread).

    The second signal ends the process as if there were no handler; under torchrun the third one does.

    Args:
        seconds: end after this time; 0: no limit.
        agree: returns whether any rank wants to end; all ranks call it once per step.

    Attributes:
        signal: number of the first signal; 0 without one.
        failure: the error that ended the data, to be raised when everything is saved; None without one.
    """

    def __init__(self, seconds: float = 0.0, agree: Callable[[bool], bool] = bool) -> None:
        self.signal = 0
        self.failure: V2VError | None = None
        self._left = 2 if _LAUNCHED in os.environ else 1
        self._waiting = False
        self._agree = agree
        self._deadline = time.monotonic() + seconds if seconds else None

    def __enter__(self) -> StopRequest:
        self._before = {number: signal.signal(number, self._handle) for number in (signal.SIGINT, signal.SIGTERM)}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _handle(self, number: int, _frame: FrameType | None) -> None:
        self.signal = self.signal or number
        self._left -= 1
        if self._left < 0:
            signal.signal(number, signal.SIG_DFL)
            signal.raise_signal(number)
        if self._waiting:
            self._waiting = False  # raises once: what follows on the way out must not be cut short
            raise _StopWaiting

    @property
    def wanted(self) -> bool:
        """Return whether this rank wants to end."""
        if self.signal or self.failure is not None:
            return True
        return self._deadline is not None and time.monotonic() >= self._deadline

    def next(self, items: Iterator[_Item]) -> _Item | None:
        """Return the next item; None at the end, or if a signal came while waiting for it."""
        try:
            try:
                self._waiting = True
                return next(items, None)
            finally:
                self._waiting = False
        except _StopWaiting:
            return None

    def until(self, items: Iterable[_Item]) -> Iterator[_Item]:
        """Yield the items until the end, or until any rank wants to end or has no data.

        All ranks must have the same number of items.
        """
        iterator = iter(items)
        while True:
            item = None
            try:
                item = None if self.wanted else self.next(iterator)
            except V2VError as error:
                self.failure = error
            except (RuntimeError, EOFError, OSError):
                # The signal reached the loader workers too: PyTorch raises that one exited, or that its pipe ended.
                if not self.signal:
                    raise
            if self._agree(self.wanted) or item is None:
                return
            yield item
