"""Which files are new or changed since the index was written."""

from __future__ import annotations

import os
from contextlib import closing
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from v2v_server.corpus import catalogue as refresh
from v2v_server.corpus.index import IndexRow, Store
from v2v_server.corpus.sources.folder import Folder
from v2v_server.corpus.sources.source import silent

COUNT = 700


@pytest.fixture
def ids(tmp_path: Path) -> list[str]:
    ids = [f"{number:04d}.mp4" for number in range(COUNT)]
    for id in ids:
        (tmp_path / id).touch()
    return ids


def test_a_changed_a_missing_and_an_unknown_file_are_found(tmp_path: Path, ids: list[str]) -> None:
    def states(*unknown: int) -> npt.NDArray[np.int64]:
        rows = []
        for number, id in enumerate(ids):
            status = (tmp_path / id).stat()
            size = -1 if number in unknown else status.st_size
            rows.append((size, status.st_mtime_ns, status.st_ctime_ns))
        return np.array(rows)

    notices: list[str] = []
    assert refresh._changed(Folder(tmp_path), ids, states(), notices.append) == []
    assert notices[-1] == f"looking at files in {tmp_path}: {COUNT} of {COUNT}, 0 of them new or changed"
    known = states(300, 301)
    (tmp_path / ids[5]).write_bytes(b"x")
    (tmp_path / ids[130]).chmod(0o600)  # changes only the ctime
    (tmp_path / ids[301]).unlink()
    (tmp_path / ids[699]).unlink()
    assert refresh._changed(Folder(tmp_path), ids, known, notices.append) == [5, 130, 300, 301, 699]
    assert notices[-1] == f"looking at files in {tmp_path}: {COUNT} of {COUNT}, 5 of them new or changed"


def test_a_record_that_another_process_removes_meanwhile_is_no_video(
    tmp_path: Path, ids: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    index, put = tmp_path / "index", Store.put

    def put_and_lose(store: Store, records: list[IndexRow]) -> None:
        put(store, records)
        with closing(Store(index)) as other:
            other.forget([ids[0]])

    monkeypatch.setattr(Store, "put", put_and_lose)
    store, table, notes = refresh.refresh_index(Folder(tmp_path), ids[:3], index, None, 0, silent, silent)
    store.close()
    assert notes == []
    assert table.problem[0] == "the index lost its record; start again to probe it"
    assert "lost" not in table.problem[1]


@pytest.fixture
def reads(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Receives a line whenever the rows of an index are read."""
    lines: list[str] = []
    rows = Store.rows
    monkeypatch.setattr(Store, "rows", lambda store, kind: lines.append(os.fspath(store.path)) or rows(store, kind))
    return lines


def test_the_index_is_read_once_if_nothing_changed(tmp_path: Path, ids: list[str], reads: list[str]) -> None:
    index = tmp_path / "index"
    for expected in (2, 1):
        reads.clear()
        store, table, _ = refresh.refresh_index(Folder(tmp_path), ids[:3], index, None, 0, silent, silent)
        store.close()
        assert len(table) == 3
        assert len(reads) == expected
