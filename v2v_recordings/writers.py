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
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import UsageError
from v2v_protocol.events import EventList
from v2v_protocol.write_aside import write_aside_and_rename
from v2v_recordings.archive import package
from v2v_recordings.evt3 import Encoder, header_of
from v2v_recordings.items import NO_EVENTS, EventChunk, FlowField, Picture, SensorSize
from v2v_recordings.late_signals import late_signals
from v2v_recordings.limits import FORM_LIMITS, check_size, fits

_NOTE = "simulated from video frames: log intensity is linear in time between frames"
EVENTS_AT_ONCE = 1 << 16
_Written = Generator[None, EventChunk | None, None]
"""A file that is being written: it is sent pieces of EVENTS_AT_ONCE events, the last of which may be shorter, and None
at their end. To close it earlier removes its parts.
"""
PLANES: Mapping[str, tuple[str, tuple[int, ...]]] = {"images": ("u1", ()), "flow": ("<f4", (2,)), "masks": ("u1", ())}
"""dtype of each kind of pictures that some forms hold beside events, and its axes before [H, W]."""


def open_writer(path: Path, form: str, size: tuple[int, int], planes: Sequence[str] = ()) -> EventWriter:
    """Return the writer of a recording; see :class:`EventWriter`.

    Args:
        path: file, or folder for the form ``evreal``. An existing file is replaced when the new one is complete.
        form: key of EVENT_FORMS.
        size: width and height, px.
        planes: keys of PLANES that will be added.

    Raises:
        UsageError: see :func:`check_form`; ``path`` is a folder that holds something; or the file cannot be created.
    """
    check_form(path, form, size, planes)
    if path.is_dir() and (form != "evreal" or any(path.iterdir())):
        raise UsageError(f"{path} is a folder, and is not replaced: give another name, or remove it")
    return EventWriter(path, form, size, planes)


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


class EventWriter(contextlib.AbstractContextManager["EventWriter"]):
    """Write a recording inside a ``with`` block. A normal exit completes the file, an exception removes its parts.

    Attributes:
        events: number of those added.

    Raises:
        UsageError: events step back, or are outside of the picture or the form's times; a plane has another shape, or
            was not announced; or the file cannot be written further, for instance on a full disk.
    """

    def __init__(self, path: Path, form: str, size: tuple[int, int], planes: Sequence[str]) -> None:
        self._path, self._limit, self._size = path, EVENT_FORMS[form].limit, SensorSize(*size)
        self._pending, self._last_us, self.events = NO_EVENTS, 0, 0
        with contextlib.ExitStack() as files, self._words():
            self._planes = {name: _Planes(files.enter_context(_unnamed(path)), name, self._size) for name in planes}
            self._file = EVENT_FORMS[form].write(path, self._size, self._planes)
            next(self._file)
            self._files = files.pop_all()

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        with self._files, self._words(), contextlib.suppress(StopIteration):
            if kind is not None:
                self._file.close()
                return
            if len(self._pending):
                self._file.send(self._pending)
            self._file.send(None)

    def add(self, events: EventList) -> None:
        """Add the next events, in order of time, microseconds from 0 on."""
        if not len(events):
            return
        self._check(events)
        self._last_us, self.events = int(events.t[-1]), self.events + len(events)
        taken = 0
        while taken < len(events):
            part = slice(taken, taken + EVENTS_AT_ONCE - len(self._pending))
            piece = EventChunk(events.t[part] * 1000, events.x[part], events.y[part], events.p[part])
            self._pending, taken = EventChunk.join([self._pending, piece]), taken + len(piece)
            if len(self._pending) == EVENTS_AT_ONCE:
                with self._words():
                    self._file.send(self._pending)
                self._pending = NO_EVENTS

    def add_plane(self, kind: str, microseconds: int, plane: npt.NDArray[Any]) -> None:
        """Add a picture of a kind of PLANES: images and masks uint8 [H, W], flow [2, H, W] px until the next field.
        It is not earlier than the one before it of its kind. Its events may be added before or after.

        Raises:
            UsageError: see :class:`EventWriter`.
        """
        if kind not in self._planes:
            raise UsageError(f"{self._path}: {kind} were not announced when it was opened: name them in planes")
        shape, planes = (*PLANES[kind][1], self._size.height, self._size.width), self._planes[kind]
        if plane.shape != shape or microseconds < max(planes.stamps_us[-1:], default=0):
            raise UsageError(
                f"{self._path}: {kind} {list(plane.shape)} at {microseconds} us; they must be {list(shape)}, in order "
                "of time from 0 us on"
            )
        with self._words():
            planes.append(plane)
        planes.stamps_us.append(microseconds)

    def _check(self, events: EventList) -> None:
        size, end_us = self._size, FORM_LIMITS[self._limit].end_us
        if events.t[0] < self._last_us or (events.t[1:] < events.t[:-1]).any():
            raise UsageError(f"{self._path}: events step back behind {self._last_us} us: sort them; times begin at 0")
        if events.t[-1] >= end_us:
            raise UsageError(
                f"{self._path}: an event at {events.t[-1]} us; {self._limit} holds times below {end_us} us: give a "
                "shorter clip, or .h5 or .npz"
            )
        x, y = int(events.x.max()), int(events.y.max())
        if x >= size.width or y >= size.height:
            raise UsageError(
                f"{self._path}: events reach x = {x}, y = {y}, outside of the picture of {size.width} x "
                f"{size.height} px: correct its size"
            )

    @contextlib.contextmanager
    def _words(self) -> Iterator[None]:
        try:
            with late_signals():
                yield
        except (OSError, RuntimeError) as error:  # the latter is faery's, for instance for a full disk
            raise UsageError(f"{self._path}: cannot be written: {getattr(error, 'strerror', None) or error}") from error


