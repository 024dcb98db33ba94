"""Test what a long task shows of its progress."""

from __future__ import annotations

import io
import sys

import pytest

from v2v_protocol.progress import Progress, format_duration


class Clock:
    now = 100.0

    def __call__(self) -> float:
        return self.now


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture
def clock() -> Clock:
    return Clock()


def terminal(monkeypatch: pytest.MonkeyPatch) -> Terminal:
    """Replace standard error by a terminal. In the test itself, because pytest replaces it after the fixtures."""
    screen = Terminal()
    monkeypatch.setattr(sys, "stderr", screen)
    monkeypatch.setenv("TERM", "xterm")
    return screen


def test_a_log_gets_a_line_every_ten_seconds(clock: Clock, capsys: pytest.CaptureFixture[str]) -> None:
    with Progress("probing videos", clock=clock) as progress:
        for done in range(1, 31):
            clock.now += 1.0
            progress(done, 30)
    assert capsys.readouterr().err == (
        "probing videos: 10 of 30, 1 a second, 20.0 s left\n"
        "probing videos: 20 of 30, 1 a second, 10.0 s left\n"
        "probing videos: 30 of 30\n"
    )


def test_steps_without_an_amount_are_shown_as_often(clock: Clock, capsys: pytest.CaptureFixture[str]) -> None:
    with Progress("probing videos", clock=clock) as progress:
        for done in range(1, 16):
            clock.now += 1.0
            progress.notice(f"listing files: {done} of 15")
        for done in range(1, 6):
            clock.now += 1.0
            progress(done, 5)
    assert capsys.readouterr().err == "listing files: 10 of 15\nprobing videos: 5 of 5\n"


def test_units_notes_and_parts_are_named(clock: Clock) -> None:
    said: list[str] = []
    frames = Progress("preparing", "frames", say=said.append, clock=clock)
    share = Progress("a.bag", "%", say=said.append, clock=clock)
    unknown = Progress("b.bag", "%", say=said.append, clock=clock)
    plain = Progress("training", "steps", say=said.append, shows_rate=False, clock=clock)
    for second, done in ((0.0, 0), (20.0, 40)):
        clock.now += second
        frames(done, 100, "1.2 of about 3.0 GB")
        share(done, 160, what="a.bag/0")
        unknown(done)
        plain(done, 1000, "loss 0.5")
    assert said == [
        "preparing: 40 of 100 frames, 2 frames a second, 1.2 of about 3.0 GB, 30.0 s left",
        "a.bag/0: 25%, 60.0 s left",
        "b.bag",
        "training: 40 of 1000 steps, loss 0.5",
    ]


def test_the_rate_is_measured_from_the_first_change_and_again_after_a_restart(clock: Clock) -> None:
    said: list[str] = []
    progress = Progress("timing", say=said.append, clock=clock)
    for second, done in ((0.0, 0), (90.0, 0), (10.0, 10), (0.0, 2), (10.0, 4)):  # 90 s of warm-up
        clock.now += second
        progress(done, 20)
    assert said[1:] == ["timing: 10 of 20, 1 a second, 10.0 s left", "timing: 4 of 20, 0.2 a second, 80.0 s left"]


def test_a_terminal_shows_a_bar_after_a_second_and_is_left_clean(clock: Clock, monkeypatch: pytest.MonkeyPatch) -> None:
    screen = terminal(monkeypatch)
    with Progress("[red]a.mp4[/red]", clock=clock) as progress:
        progress.notice("listing files: 1 of 3")
        clock.now += 1.5
        progress.notice("listing files: 2 of 3")
        clock.now += 1.5
        progress(1, 2)
        progress(2, 2)
    shown = screen.getvalue()
    assert "1 of 3" not in shown
    assert shown.index("listing files: 2 of 3") < shown.index("[red]a.mp4[/red]") < shown.index("2 of 2")
    assert shown.endswith(("\x1b[2K", "\x1b[?25h"))


def test_a_log_for_programs_gets_lines_on_a_terminal_too(clock: Clock, monkeypatch: pytest.MonkeyPatch) -> None:
    screen = terminal(monkeypatch)
    said: list[str] = []
    with Progress("probing videos", say=said.append, clock=clock) as progress:
        clock.now += 10.0
        progress(1, 2)
    assert (said, screen.getvalue()) == (["probing videos: 1 of 2"], "")


@pytest.mark.parametrize(("seconds", "text"), [(1.25, "1.2 s"), (120.0, "2 min"), (3 * 3600.0 + 60.0, "3 h 1 min")])
def test_durations_are_short(seconds: float, text: str) -> None:
    assert format_duration(seconds) == text
