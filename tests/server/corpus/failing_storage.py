"""Storage that fails for a moment."""

from __future__ import annotations

import errno
import os
from typing import Any

import av
import pytest


def failing_opens(monkeypatch: pytest.MonkeyPatch, **times: int) -> dict[str, int]:
    """Lets FFmpeg find files unreadable.

    Args:
        monkeypatch: undoes it.
        times: by a file's name without its suffix, how many of its openings fail next.

    Returns:
        how many are still to fail.
    """
    open_file, left = av.open, dict(times)

    def opened(name: str, *more: Any, **options: Any) -> Any:
        stem = os.path.splitext(os.path.basename(name))[0]
        if left.get(stem, 0):
            left[stem] -= 1
            raise av.error.OSError(errno.EIO, os.strerror(errno.EIO), name)
        return open_file(name, *more, **options)

    monkeypatch.setattr(av, "open", opened)
    return left
