"""Test the progress of a conversion without a terminal."""

from __future__ import annotations

from io import StringIO

from trainer.convert.cli import log_progress


def test_progress_prints_a_line_every_thirty_seconds_until_done() -> None:
    out, times = StringIO(), iter([0.0, 10.0, 40.0, 60.0, 75.0])
    progress = log_progress("a.bag", out, clock=lambda: next(times))
    for done in (1, 4, 6, 5):
        progress(done, 10)
    progress(10, 10)
    assert out.getvalue() == "a.bag: 40% converted, about 60 s left\na.bag: 50% converted, about 75 s left\n"