class _Rows:
    """Append rows to a file in NumPy's form; its head states their number after :meth:`finish`.

    Args:
        file: empty, open for reading and writing.
        dtype, row: of a row.
    """

    def __init__(self, file: IO[bytes], dtype: npt.DTypeLike, row: tuple[int, ...] = ()) -> None:
        self._file, self.dtype, self._row, self._count = file, np.dtype(dtype), row, 0
        self.finish()
        self._begin = file.tell()

    def append(self, rows: npt.ArrayLike) -> None:
        array = np.asarray(rows, self.dtype).reshape(-1, *self._row)
        self._file.write(np.ascontiguousarray(array).data)
        self._count += len(array)

    def finish(self) -> None:
        """Write the head, whose length does not depend on the number of rows."""
        self._file.seek(0)
        head = {"descr": np.lib.format.dtype_to_descr(self.dtype), "fortran_order": False}
        np.lib.format.write_array_header_1_0(self._file, head | {"shape": (self._count, *self._row)})

    def copy_to(self, file: IO[bytes]) -> None:
        """Copy all of it to another file."""
        self.finish()
        self._file.seek(0)
        shutil.copyfileobj(self._file, file)

    def parts(self, rows: int) -> Iterator[npt.NDArray[Any]]:
        """Yield the rows again, in parts of this many."""
        self._file.seek(self._begin)
        row_bytes = self.dtype.itemsize * int(np.prod(self._row, dtype=np.int64))
        while data := self._file.read(rows * row_bytes):
            yield np.frombuffer(data, self.dtype).reshape(-1, *self._row)


class _Planes(_Rows):
    """Pictures of a kind, in a file beside the recording, and when they are shown."""

    def __init__(self, file: IO[bytes], kind: str, size: SensorSize) -> None:
        dtype, axes = PLANES[kind]
        super().__init__(file, dtype, (*axes, size.height, size.width) if axes else (size.height, size.width, 1))
        self.stamps_us: list[int] = []

    @property
    def seconds(self) -> npt.NDArray[np.float64]:
        """When they are shown, [N]."""
        return np.array(self.stamps_us, np.float64) * 1e-6


