"""Write recordings piece by piece, in any form that this project reads: events, and pictures where a form has them.

Events go on in pieces of a fixed length, and pictures after all events, so that the bytes of a file do not depend on
the pieces in which they came. Until then, pictures and what the package faery writes lie in unnamed files beside it.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import tempfile
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import IO, Any, ClassVar, NamedTuple, Self

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import UsageError
from v2v_protocol.events import EventList
from v2v_protocol.write_aside import write_aside_and_rename
from v2v_recordings.archive import package
from v2v_recordings.evt3 import Encoder, header_of
from v2v_recordings.items import EventChunk, FlowField, Picture, SensorSize
from v2v_recordings.late_signals import late_signals
from v2v_recordings.limits import FORM_LIMITS, check_size, fits

_NOTE = "simulated from video frames: log intensity is linear in time between frames"
EVENTS_AT_ONCE = 1 << 16
PLANES: Mapping[str, tuple[str, tuple[int, ...]]] = {"images": ("u1", ()), "flow": ("<f4", (2,)), "masks": ("u1", ())}
"""dtype of each kind of pictures that some forms hold beside events, and its axes before [H, W]."""


def open_writer(
    path: Path, form: str, size: tuple[int, int], planes: Sequence[str] = (), *, source: str = "v2v-simulate"
) -> EventWriter:
    """Return the writer of a recording; see :class:`EventWriter`.

    Args:
        path: file, or folder for the form ``evreal``. An existing file is replaced when the new one is complete.
        form: key of EVENT_FORMS.
        size: width and height, px.
        planes: keys of PLANES that will be added.
        source: name of the maker, for forms that keep it.

    Raises:
        UsageError: see :func:`check_form`; ``path`` is a folder that holds something; or the file cannot be created.
    """
    check_form(path, form, size, planes)
    if path.is_dir() and (form != "evreal" or any(path.iterdir())):
        raise UsageError(f"{path} is a folder, and is not replaced: give another name, or remove it")
    return EVENT_FORMS[form].writer(path, form, size, planes, source)


def check_form(path: Path, form: str, size: tuple[int, int], planes: Sequence[str] = ()) -> None:
    """Check, before any work, that a form can hold pictures of this size and these planes.

    Raises:
        UsageError: it cannot, or a package is missing.
    """
    if form not in EVENT_FORMS:
        raise UsageError(f"{path}: unknown form {form!r} of events; give one of {', '.join(EVENT_FORMS)}")
    chosen = EVENT_FORMS[form]
    able = [name for name, each in EVENT_FORMS.items() if fits(each.limit, *size) and {*planes} <= {*each.planes}]
    others = f"{', '.join(able) or 'none'} {'hold' if len(able) > 1 else 'holds'} it"
    check_size(str(path), chosen.limit, *size, f"give a smaller crop, or another form: {others}")
    if missing := [name for name in planes if name not in chosen.planes]:
        raise UsageError(f"{path}: {form} holds no {' or '.join(missing)}; give another form: {others}")
    if chosen.package:
        package(chosen.package, str(path))


def form_of(path: Path) -> str:
    """Return the form of a file of events by its ending; ``.h5`` is DSEC's layout.

    Raises:
        UsageError: unknown ending.
    """
    if path.suffix.lower() not in ENDINGS:
        raise UsageError(f"{path}: unknown ending; events go into a file that ends in {', '.join(ENDINGS)}")
    return ENDINGS[path.suffix.lower()]


def write_events(path: Path, events: EventList) -> None:
    """Write events in the form that the ending names. Raises as :func:`open_writer` and :class:`EventWriter`."""
    with open_writer(path, form_of(path), (events.width_px, events.height_px)) as writer:
        writer.add(events)


class EventWriter:
    """Write a recording inside a ``with`` block. A normal exit completes the file, an exception removes its parts.

    Raises:
        UsageError: events step back, or are outside of the picture or the form's times; a plane has another shape, or
            was not announced; or the file cannot be written further, for instance on a full disk.
    """

    def __init__(self, path: Path, form: str, size: tuple[int, int], planes: Sequence[str], source: str) -> None:
        self._path, self._form, self._size, self._source = path, form, SensorSize(*size), source
        self._pending: list[EventList] = []
        self._pending_events = self._last_us = 0
        self._stamps: dict[str, list[int]] = {name: [] for name in planes}
        self._planes: dict[str, _Rows] = {}
        self.events, self._is_closed = 0, False
        self._files = contextlib.ExitStack()
        with contextlib.ExitStack() as opening:
            opening.push(self._files)  # closed only after an error
            try:
                self._open()
                for name in planes:
                    dtype, axes = PLANES[name]
                    self._planes[name] = _Rows(self._plane_file(name), dtype, self._plane_shape(axes))
            except OSError as error:
                raise UsageError(f"{path}: cannot be written: {error.strerror or error}") from error
            opening.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self.close()
        else:
            self._files.__exit__(kind, error, trace)

    def add(self, events: EventList) -> None:
        """Add the next events, in order of time, microseconds from 0 on."""
        if not len(events):
            return
        self._check(events)
        self._last_us = int(events.t[-1])
        self.events += len(events)
        self._pending.append(events)
        self._pending_events += len(events)
        if self._pending_events >= EVENTS_AT_ONCE:
            self._flush(self._pending_events // EVENTS_AT_ONCE * EVENTS_AT_ONCE)

    def add_picture(self, microseconds: int, picture: npt.NDArray[np.uint8]) -> None:
        """Add a picture, uint8 [H, W], not earlier than the one before it. Its events may be added before or after."""
        self.add_plane("images", microseconds, picture)

    def add_plane(self, kind: str, microseconds: int, plane: npt.NDArray[Any]) -> None:
        """Add a picture of a kind of PLANES: images and masks uint8 [H, W], flow [2, H, W] px until the next field.

        Raises:
            UsageError: see :class:`EventWriter`.
        """
        if kind not in self._planes:
            raise UsageError(f"{self._path}: {kind} were not announced when it was opened: name them in planes")
        shape, stamps = (*PLANES[kind][1], self._size.height, self._size.width), self._stamps[kind]
        if plane.shape != shape or microseconds < max(stamps[-1:], default=0):
            raise UsageError(
                f"{self._path}: {kind} {list(plane.shape)} at {microseconds} us; they must be {list(shape)}, in order "
                "of time from 0 us on"
            )
        with self._words():
            self._planes[kind].append(plane[None])
        stamps.append(microseconds)

    def close(self) -> None:
        """Complete the file, and give it its name; a second call does nothing."""
        if self._is_closed:
            return
        self._is_closed = True
        with self._words(), self._files:
            self._flush(self._pending_events)
            self._finish()

    def _check(self, events: EventList) -> None:
        first, last, size = int(events.t[0]), int(events.t[-1]), self._size
        if first < self._last_us or (np.diff(events.t) < 0).any():
            raise UsageError(f"{self._path}: events step back behind {self._last_us} us: sort them; times begin at 0")
        limit, form = FORM_LIMITS[EVENT_FORMS[self._form].limit], EVENT_FORMS[self._form].limit
        if last >= limit.end_us:
            raise UsageError(
                f"{self._path}: an event at {last} us; {form} holds times below {limit.end_us} us: give a shorter "
                "clip, or .h5 or .npz"
            )
        x, y = int(events.x.max()), int(events.y.max())
        if x >= size.width or y >= size.height:
            raise UsageError(
                f"{self._path}: events reach x = {x}, y = {y}, outside of the picture of {size.width} x "
                f"{size.height} px: correct its size"
            )

    def _flush(self, count: int) -> None:
        """Write the first ``count`` pending events."""
        if not self._pending:
            return
        columns = {name: np.concatenate([getattr(each, name) for each in self._pending]) for name in "xytp"}

        def part(first: int, last: int) -> EventList:
            chosen = {name: column[first:last] for name, column in columns.items()}
            return EventList(**chosen, width_px=self._size.width, height_px=self._size.height)

        with self._words():
            for first in range(0, count, EVENTS_AT_ONCE):
                self._write(part(first, min(first + EVENTS_AT_ONCE, count)))
        columns = {name: column[count:].copy() for name, column in columns.items()}  # a view would keep all of them
        self._pending, self._pending_events = [part(0, len(columns["t"]))], len(columns["t"])

    @contextlib.contextmanager
    def _words(self) -> Iterator[None]:
        try:
            with late_signals():
                yield
        except (OSError, RuntimeError) as error:  # the latter is faery's, for instance for a full disk
            raise UsageError(f"{self._path}: cannot be written: {getattr(error, 'strerror', None) or error}") from error

    def _aside(self) -> Path:
        return self._files.enter_context(write_aside_and_rename(self._path))

    def _unnamed(self) -> IO[bytes]:
        return self._files.enter_context(tempfile.TemporaryFile(dir=self._path.parent))

    def _plane_file(self, name: str) -> IO[bytes]:
        return self._unnamed()

    def _plane_shape(self, axes: tuple[int, ...]) -> tuple[int, ...]:
        return (*axes, self._size.height, self._size.width)

    def _open(self) -> None:
        raise NotImplementedError

    def _write(self, events: EventList) -> None:
        """Write a piece of EVENTS_AT_ONCE events; the last piece of a recording may be shorter."""
        raise NotImplementedError

    def _finish(self) -> None:
        """Write what comes after the last event."""


class _Rows:
    """Append rows to a file in NumPy's form; its head states their number after :meth:`finish`.

    Args:
        file: empty, open for reading and writing.
        dtype, row: of a row.
    """

    def __init__(self, file: IO[bytes], dtype: npt.DTypeLike, row: tuple[int, ...] = ()) -> None:
        self.file, self.dtype, self.row, self.count = file, np.dtype(dtype), row, 0
        self.finish()
        self._begin = file.tell()

    def append(self, rows: npt.ArrayLike) -> None:
        array = np.asarray(rows, self.dtype).reshape(-1, *self.row)
        self.file.write(np.ascontiguousarray(array).data)
        self.count += len(array)

    def finish(self) -> None:
        """Write the head, whose length does not depend on the number of rows."""
        self.file.seek(0)
        head = {"descr": np.lib.format.dtype_to_descr(self.dtype), "fortran_order": False}
        np.lib.format.write_array_header_1_0(self.file, head | {"shape": (self.count, *self.row)})

    def parts(self, rows: int) -> Iterator[npt.NDArray[Any]]:
        """Yield the rows again, in parts of this many."""
        self.file.seek(self._begin)
        row_bytes = self.dtype.itemsize * int(np.prod(self.row, dtype=np.int64))
        while data := self.file.read(rows * row_bytes):
            yield np.frombuffer(data, self.dtype).reshape(-1, *self.row)


class _Evt3(EventWriter):
    def _open(self) -> None:
        self._encoder, self._file = Encoder(), self._files.enter_context(self._aside().open("wb"))
        self._file.write(header_of(self._size.width, self._size.height))

    def _write(self, events: EventList) -> None:
        self._file.write(self._encoder.encode(_chunk(events)).tobytes())


class _Faery(EventWriter):
    """The forms that faery writes from an iterator of pieces, which wait in a file."""

    def _open(self) -> None:
        self._faery = package("faery", str(self._path))
        # The package knows a form by its ending.
        aside = self._path.with_name(f".{self._path.stem}.{os.getpid()}.partial.{self._form}")
        self._partial = self._files.enter_context(write_aside_and_rename(self._path, partial=aside))
        self._partial.touch()  # before any work: whether it can be created
        self._rows = _Rows(self._unnamed(), self._faery.EVENTS_DTYPE)

    def _write(self, events: EventList) -> None:
        table = np.empty(len(events), self._faery.EVENTS_DTYPE)
        table["t"], table["x"], table["y"], table["on"] = events.t, events.x, events.y, events.p
        self._rows.append(table)

    def _finish(self) -> None:
        pieces = (piece.copy() for piece in self._rows.parts(EVENTS_AT_ONCE))  # faery writes into them
        self._faery.file_encoder.events_to_file(
            pieces, self._partial, (self._size.width, self._size.height), zero_t0=False,
            file_type=self._form.strip("4"), use_write_suffix=False,
        )  # fmt: skip


class _Columns(EventWriter):
    """A file of NumPy for each column and kind of pictures, whose times are seconds."""

    dtypes: ClassVar[Mapping[str, tuple[str, tuple[int, ...]]]] = {}

    def _columns(self, events: EventList) -> tuple[npt.NDArray[Any], ...]:
        raise NotImplementedError

    def _column_file(self, name: str) -> IO[bytes]:
        raise NotImplementedError

    def _open(self) -> None:
        self._target = self._new_target()
        self._rows = {name: _Rows(self._column_file(name), *form) for name, form in self.dtypes.items()}

    def _new_target(self) -> Path:
        return self._aside()

    def _plane_file(self, name: str) -> IO[bytes]:
        return self._column_file(name)

    def _plane_shape(self, axes: tuple[int, ...]) -> tuple[int, ...]:
        return super()._plane_shape(axes) if axes else (*super()._plane_shape(axes), 1)

    def _write(self, events: EventList) -> None:
        for rows, values in zip(self._rows.values(), self._columns(events), strict=True):
            rows.append(values)

    def _all(self) -> dict[str, _Rows]:
        """Return all arrays, complete, by name."""
        found = {**self._rows, **self._planes}
        for name, stamps in self._stamps.items():
            found[f"{name}_ts"] = _Rows(self._column_file(f"{name}_ts"), "<f8")
            found[f"{name}_ts"].append(np.array(stamps) * 1e-6)
        for rows in found.values():
            rows.finish()
        return found


class _Npz(_Columns):
    dtypes: ClassVar = {"t": ("<i8", ()), "x": ("<u2", ()), "y": ("<u2", ()), "p": ("?", ())}

    def _columns(self, events: EventList) -> tuple[npt.NDArray[Any], ...]:
        return events.t, events.x, events.y, events.p

    def _column_file(self, name: str) -> IO[bytes]:
        return self._unnamed()

    def _finish(self) -> None:
        stated = {"width": np.int64(self._size.width), "height": np.int64(self._size.height), "note": np.array(_NOTE)}
        with zipfile.ZipFile(self._target, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
            for name, rows in self._all().items():
                rows.file.seek(0)
                with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                    shutil.copyfileobj(rows.file, member)
            for name, value in stated.items():
                with archive.open(f"{name}.npy", "w") as member:
                    np.lib.format.write_array(member, np.asanyarray(value))


class _Evreal(_Columns):
    """EVREAL's folder; ``image_event_indices`` are the numbers of events before each picture."""

    dtypes: ClassVar = {"events_ts": ("<f8", ()), "events_xy": ("<u2", (2,)), "events_p": ("?", ())}

    def _columns(self, events: EventList) -> tuple[npt.NDArray[Any], ...]:
        return events.t * 1e-6, np.stack([events.x, events.y], 1), events.p

    def _column_file(self, name: str) -> IO[bytes]:
        return self._files.enter_context((self._target / f"{name}.npy").open("wb+"))

    def _new_target(self) -> Path:
        cleanup, folder = self._files.enter_context(contextlib.ExitStack()), self._aside()
        cleanup.callback(shutil.rmtree, folder, ignore_errors=True)  # after a rename there is none
        folder.mkdir()
        return folder

    def _finish(self) -> None:
        found = self._all()
        if "images_ts" in found:
            times = np.array(self._stamps["images"]) * 1e-6
            earlier = np.zeros(len(times), np.int64)
            for part in found["events_ts"].parts(EVENTS_AT_ONCE):
                earlier += np.searchsorted(part, times)
            indices = _Rows(self._column_file("image_event_indices"), "<i8", (1,))
            indices.append(earlier)
            indices.finish()
        stated = {"sensor_resolution": [self._size.height, self._size.width], "note": _NOTE}
        (self._target / "metadata.json").write_text(json.dumps(stated) + "\n")


