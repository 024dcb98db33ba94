"""Files of events in common formats. Formats with room for a note say where the times come from."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from v2v_protocol.errors import UsageError
from v2v_protocol.events import EventList

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
        FORMS[path.suffix.lower()](path, events)
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror or error}") from error


def check_event_file(path: Path) -> None:
    """Check, before any work, that :func:`write_events` can write a file of this name.

    Raises:
        UsageError: see :func:`write_events`.
    """
    ending = path.suffix.lower()
    if ending not in FORMS:
        raise UsageError(f"{path}: unknown ending; events go into a file that ends in {', '.join(FORMS)}")
    if package := _PACKAGES.get(FORMS[ending]):
        _package(package, path)


def _npz(path: Path, events: EventList) -> None:
    with path.open("wb") as file:  # to a path that ends in .NPZ, NumPy adds a second ending
        np.savez_compressed(
            file, x=events.x, y=events.y, t=events.t, p=events.p,
            width=np.int64(events.width_px), height=np.int64(events.height_px), note=np.array(_NOTE),
        )  # fmt: skip


def _hdf5(path: Path, events: EventList) -> None:
    last_ms = int(events.t[-1]) // 1000 if len(events) else 0
    first_of_ms = np.searchsorted(events.t, np.arange(last_ms + 2) * 1000)
    with _package("h5py", path).File(path, "w") as file:
        file.attrs.update(width=events.width_px, height=events.height_px, note=_NOTE)
        columns = {"x": events.x, "y": events.y, "t": events.t, "p": events.p.astype(np.uint8)}
        for name, column in columns.items():
            file.create_dataset(f"events/{name}", data=column, compression="gzip", compression_opts=1)
        file["ms_to_idx"] = first_of_ms.astype(np.uint64)
        file["t_offset"] = np.int64(0)


def _faery(path: Path, events: EventList) -> None:
    faery = _package("faery", path)
    table = np.empty(len(events), faery.EVENTS_DTYPE)
    table["t"], table["x"], table["y"], table["on"] = events.t, events.x, events.y, events.p
    stream = faery.events_stream_from_array(table, (events.width_px, events.height_px))
    kind = {".raw": "evt", ".aedat4": "aedat"}.get(path.suffix.lower(), path.suffix.lower().lstrip("."))
    stream.to_file(path, zero_t0=False, file_type=kind)  # faery does not know endings in capitals


FORMS: dict[str, Callable[[Path, EventList], None]] = {
    ".h5": _hdf5, ".hdf5": _hdf5, ".npz": _npz, ".raw": _faery, ".aedat4": _faery, ".es": _faery, ".dat": _faery,
}  # fmt: skip
"""Writers by the ending of the name."""
_PACKAGES: dict[Callable[[Path, EventList], None], str] = {_hdf5: "h5py", _faery: "faery"}


def _package(name: str, path: Path) -> Any:
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        raise UsageError(f"{path}: needs the package {error.name}: pip install {name}") from error