def _unnamed(path: Path) -> IO[bytes]:
    return tempfile.TemporaryFile(dir=path.parent)


def _write_raw(path: Path, size: SensorSize, _: Mapping[str, _Planes]) -> _Written:
    encoder = Encoder()
    with write_aside_and_rename(path) as partial, partial.open("wb") as file:
        file.write(header_of(size.width, size.height))
        while piece := (yield):
            file.write(encoder.encode(piece).data)


def _write_by_faery(path: Path, size: SensorSize, _: Mapping[str, _Planes]) -> _Written:
    faery = package("faery", str(path))
    # The package knows a form by its ending, and takes its events from an iterator: they wait in a file.
    aside = path.with_name(f".{path.stem}.{os.getpid()}.partial{path.suffix.lower()}")
    with write_aside_and_rename(path, partial=aside) as partial, _unnamed(path) as file:
        partial.touch()  # before any work: whether it can be created
        rows = _Rows(file, faery.EVENTS_DTYPE)
        while piece := (yield):
            table = np.empty(len(piece), rows.dtype)
            table["t"], table["x"], table["y"], table["on"] = piece.t_ns // 1000, piece.x, piece.y, piece.p
            rows.append(table)
        pieces = (part.copy() for part in rows.parts(EVENTS_AT_ONCE))  # faery writes into them
        faery.file_encoder.events_to_file(
            pieces, partial, (size.width, size.height), zero_t0=False, file_type=aside.suffix.strip(".4"),
            use_write_suffix=False,
        )  # fmt: skip


