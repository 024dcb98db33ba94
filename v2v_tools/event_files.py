"""Files of events in common formats. Formats with room for a note say where the times come from."""

from __future__ import annotations

import io
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np

from v2v_protocol.errors import UsageError
from v2v_protocol.events import EventList
from v2v_protocol.write_aside import write_aside_and_rename
from v2v_recordings.archive import package

_NOTE = "simulated from video frames: log intensity is linear in time between frames"


def write_events(path: Path, events: EventList) -> None:
    """Write events in the format that the ending names.

    ``.h5``, ``.hdf5``: the layout of DSEC: ``events/x``, ``y``, ``t`` (microseconds), ``p`` (0, 1), ``ms_to_idx``,
    ``t_offset``; root attributes ``width`` and ``height``. ``.npz``: x, y, t, p, width, height. ``.raw`` (EVT 3),
    ``.aedat4``, ``.es``, ``.dat``: written by the package faery, which keeps no note in them.

    Raises:
        UsageError: unknown ending, missing package, or the file cannot be written.
    """
    check_event_file(path)
    try:
        # The package faery tells the format by the ending.
        aside = path.with_name(f".{path.stem}.{os.getpid()}.partial{path.suffix.lower()}")
        with write_aside_and_rename(path, partial=aside) as partial:
            EVENT_WRITERS[path.suffix.lower()](partial, events)
    except (OSError, RuntimeError) as error:  # the latter is faery's, for instance for a full disk
        raise UsageError(f"{path}: {getattr(error, 'strerror', None) or error}") from error


def check_event_file(path: Path) -> None:
    """Check, before any work, that :func:`write_events` can write a file of this name.

    Raises:
        UsageError: see :func:`write_events`.
    """
    ending = path.suffix.lower()
    if ending not in EVENT_WRITERS:
        raise UsageError(f"{path}: unknown ending; events go into a file that ends in {', '.join(EVENT_WRITERS)}")
    if needed := _PACKAGES.get(EVENT_WRITERS[ending]):
        package(needed, str(path))


def _npz(path: Path, events: EventList) -> None:
    with path.open("wb") as file:  # to a path that ends in .NPZ, NumPy adds a second ending
        np.savez_compressed(
            file, x=events.x, y=events.y, t=events.t, p=events.p,
            width=np.int64(events.width_px), height=np.int64(events.height_px), note=np.array(_NOTE),
        )  # fmt: skip


def _hdf5(path: Path, events: EventList) -> None:
    last_ms = int(events.t[-1]) // 1000 if len(events) else 0
    first_of_ms = np.searchsorted(events.t, np.arange(last_ms + 2) * 1000)
    content = io.BytesIO()  # HDF5 crashes the process on a full disk
    with package("h5py", str(path)).File(content, "w") as file:
        file.attrs.update(width=events.width_px, height=events.height_px, note=_NOTE)
        columns = {"x": events.x, "y": events.y, "t": events.t, "p": events.p.astype(np.uint8)}
        for name, column in columns.items():
            file.create_dataset(f"events/{name}", data=column, compression="gzip", compression_opts=1)
        file["ms_to_idx"] = first_of_ms.astype(np.uint64)
        file["t_offset"] = np.int64(0)
    path.write_bytes(content.getbuffer())


def _faery(path: Path, events: EventList) -> None:
    faery = package("faery", str(path))
    table = np.empty(len(events), faery.EVENTS_DTYPE)
    table["t"], table["x"], table["y"], table["on"] = events.t, events.x, events.y, events.p
    stream = faery.events_stream_from_array(table, (events.width_px, events.height_px))
    kind = {".raw": "evt", ".aedat4": "aedat"}.get(path.suffix.lower(), path.suffix.lower().lstrip("."))
    try:
        stream.to_file(path, zero_t0=False, file_type=kind)  # faery does not know endings in capitals
    finally:
        path.with_name(f"{path.name}.write").unlink(missing_ok=True)  # faery's own temporary file


EVENT_WRITERS: dict[str, Callable[[Path, EventList], None]] = {
    ".h5": _hdf5, ".hdf5": _hdf5, ".npz": _npz, ".raw": _faery, ".aedat4": _faery, ".es": _faery, ".dat": _faery,
}  # fmt: skip
"""Writers by the ending of the name."""
_PACKAGES: dict[Callable[[Path, EventList], None], str] = {_hdf5: "h5py", _faery: "faery"}
