"""Which files changed: the same whoever asks, this process or several."""

from __future__ import annotations

from array import array
from pathlib import Path

import pytest

from v2v_server.catalogue import changed as module
from v2v_server.catalogue.changed import changed

COUNT = 700


@pytest.mark.parametrize("processes", [0, 1, 2])
def test_a_changed_a_missing_and_an_unknown_file_are_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, processes: int
) -> None:
    monkeypatch.setattr(module, "_FILES_A_PROCESS", 100)
    monkeypatch.setattr(module, "_TOGETHER", 64)
    ids, states = [f"{number:04d}.mp4" for number in range(COUNT)], array("q")
    for id in ids:
        (tmp_path / id).touch()
        status = (tmp_path / id).stat()
        states.extend((status.st_size, status.st_mtime_ns, status.st_ctime_ns))
    notices: list[str] = []
    assert changed(tmp_path, ids, states, processes, notices.append) == []
    assert notices[-1] == f"looking at files: {COUNT} of {COUNT}, 0 of them new or changed"
    assert len(notices) == -(-COUNT // 64)
    (tmp_path / ids[5]).write_bytes(b"x")
    (tmp_path / ids[699]).unlink()
    (tmp_path / ids[130]).chmod(0o600)  # which only the time of its change of status tells
    states[3 * 300] = -1
    (tmp_path / ids[301]).unlink()
    states[3 * 301 : 3 * 302] = array("q", [-1, 0, 0])  # never known, and not there either
    assert changed(tmp_path, ids, states, processes, None) == [5, 130, 300, 301, 699]
