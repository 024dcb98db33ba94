"""Memory of a conversion does not grow with the recording."""

from __future__ import annotations

import tracemalloc
import zipfile
from pathlib import Path

import h5py
import numpy as np
import pytest

from trainer.convert import convert
from v2v_recordings import hdf5, item_writer, text_events
from v2v_recordings import layout_writer as writer


def write_mvsec(path: Path, events: int) -> Path:
    path = path / f"fly{events}_data.hdf5"
    with h5py.File(path, "w") as file:
        dataset = file.create_dataset("davis/left/events", (events, 4), "f8", chunks=(1024, 4))
        dataset[:] = np.stack(
            [np.arange(events) % 30, np.arange(events) % 20, np.arange(events) / 1e6, np.ones(events)], 1
        )
    return path


def write_text(path: Path, events: int) -> Path:
    path = path / f"slow{events}.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("events.txt", "".join(f"{t} {t % 30} {t % 20} 1\n" for t in range(events)))
    return path


@pytest.mark.parametrize("write", [write_mvsec, write_text])
def test_peak_memory_is_that_of_the_buffers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, write: object) -> None:
    monkeypatch.setattr(item_writer, "FLUSH_EVENTS", 4096)
    monkeypatch.setattr(item_writer, "REORDER_EVENTS", 1024)
    monkeypatch.setattr(writer, "H5_CHUNK", 1024)
    monkeypatch.setattr(hdf5, "READ_EVENTS", 1024)
    monkeypatch.setattr(text_events, "BLOCK_BYTES", 1 << 14)
    peaks = []
    # The first one also pays for imports and caches.
    for events in (2_000, 20_000, 100_000):
        source = write(tmp_path, events)  # type: ignore[operator]
        tracemalloc.start()
        done = convert(source, tmp_path / f"{events}.h5")
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        assert done.written.events == events
    assert peaks[2] < 1.5 * peaks[1]
    # 100,000 events are 2.9 MB as they are held: 29 bytes each.
    assert peaks[2] < 2_000_000
