"""What a log shows of a long scan."""

from __future__ import annotations

import pytest

from v2v_server.progress import catalogue_progress


def test_a_log_says_every_ten_seconds_how_far_a_scan_is(capsys: pytest.CaptureFixture[str]) -> None:
    now = 100.0
    with catalogue_progress(lambda: now) as progress:
        for done in range(1, 31):
            now += 1.0
            progress(done, 30)
    assert capsys.readouterr().err == "".join(f"probing videos: {done} of 30\n" for done in (10, 20, 30))


def test_a_short_scan_says_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    with catalogue_progress() as progress:
        progress(1, 1)
    assert capsys.readouterr().err == ""
