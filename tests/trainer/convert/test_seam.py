"""Test that a new form of recordings needs only a file that yields items, and one line in ``FORMS``."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from trainer.convert.conversion import convert
from trainer.evaluation.readers import EventWindow, Recording
from trainer.evaluation.windows import picture_windows
from v2v_recordings.items import ConvertOptions, EventChunk, Item, Picture, ReadProgress, SensorSize
from v2v_recordings.reading import FORMS, RawForm, recognise


def recognises(path: Path) -> bool:
    return path.suffix == ".toy"


def read(path: Path, _options: ConvertOptions, progress: ReadProgress) -> Iterator[Item]:
    """Yield events from lines of ``t_ns x y p``, between two grey pictures."""
    t, x, y, p = np.loadtxt(path, dtype=np.int64).T
    yield SensorSize(6, 4)
    yield Picture(0, np.zeros((4, 6), np.uint8))
    yield EventChunk(t, x, y, p.astype(bool))
    yield Picture(int(t[-1]) + 1, np.full((4, 6), 200, np.uint8))
    progress(path.stat().st_size, path.stat().st_size)


def test_a_toy_form_is_recognised_and_converted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(FORMS, "toy", RawForm("toy lines", recognises, read))
    raw = tmp_path / "raw.toy"
    raw.write_text("1000000 0 0 1\n2000000 5 3 0\n3000000 2 1 1\n")
    assert recognise(raw) == "toy"
    assert convert(raw, tmp_path / "made.h5").form == "toy"
    with Recording(tmp_path / "made.h5") as made:
        (window,) = picture_windows(made)
        assert isinstance(window, EventWindow)
        events = made.events(window)
        assert events.x.tolist() == [0, 5, 2]
        assert events.y.tolist() == [0, 3, 1]
        assert (np.asarray(events.p) > 0).tolist() == [True, False, True]
