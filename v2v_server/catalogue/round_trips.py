"""Questions about many files, several at a time: each may be a round trip to storage elsewhere, most of it waiting.

The answers come in the order of the files, whichever was there first.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Q = TypeVar("Q")
A = TypeVar("A")

Notice = Callable[[str], None]
"""Told again and again what is being looked at, and how far that is."""

_AT_ONCE = 16
_TOGETHER = 64
"""Files that a thread asks about in one go: to hand them over one by one takes longer than a local disk's answer."""


def answers(question: Callable[[Q], A], files: Sequence[Q]) -> Generator[tuple[Q, A], None, None]:
    """(file, answer) for each file, in their order.

    Args:
        question: asked in threads; must not raise.
        files: what to ask it of.
    """
    parts = [files[start : start + _TOGETHER] for start in range(0, len(files), _TOGETHER)]

    def ask(part: Sequence[Q]) -> list[A]:
        return [question(file) for file in part]

    with ThreadPoolExecutor(min(_AT_ONCE, len(parts) or 1)) as threads:
        try:
            try:
                answered = threads.map(ask, parts)
            except RuntimeError:  # the system has no room for another thread: then one after the other
                threads.shutdown(cancel_futures=True)
                answered = map(ask, parts)
            for part, found in zip(parts, answered, strict=True):
                yield from zip(part, found, strict=True)
        finally:
            threads.shutdown(cancel_futures=True)
