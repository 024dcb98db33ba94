"""The folder that the cache and the copies of object storage fill: its limit, eviction, and free disk space."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path

import pytest

from v2v_server.store.quota import PARTIAL, QuotaFolder, count_bytes


@pytest.fixture
def quota(tmp_path: Path) -> QuotaFolder:
    made = QuotaFolder(tmp_path / "folder", 100, 0.0, 0)
    made.make()
    return made


def add(quota: QuotaFolder, name: str, size: int, *, evicts: bool = False) -> bool:
    """Add a file that is newer than all others."""
    partial = quota.folder / PARTIAL / name
    partial.write_bytes(bytes(size))
    path = quota.folder / "ab" / name
    added = quota.add(partial, path, evicts=evicts)
    if added:
        number = len(list(path.parent.iterdir()))
        os.utime(path, ns=(number, number))
    assert quota.used_bytes == count_bytes(quota.folder) <= 100
    return added


def names(quota: QuotaFolder) -> set[str]:
    return {path.name for path in (quota.folder / "ab").iterdir()}


def test_what_does_not_fit_is_not_added(quota: QuotaFolder) -> None:
    assert add(quota, "a", 60)
    assert not add(quota, "b", 41)
    assert add(quota, "c", 40)
    assert names(quota) == {"a", "c"}


def test_a_file_that_is_replaced_counts_once(quota: QuotaFolder) -> None:
    assert add(quota, "a", 60)
    assert add(quota, "a", 40)
    assert quota.used_bytes == 40
    quota.remove(quota.folder / "ab" / "a")
    assert quota.used_bytes == 0


def test_the_oldest_without_a_reader_goes(quota: QuotaFolder) -> None:
    for name in ("a", "b", "c"):
        assert add(quota, name, 30)
    with (quota.folder / "ab" / "a").open("rb") as reader:
        fcntl.flock(reader, fcntl.LOCK_SH)
        assert add(quota, "d", 30, evicts=True)
    assert names(quota) == {"a", "c", "d"}


def test_disk_space_that_others_need_is_freed(quota: QuotaFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("a", "b", "c"):
        assert add(quota, name, 10)
    quota.least_free_bytes = 70
    monkeypatch.setattr(QuotaFolder, "free_bytes", property(lambda self: 85 - count_bytes(self.folder)))
    assert add(quota, "d", 10, evicts=True)
    assert names(quota) == {"c", "d"}


def test_a_lock_that_another_process_keeps_is_not_waited_for(quota: QuotaFolder) -> None:
    with quota.locked(), pytest.raises(BlockingIOError, match="another process keeps it locked; end that process"):
        quota.remove(quota.folder / "ab" / "a")
