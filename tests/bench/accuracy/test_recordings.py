"""Recordings of simulated cameras: what follows from the light, whatever camera is drawn."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from bench.accuracy import recordings
from trainer.evaluation.readers import Recording

HZ = 100.0


def light(first: float, last: float) -> recordings.Reals:
    """Return 21 pictures of a plain wall: half as long in each light."""
    return np.repeat([first, last], (10, 11))[:, None, None] * np.ones((16, 24))


@pytest.mark.parametrize(("first", "last", "sign"), [(0.1, 0.9, 1), (0.9, 0.1, -1), (0.5, 0.5, 0)])
def test_a_step_of_light_fires_its_sign_at_its_time_and_nothing_else_but_noise(
    first: float, last: float, sign: int
) -> None:
    events, drawn = recordings.seen(light(first, last), HZ, np.random.default_rng(0))
    assert (np.diff(events.t_ns) >= 0).all()
    assert events.x.max() < 24
    assert events.y.max() < 16
    noise = 5 * 0.2 * 16 * 24  # at most 5 a pixel and second
    signs = np.where(events.p, 1, -1)
    wrong = np.count_nonzero(signs != sign) if sign else len(events)
    assert wrong < noise
    if sign:
        change = abs(np.log((recordings.DARK + last**2.2) / (recordings.DARK + first**2.2)))
        expected = change / drawn["threshold_pos" if sign > 0 else "threshold_neg"] * 16 * 24
        assert np.count_nonzero(signs == sign) == pytest.approx(expected, rel=0.1, abs=noise + 16 * 24)
        assert np.count_nonzero(events.t_ns < 0.09e9) < noise


def test_every_recording_has_true_pictures_at_their_times(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def scenes(side: int, films: list[Path]) -> Iterator[tuple[str, recordings.Reals, float]]:
        yield "step", light(0.2, 0.8), HZ

    monkeypatch.setattr(recordings, "scenes", scenes)
    asked = argparse.Namespace(out=tmp_path, video=[], side=24, seed=0)
    assert [record["recording"] for record in recordings.measure(asked).records] == ["step"]
    with Recording(tmp_path / "step.h5") as found:
        assert len(found.images) == 5
        levels = [found.image(image).mean() for image in found.images]
    assert levels == [204.0] * 5
