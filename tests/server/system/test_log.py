"""Lines for people, and for programs."""

from __future__ import annotations

import json
from datetime import datetime
from typing import Any

import pytest

from v2v_server.system.log import Log


def test_text_is_for_people(capsys: pytest.CaptureFixture[str]) -> None:
    Log().say("passed over a.mp4", "warning", video="a.mp4")
    assert capsys.readouterr().err == "passed over a.mp4\n"


def test_json_is_one_object_a_line_whatever_the_text_holds(capsys: pytest.CaptureFixture[str]) -> None:
    log = Log(is_json=True, wall_clock=lambda: "now")
    log.say('two\nlines "and" \x1b[31m', "error", sample={"index": 3})
    (line,) = capsys.readouterr().err.splitlines()
    assert json.loads(line) == {
        "time": "now", "level": "error", "text": 'two\nlines "and" \x1b[31m', "sample": {"index": 3},
    }  # fmt: skip
    Log(is_json=True).say("x")
    said: dict[str, Any] = json.loads(capsys.readouterr().err)
    assert datetime.fromisoformat(said["time"]).utcoffset() is not None
