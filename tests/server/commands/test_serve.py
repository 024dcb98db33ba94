"""`v2v-serve` and `v2v-worker`: flags, the corpus they are given, and what they say when they cannot go on."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from bench.processes import free_ports
from tests.clips import panned_luma, write_clip
from tests.waiting import until
from v2v_server.commands import serve as command
from v2v_server.commands.worker import main as worker
from v2v_server.config import ServeConfig
from v2v_server.system.log import Log


@pytest.mark.parametrize(("flags", "port"), [([], 0), (["--page"], 5580), (["--page", "8080"], 8080)])
def test_a_page_has_a_port_of_its_own_or_the_usual_one(
    flags: list[str], port: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[ServeConfig] = []
    monkeypatch.setattr("v2v_server.serve.serve", lambda config, *_: asked.append(config))
    assert command.main(["--videos", "a", "--workers", "0", "--worker-bind", "tcp://127.0.0.1:*", *flags]) == 0
    assert command.main([*flags, "--videos", "a", "--workers", "0", "--worker-bind", "tcp://127.0.0.1:*"]) == 0
    assert [config.page for config in asked] == [port, port]


def test_an_error_that_ends_it_is_an_object_too_where_programs_read(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    missing = ["--videos", str(tmp_path / "missing"), "--workers", "0", "--worker-bind", "tcp://127.0.0.1:*"]
    assert command.main([*missing, "--log-format", "json"]) == command.main(missing)
    as_object, for_people = capsys.readouterr().err.splitlines()
    assert (json.loads(as_object)["level"], json.loads(as_object)["text"] in for_people) == ("error", True)


def test_every_line_of_a_run_is_an_object(tmp_path: Path) -> None:
    """Started with what gives most lines: refused files, a page, a flag that is questioned; and ended by a signal."""
    videos = tmp_path / "videos"
    videos.mkdir()
    for name, frames in ("long", 60), ("short", 5):
        write_clip(videos / f"{name}.mp4", panned_luma(frames, 72, 96))
    (videos / "damaged.mp4").write_bytes(b"no video")
    (videos / "other.foo").write_bytes(b"")
    flags = [
        *(
            "--videos",
            str(videos),
            "--bind",
            "tcp://127.0.0.1:*",
            "--workers",
            "0",
            "--worker-bind",
            "tcp://127.0.0.1:*",
            "--log-format",
            "json",
        ),
        *(
            "--page",
            str(free_ports(1)[0]),
            "--cache-dir",
            str(tmp_path / "cache"),
            "--port-file",
            str(tmp_path / "port"),
        ),
        *("--set", "crop_height_px=48", "--set", "crop_width_px=64", "--set", "voxels_per_clip=4"),
    ]
    command_line = [sys.executable, "-m", "v2v_protocol.programs", "serve", *flags]
    with subprocess.Popen(command_line, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as server:
        until((tmp_path / "port").exists)
        server.send_signal(signal.SIGINT)
        lines = server.communicate()[0].splitlines()
    assert server.returncode == 130  # as a shell reports it, so that `v2v-serve ... && next` ends too
    assert not (tmp_path / "port").exists()
    texts = [json.loads(line)["text"] for line in lines]
    for said in ("have endings", "short.mp4: 5 frames", "damaged.mp4: ", "page: http", "ready: ", "the end"):
        assert [text for text in texts if said in text], said


# --- v2v-worker -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("source", [".", "clip.mp4", "list.txt"])
def test_it_takes_as_videos_what_the_server_takes_and_logs_for_people_or_for_programs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, source: str
) -> None:
    given: list[Any] = []
    monkeypatch.setattr("v2v_server.commands.worker.run_worker", lambda *each, **_: given.append(each))
    (tmp_path / "clip.mp4").touch()
    (tmp_path / "list.txt").touch()
    for flags in ([], ["--log-format", "json"]):
        assert worker(["--connect", "tcp://127.0.0.1:1", "--videos", str(tmp_path / source), *flags]) == 0
    assert [videos.folder for _, videos, *_ in given] == [tmp_path.resolve()] * 2
    assert [log.is_json for run in given for log in run if isinstance(log, Log)] == [False, True]


def test_a_corpus_that_is_not_there_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert worker(["--connect", "tcp://127.0.0.1:1", "--videos", str(tmp_path / "missing")]) == 2
    assert "there is no such folder, video or list file on this host" in capsys.readouterr().err
