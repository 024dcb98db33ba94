"""Records on disk: what is read back is what was written, and a file that cannot be is named in one line."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from v2v_protocol.errors import UsageError
from v2v_protocol.write_aside import write_json


def test_records_are_read_back(tmp_path: Path) -> None:
    records = [{"name": "é", "seconds": 0.1, "kept": None}, {"name": "", "seconds": 2, "kept": True}]
    write_json(tmp_path / "out.json", records)
    assert json.loads((tmp_path / "out.json").read_text(encoding="utf-8")) == records


def test_a_file_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=rf"--json {tmp_path}: cannot be written: Is a directory"):
        write_json(str(tmp_path), [])
