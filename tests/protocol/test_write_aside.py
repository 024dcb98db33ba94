"""Test that a file's name holds the old content or the complete new one."""

from __future__ import annotations

import os
import stat
from pathlib import Path

import pytest

from v2v_protocol.errors import UsageError
from v2v_protocol.write_aside import JSON, check_output, write_aside_and_rename, write_json


@pytest.mark.parametrize("durable", [False, True])
def test_the_name_has_the_old_content_until_the_block_ends(tmp_path: Path, durable: bool) -> None:
    path = tmp_path / "file"
    path.write_text("old")
    with write_aside_and_rename(path, durable=durable) as partial:
        partial.write_text("new")
        assert path.read_text() == "old"
        assert partial.parent == tmp_path
        assert partial.name.startswith(".")
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("written", [False, True])
def test_an_error_leaves_the_old_content_and_no_other_file(tmp_path: Path, written: bool) -> None:
    path = tmp_path / "file"
    path.write_text("old")
    with pytest.raises(ZeroDivisionError), write_aside_and_rename(path) as partial:
        _ = partial.write_text("half") / 0 if written else 1 / 0
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_file_that_cannot_be_renamed_is_removed(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    partial = tmp_path / "named"
    with pytest.raises(IsADirectoryError), write_aside_and_rename(tmp_path / "folder", partial=partial):
        partial.write_text("new")
    assert [path.name for path in tmp_path.iterdir()] == ["folder"]


def test_a_durable_file_is_flushed_before_it_is_renamed_and_its_folder_after(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, flushed = tmp_path / "file", []

    def fsync(descriptor: int) -> None:
        flushed.append((stat.S_ISDIR(os.fstat(descriptor).st_mode), path.exists()))

    monkeypatch.setattr(os, "fsync", fsync)
    with write_aside_and_rename(path, durable=True) as partial:
        partial.write_text("new")
    assert flushed == [(False, False), (True, True)]


def test_records_may_have_any_name_and_replace_records_only(tmp_path: Path) -> None:
    file = tmp_path / "scores"
    check_output("--json", file, JSON)
    write_json(file, [{"mse": 1.0}])
    check_output("--json", file, JSON)
    (tmp_path / "a.mp4").write_bytes(b"\0\0\0 ftyp")
    with pytest.raises(UsageError, match=r"a\.mp4: unknown ending; give a name that ends in \.json"):
        check_output("--json", tmp_path / "a.mp4", JSON)


def test_a_file_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=rf"--json {tmp_path}: cannot be written: Is a directory"):
        write_json(str(tmp_path), [])
