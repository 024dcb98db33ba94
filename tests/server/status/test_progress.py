"""What a log shows of a long scan."""

from __future__ import annotations

import io
import sys

import pytest

from v2v_server.status.progress import catalogue_progress


def test_a_log_says_every_ten_seconds_how_far_a_scan_is(capsys: pytest.CaptureFixture[str]) -> None:
    now = 100.0
    with catalogue_progress(lambda: now) as progress:
        for done in range(1, 31):
            now += 1.0
            progress(done, 30)
    assert capsys.readouterr().err == (
        "probing videos: 10 of 30, 1 a second, 20.0 s left\n"
        "probing videos: 20 of 30, 1 a second, 10.0 s left\n"
        "probing videos: 30 of 30\n"
    )


def test_a_log_says_as_often_what_is_looked_at_before_anything_is_probed(capsys: pytest.CaptureFixture[str]) -> None:
    now = 100.0
    with catalogue_progress(lambda: now) as progress:
        for done in range(1, 16):
            now += 1.0
            progress.notice(f"looking at files: {done} of 15")
        for done in range(1, 6):
            now += 1.0
            progress(done, 5)
    assert capsys.readouterr().err == "looking at files: 10 of 15\nprobing videos: 5 of 5\n"


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_a_terminal_shows_what_takes_more_than_a_second_and_is_left_clean(monkeypatch: pytest.MonkeyPatch) -> None:
    now, screen = 100.0, Terminal()
    monkeypatch.setattr(sys, "stderr", screen)
    monkeypatch.setenv("TERM", "xterm")
    with catalogue_progress(lambda: now) as progress:
        progress.notice("looking at files: 1 of 3")
        now += 1.5
        progress.notice("looking at files: 2 of 3")
        progress(1, 2)
        now += 1.5
        progress.notice("looking at files: 3 of 3")  # again, with another index
        progress(2, 2)
    shown = screen.getvalue()
    assert "1 of 3" not in shown
    assert shown.index("looking at files: 2 of 3") < shown.index("probing videos") < shown.index("3 of 3")
    assert shown.endswith(("\x1b[2K", "\x1b[?25h"))


def test_a_short_scan_says_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    with catalogue_progress() as progress:
        progress.notice("looking at files: 1 of 1")
        progress(1, 1)
    assert capsys.readouterr().err == ""
