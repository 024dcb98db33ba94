"""`v2v-worker`: which corpus it is given."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from v2v_server.commands.worker import main as worker
from v2v_server.system.log import Log


def test_it_takes_as_videos_what_the_server_takes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    roots: list[Any] = []
    monkeypatch.setattr(
        "v2v_server.commands.worker.run_worker", lambda address, source, *more: roots.append(source.folder)
    )
    (tmp_path / "clip.mp4").touch()
    (tmp_path / "list.txt").touch()
    for source in (tmp_path, tmp_path / "clip.mp4", tmp_path / "list.txt"):
        worker(["--connect", "tcp://127.0.0.1:1", "--videos", str(source)])
    assert roots == [tmp_path.resolve()] * 3


def test_a_corpus_that_is_not_there_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert worker(["--connect", "tcp://127.0.0.1:1", "--videos", str(tmp_path / "missing")]) == 2
    assert "there is no such folder, video or list file on this host" in capsys.readouterr().err


def test_its_log_is_for_people_or_for_programs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    logs: list[Any] = []
    monkeypatch.setattr(
        "v2v_server.commands.worker.run_worker",
        lambda *given: logs.extend(each for each in given if isinstance(each, Log)),
    )
    for flags in ([], ["--log-format", "json"]):
        assert worker(["--connect", "tcp://127.0.0.1:1", "--videos", str(tmp_path), *flags]) == 0
    assert [log.is_json for log in logs] == [False, True]
