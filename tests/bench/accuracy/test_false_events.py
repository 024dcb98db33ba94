"""The events of a spoilt clip beside those of its clean original."""

from __future__ import annotations

import numpy as np
import pytest

from bench.accuracy.false_events import between, compared, sequences
from tests.clips import panned_luma
from tests.pieces import shots
from v2v_server.corpus.scenes.scene import COLUMNS, Scene

FILM = panned_luma(40, 80, 96)


@pytest.mark.slow
def test_a_clean_clip_has_no_false_event() -> None:
    events, false, wanted, missing = compared(FILM[:16], between(FILM, np.arange(16.0))).tolist()
    assert events == wanted > 1000
    assert false == missing == 0


@pytest.mark.slow
def test_a_repeated_frame_moves_its_events_to_the_next_step() -> None:
    """Light only rises, so nothing cancels in a step of twice the length."""
    rising = np.broadcast_to(40 + 9 * np.arange(16)[:, None, None] + np.arange(32), (16, 24, 32)).astype(np.uint8)
    original = between(rising, np.arange(16.0))
    events, false, wanted, missing = compared(rising[[*range(8), 7, *range(9, 16)]], original).tolist()
    late = int(compared(rising[:9], original[:9])[2] - compared(rising[:8], original[:8])[2])
    assert events == wanted
    assert false == missing == late > 0


def test_frames_between_two_are_linear_in_log_intensity() -> None:
    halves = between(FILM, np.arange(0.0, 3.5, 0.5))
    np.testing.assert_allclose(halves[1::2], (halves[:-1:2] + halves[2::2]) / 2)


def test_sequences_with_scene_auto_hold_no_cut() -> None:
    scene = Scene.of(shots(40, 20), np.zeros((3, COLUMNS)))
    starts = {
        name: [int(frames.numbers[0]) for _, frames in sequences([FILM], [scene], name)] for name in ("off", "auto")
    }
    assert starts == {"off": [0, 15], "auto": [0, 20]}
