"""Locks on files that processes share."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest

from v2v_server.system.process import lock


def test_one_holder_at_a_time(tmp_path: Path) -> None:
    path = tmp_path / "lock"
    with path.open("wb") as first, path.open("wb") as second:
        lock(first.fileno(), 0.0, path)
        with pytest.raises(BlockingIOError, match="another process keeps it locked; end that process") as raised:
            lock(second.fileno(), 0.0, path)
        assert raised.value.filename == path
        first.close()
        lock(second.fileno(), 0.0, path)


def test_a_lock_that_is_released_in_time_is_waited_for(tmp_path: Path) -> None:
    path = tmp_path / "lock"
    with path.open("wb") as first, path.open("wb") as second:
        lock(first.fileno(), 0.0, path)
        waiter = threading.Thread(target=lock, args=(second.fileno(), 60.0, path))
        waiter.start()
        first.close()
        waiter.join(60.0)
        assert not waiter.is_alive()
