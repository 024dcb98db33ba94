"""Write recordings of events piece by piece."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from v2v_protocol.errors import UsageError
from v2v_protocol.events import EventList
from v2v_recordings.archive import package
from v2v_recordings.evt3 import Encoder, header_of
from v2v_recordings.items import EventChunk
from v2v_recordings.limits import check_size


class StreamedForm(NamedTuple):
    """Ending of a form's files, its name in FORM_LIMITS."""

    ending: str
    limits: str


STREAMED_FORMS = {"h5": StreamedForm(".h5", "DSEC's layout"), "raw": StreamedForm(".raw", "EVT 3")}


def check_form(path: Path, form: str, width_px: int, height_px: int) -> None:
    """Check that a form can hold a picture. Raises: UsageError: it cannot."""
    others = " or ".join(name for name in STREAMED_FORMS if name != form)
    check_size(str(path), STREAMED_FORMS[form].limits, width_px, height_px, f"give --events {others}")


@contextmanager
def open_writer(path: Path, form: str, *, size: tuple[int, int]) -> Iterator[Any]:
    """Lend a writer; its file has the name ``path`` if the block ends without an error, and else there is none.

    Raises:
        UsageError: the form holds no pictures, or the package that writes it is missing.
        OSError: the file cannot be written.
    """
    partial = path.with_name(f"{path.name}.partial")
    try:
        writer: Any = (_Hdf5 if form == "h5" else _Evt3)(partial, size)
        try:
            yield writer
        finally:
            writer.file.close()
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


class _Evt3:
    def __init__(self, path: Path, size: tuple[int, int]) -> None:
        self.file, self._encoder = path.open("wb"), Encoder()
        self.file.write(header_of(*size))

    def add(self, events: EventList) -> None:
        chunk = EventChunk(events.t * 1000, events.x, events.y, events.p)
        for first in range(0, len(events), 1 << 16):
            self.file.write(self._encoder.encode(chunk.part(first, first + (1 << 16))).tobytes())

    def add_picture(self, microseconds: int, picture: Any) -> None:
        raise UsageError("--frames with --events raw: EVT 3 holds no pictures; give --events h5")

    def close(self) -> None:
        """End the file."""


class _Hdf5:
    def __init__(self, path: Path, size: tuple[int, int]) -> None:
        self.file, self._first_of_ms, self._count = package("h5py", str(path)).File(path, "w"), [0], 0
        self.file.attrs.update(width=size[0], height=size[1])
        for name, dtype in (("x", "u2"), ("y", "u2"), ("t", "i8"), ("p", "u1")):
            self._make(f"events/{name}", (), dtype, 1 << 16)
        self._size = size

    def _make(self, name: str, shape: tuple[int, ...], dtype: str, rows: int) -> None:
        self.file.create_dataset(
            name, (0, *shape), dtype, maxshape=(None, *shape), chunks=(rows, *shape), compression="gzip",
            compression_opts=1, shuffle=True,
        )  # fmt: skip

    def _append(self, name: str, values: Any) -> None:
        data = self.file[name]
        data.resize(len(data) + len(values), 0)
        data[-len(values) :] = values

    def add(self, events: EventList) -> None:
        if len(events):
            for name in "xytp":
                self._append(f"events/{name}", getattr(events, name))
            later = np.arange(len(self._first_of_ms), int(events.t[-1]) // 1000 + 1)
            self._first_of_ms += (self._count + np.searchsorted(events.t, later * 1000)).tolist()
            self._count += len(events)

    def add_picture(self, microseconds: int, picture: Any) -> None:
        if "frames" not in self.file:
            self._make("frames/image", self._size[::-1], "u1", 1)
            self._make("frames/t", (), "i8", 1 << 10)
        self._append("frames/image", picture[None])
        self._append("frames/t", np.array([microseconds]))

    def close(self) -> None:
        self.file["ms_to_idx"] = np.array([*self._first_of_ms, self._count], np.uint64)
        self.file["t_offset"] = np.int64(0)