class _Layout(EventWriter):
    """The h5 layout of E2VID's family and event_flow: :mod:`v2v_recordings.layout`."""

    def _open(self) -> None:
        from v2v_recordings.layout_writer import RecordingWriter  # lazily: it loads h5py

        self._recording = self._files.enter_context(
            RecordingWriter(self._path, source=self._source, size=self._size, origin_ns=0, pack_events=False)
        )

    def _write(self, events: EventList) -> None:
        self._recording.add(_chunk(events))

    def _finish(self) -> None:
        for kind, rows in self._planes.items():
            for number, (microseconds, part) in enumerate(zip(self._stamps[kind], rows.parts(1), strict=True)):
                if kind == "masks":
                    self._recording.add_plane(f"masks/mask{number:09d}", 1000 * microseconds, part[0])
                else:
                    item = Picture if kind == "images" else FlowField
                    self._recording.add(item(1000 * microseconds, part[0]))


class _Dsec(EventWriter):
    """One file in DSEC's layout."""

    def _open(self) -> None:
        from v2v_recordings.layout_writer import open_new  # lazily: it loads h5py

        self._file, self._disk = self._files.enter_context(open_new(self._aside()))
        self._file.attrs.update(width=self._size.width, height=self._size.height, note=_NOTE)
        dtypes = {"x": "u2", "y": "u2", "t": "i8", "p": "u1"}
        self._columns = {f"events/{name}": self._appendable(f"events/{name}", dtype) for name, dtype in dtypes.items()}
        self._first_of_ms = self._appendable("ms_to_idx", "u8")
        self._written = 0

    def _appendable(self, name: str, dtype: str) -> Any:
        return self._file.create_dataset(
            name, (0,), dtype, maxshape=(None,), chunks=(EVENTS_AT_ONCE,), compression="gzip", compression_opts=1
        )

    def _write(self, events: EventList) -> None:
        self._disk.check()
        first_ms, last_ms = len(self._first_of_ms), int(events.t[-1]) // 1000
        begins = self._written + np.searchsorted(events.t, np.arange(first_ms, last_ms + 1) * 1000)
        _append(self._first_of_ms, begins)
        for name, column in self._columns.items():
            _append(column, getattr(events, name[-1]))
        self._written += len(events)

    def _finish(self) -> None:
        _append(self._first_of_ms, [self._written] * (1 if self._written else 2))
        self._file["t_offset"] = np.int64(0)