def _write_npz(path: Path, size: SensorSize, planes: Mapping[str, _Planes]) -> _Written:
    with write_aside_and_rename(path) as partial, contextlib.ExitStack() as files:
        dtypes = {"t": "<i8", "x": "<u2", "y": "<u2", "p": "?"}
        rows = {name: _Rows(files.enter_context(_unnamed(path)), dtype) for name, dtype in dtypes.items()}
        while piece := (yield):
            for each, values in zip(rows.values(), (piece.t_ns // 1000, piece.x, piece.y, piece.p), strict=True):
                each.append(values)
        stated: dict[str, npt.ArrayLike] = {f"{kind}_ts": each.seconds for kind, each in planes.items()}
        stated |= {"width": np.int64(size.width), "height": np.int64(size.height), "note": np.array(_NOTE)}
        with zipfile.ZipFile(partial, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
            for name, each in {**rows, **planes}.items():
                with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                    each.copy_to(member)
            for name, value in stated.items():
                with archive.open(f"{name}.npy", "w") as member:
                    np.lib.format.write_array(member, np.asanyarray(value))


def _write_evreal(path: Path, size: SensorSize, planes: Mapping[str, _Planes]) -> _Written:
    """Write EVREAL's folder; ``image_event_indices`` are the numbers of events before each picture."""
    with contextlib.ExitStack() as cleanup, write_aside_and_rename(path) as folder, contextlib.ExitStack() as files:
        cleanup.callback(shutil.rmtree, folder, ignore_errors=True)  # after a rename there is none
        folder.mkdir()
        forms = {"events_ts": ("<f8", ()), "events_xy": ("<u2", (2,)), "events_p": ("?", ())}
        rows = {
            name: _Rows(files.enter_context((folder / f"{name}.npy").open("wb+")), *form)
            for name, form in forms.items()
        }
        while piece := (yield):
            columns = piece.t_ns // 1000 * 1e-6, np.stack([piece.x, piece.y], 1), piece.p
            for each, values in zip(rows.values(), columns, strict=True):
                each.append(values)
        for each in rows.values():
            each.finish()
        for kind, each in planes.items():
            with (folder / f"{kind}.npy").open("wb") as file:
                each.copy_to(file)
            np.save(folder / f"{kind}_ts.npy", each.seconds)
        if "images" in planes:
            earlier = np.zeros((len(planes["images"].seconds), 1), np.int64)
            for part in rows["events_ts"].parts(EVENTS_AT_ONCE):
                earlier[:, 0] += np.searchsorted(part, planes["images"].seconds)
            np.save(folder / "image_event_indices.npy", earlier)
        stated = {"sensor_resolution": [size.height, size.width], "note": _NOTE}
        (folder / "metadata.json").write_text(json.dumps(stated) + "\n")


def _write_layout(path: Path, size: SensorSize, planes: Mapping[str, _Planes]) -> _Written:
    """Write the h5 layout of E2VID's family and event_flow: :mod:`v2v_recordings.layout`."""
    from v2v_recordings.layout_writer import RecordingWriter  # lazily: it loads h5py

    with RecordingWriter(path, source="v2v-simulate", size=size, origin_ns=0, pack_events=False) as recording:
        while piece := (yield):
            recording.add(piece)
        for kind, each in planes.items():
            for number, (microseconds, (plane,)) in enumerate(zip(each.stamps_us, each.parts(1), strict=True)):
                if kind == "masks":
                    recording.add_plane(f"masks/mask{number:09d}", 1000 * microseconds, plane[..., 0])
                elif kind == "flow":
                    recording.add(FlowField(1000 * microseconds, plane))
                else:
                    recording.add(Picture(1000 * microseconds, plane[..., 0]))


def _write_dsec(path: Path, size: SensorSize, _: Mapping[str, _Planes]) -> _Written:
    """Write one file in DSEC's layout."""
    from v2v_recordings.layout_writer import append, open_new  # lazily: it loads h5py

    with write_aside_and_rename(path) as partial, open_new(partial) as (file, disk):
        file.attrs.update(width=size.width, height=size.height, note=_NOTE)
        dtypes = {"events/x": "u2", "events/y": "u2", "events/t": "i8", "events/p": "u1", "ms_to_idx": "u8"}
        packed = {"compression": "gzip", "compression_opts": 1}
        columns = [
            file.create_dataset(name, (0,), dtype, maxshape=(None,), chunks=(EVENTS_AT_ONCE,), **packed)
            for name, dtype in dtypes.items()
        ]
        first_of_ms, written = columns[-1], 0
        while piece := (yield):
            disk.check()
            t_us = piece.t_ns // 1000
            next_ms = 1000 * np.arange(len(first_of_ms), int(t_us[-1]) // 1000 + 1)
            values = piece.x, piece.y, t_us, piece.p, written + np.searchsorted(t_us, next_ms)
            for column, added in zip(columns, values, strict=True):
                append(column, added)
            written += len(piece)
        append(first_of_ms, np.full(1 if written else 2, written))
        file["t_offset"] = np.int64(0)


class EventForm(NamedTuple):
    """A form that can be written: its ending, its name in FORM_LIMITS, its writer, package, and kinds of pictures."""

    ending: str
    limit: str
    write: Callable[[Path, SensorSize, Mapping[str, _Planes]], _Written]
    package: str = ""
    planes: tuple[str, ...] = ()


EVENT_FORMS = {
    "h5": EventForm(".h5", "E2VID's layout", _write_layout, "h5py", tuple(PLANES)),
    "dsec": EventForm(".h5", "DSEC's layout", _write_dsec, "h5py"),
    "npz": EventForm(".npz", "npz", _write_npz, planes=tuple(PLANES)),
    "raw": EventForm(".raw", "EVT 3", _write_raw),
    "aedat4": EventForm(".aedat4", "AEDAT 4", _write_by_faery, "faery"),
    "es": EventForm(".es", "Event Stream", _write_by_faery, "faery"),
    "dat": EventForm(".dat", "DAT", _write_by_faery, "faery"),
    "evreal": EventForm("", "EVREAL's layout", _write_evreal, planes=tuple(PLANES)),
}
"""Forms by the name that commands take."""
ENDINGS = {
    ".h5": "dsec", ".hdf5": "dsec", ".npz": "npz", ".raw": "raw", ".aedat4": "aedat4", ".es": "es", ".dat": "dat",
}  # fmt: skip
"""Form of a single file of events, by its ending."""
