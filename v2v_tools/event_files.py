"""Files of events in common formats. Formats with room for a note say where the times come from."""

from __future__ import annotations

import io
import os
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from v2v_protocol.errors import UsageError
from v2v_protocol.events import EventList
from v2v_protocol.write_aside import write_aside_and_rename
from v2v_recordings.archive import package
from v2v_recordings.evt3 import Encoder, header_of
from v2v_recordings.items import EventChunk
from v2v_recordings.limits import FORM_LIMITS, check_size, fits

_NOTE = "simulated from video frames: log intensity is linear in time between frames"
EVENTS_AT_ONCE = 1 << 16


def write_events(path: Path, events: EventList) -> None:
    """Write events in the format that the ending names.

    ``.h5``, ``.hdf5``: the layout of DSEC: ``events/x``, ``y``, ``t`` (microseconds), ``p`` (0, 1), ``ms_to_idx``,
    ``t_offset``; root attributes ``width`` and ``height``. ``.npz``: x, y, t, p, width, height. ``.raw``: EVT 3.
    ``.aedat4``, ``.es``, ``.dat``: written by the package faery, which keeps no note in them.

    Raises:
        UsageError: unknown ending, missing package, a size, place or time that the format cannot hold, or the file
            cannot be written.
    """
    check_event_file(path, events.width_px, events.height_px)
    form = EVENT_WRITERS[path.suffix.lower()].form
    x, y, t_us = (int(column.max(initial=0)) for column in (events.x, events.y, events.t))
    if len(events) and (x >= events.width_px or y >= events.height_px):
        size = f"the picture of {events.width_px} x {events.height_px} px: correct its size"
        raise UsageError(f"{path}: events reach x = {x}, y = {y}, outside of {size}")
    if t_us >= FORM_LIMITS[form].end_us:
        limit = f"{form} holds times below {FORM_LIMITS[form].end_us} us"
        raise UsageError(f"{path}: an event at {t_us} us; {limit}: give a shorter clip, or .h5 or .npz")
    try:
        # The package faery tells the format by the ending.
        aside = path.with_name(f".{path.stem}.{os.getpid()}.partial{path.suffix.lower()}")
        with write_aside_and_rename(path, partial=aside) as partial:
            EVENT_WRITERS[path.suffix.lower()].write(partial, events)
    except (OSError, RuntimeError) as error:  # the latter is faery's, for instance for a full disk
        raise UsageError(f"{path}: {getattr(error, 'strerror', None) or error}") from error


def check_event_file(path: Path, width_px: int, height_px: int) -> None:
    """Check, before any work, that :func:`write_events` can write a picture of this size to a file of this name.

    Raises:
        UsageError: see :func:`write_events`.
    """
    ending = path.suffix.lower()
    if ending not in EVENT_WRITERS:
        raise UsageError(f"{path}: unknown ending; events go into a file that ends in {', '.join(EVENT_WRITERS)}")
    others = [name for name, each in EVENT_WRITERS.items() if fits(each.form, width_px, height_px)]
    advice = f"give a smaller crop, or another ending: {', '.join(others) or 'none'} holds it"
    check_size(str(path), EVENT_WRITERS[ending].form, width_px, height_px, advice)
    if needed := EVENT_WRITERS[ending].package:
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


def _evt3(path: Path, events: EventList) -> None:
    encoder, every = Encoder(), EventChunk(events.t * 1000, events.x, events.y, events.p)
    with path.open("wb") as file:
        file.write(header_of(events.width_px, events.height_px))
        for first in range(0, len(events), EVENTS_AT_ONCE):
            file.write(encoder.encode(every.part(first, first + EVENTS_AT_ONCE)).tobytes())


def _faery(path: Path, events: EventList) -> None:
    faery = package("faery", str(path))
    table = np.empty(len(events), faery.EVENTS_DTYPE)
    table["t"], table["x"], table["y"], table["on"] = events.t, events.x, events.y, events.p
    stream = faery.events_stream_from_array(table, (events.width_px, events.height_px))
    kind = path.suffix.lower().strip(".4")
    try:
        stream.to_file(path, zero_t0=False, file_type=kind)  # faery does not know endings in capitals
    finally:
        path.with_name(f"{path.name}.write").unlink(missing_ok=True)  # faery's own temporary file


class EventWriter(NamedTuple):
    """Writer of a form: its name in FORM_LIMITS, the function, and the package that it needs."""

    form: str
    write: Callable[[Path, EventList], None]
    package: str = ""


EVENT_WRITERS = {
    ".h5": EventWriter("DSEC's layout", _hdf5, "h5py"),
    ".hdf5": EventWriter("DSEC's layout", _hdf5, "h5py"),
    ".npz": EventWriter("npz", _npz),
    ".raw": EventWriter("EVT 3", _evt3),
    ".aedat4": EventWriter("AEDAT 4", _faery, "faery"),
    ".es": EventWriter("Event Stream", _faery, "faery"),
    ".dat": EventWriter("DAT", _faery, "faery"),
}
"""Writers by the ending of the name."""