def _append(dataset: Any, values: npt.ArrayLike) -> None:
    count, values = len(dataset), np.asarray(values)
    dataset.resize(count + len(values), axis=0)
    dataset[count:] = values


def _chunk(events: EventList) -> EventChunk:
    return EventChunk(events.t * 1000, events.x, events.y, events.p)


class EventForm(NamedTuple):
    """A form that can be written: its ending, its name in FORM_LIMITS, its writer, package, and kinds of pictures."""

    ending: str
    limit: str
    writer: type[EventWriter]
    package: str = ""
    planes: tuple[str, ...] = ()


EVENT_FORMS = {
    "h5": EventForm(".h5", "E2VID's layout", _Layout, "h5py", tuple(PLANES)),
    "dsec": EventForm(".h5", "DSEC's layout", _Dsec, "h5py"),
    "npz": EventForm(".npz", "npz", _Npz, planes=tuple(PLANES)),
    "raw": EventForm(".raw", "EVT 3", _Evt3),
    "aedat4": EventForm(".aedat4", "AEDAT 4", _Faery, "faery"),
    "es": EventForm(".es", "Event Stream", _Faery, "faery"),
    "dat": EventForm(".dat", "DAT", _Faery, "faery"),
    "evreal": EventForm("", "EVREAL's layout", _Evreal, planes=tuple(PLANES)),
}
"""Forms by the name that commands take."""
ENDINGS = {
    ".h5": "dsec", ".hdf5": "dsec", ".npz": "npz", ".raw": "raw", ".aedat4": "aedat4", ".es": "es", ".dat": "dat",
}  # fmt: skip
"""Form of a single file of events, by its ending."""
