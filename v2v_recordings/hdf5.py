"""Open HDF5 files from untrusted sources, which may refer to other files; read columns of events, and pictures.

Here is also the reader of the layout of event_cnn_minimal and V2V, which ``v2v-convert`` writes
(:mod:`v2v_recordings.layout`):

| path | content |
|---|---|
| ``events/ts``, ``xs``, ``ys``, ``ps`` | [N]: s, px, px, above 0 for a brightness increase |
| ``images/*`` | uint8 [H, W]; attribute ``timestamp``, s, or ``event_idx`` |
| ``flow/*`` | float32 [2, H, W]; attribute ``timestamp``, s |
| attributes ``sensor_resolution``, ``start_ns`` | height and width; time 0 in the clock of the raw recording |
| attribute ``light`` | of the pictures, if it is known (``Light.parse``) |
"""

from __future__ import annotations

import contextlib
import importlib
import math
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from v2v_protocol.errors import UsageError
from v2v_recordings.archive import check_stated_bytes, package
from v2v_recordings.event_columns import EventColumns, TimeUnit, to_ns
from v2v_recordings.items import (
    ConvertOptions,
    EventChunk,
    FlowField,
    Item,
    Light,
    Note,
    Picture,
    ReadProgress,
    SensorSize,
)

if TYPE_CHECKING:
    import h5py

SUFFIXES = (".h5", ".hdf5")
READ_EVENTS = 1 << 18
_PLUGIN = "hdf5plugin"
"""Package with filters that HDF5 lacks; DSEC's files are compressed by one of them, Blosc."""


def holds(path: Path, *names: str) -> bool:
    """Return whether the path is an HDF5 file with items of these names.

    Raises:
        UsageError: it is an HDF5 file, but damaged.
    """
    if not path.is_file() or path.suffix.lower() not in SUFFIXES or not package("h5py", str(path)).is_hdf5(path):
        return False
    with open_hdf5(path) as file:
        return all(name in file for name in names)


@contextlib.contextmanager
def open_hdf5(path: Path) -> Iterator[h5py.File]:
    """Open a self-contained file for reading.

    Raises:
        UsageError: it is damaged, on opening or while it is read; or see :func:`require_self_contained`.
    """
    with contextlib.suppress(ImportError):
        importlib.import_module(_PLUGIN)
    try:
        with package("h5py", str(path)).File(path, "r") as file:
            require_self_contained(file, path)
            yield file
    except (OSError, RuntimeError, LookupError, ValueError, TypeError, AttributeError) as error:
        # h5py's errors for damaged files, and Python's where a group is in place of a dataset.
        hint = f"; its filter may be in the package {_PLUGIN}" if re.search("filter|plugin", str(error)) else ""
        raise UsageError(f"{path} cannot be read as HDF5: {error}{hint}") from error


Column = Any
"""Rows of numbers in a file, with ``shape``, ``dtype`` and slices: an HDF5 dataset, or what reads a file of NumPy.

A slice has fewer rows than asked for if the file is cut.
"""


def events(
    columns: Mapping[str, Column], where: str, progress: ReadProgress, *, unit: TimeUnit, offset_ns: int = 0
) -> Iterator[EventChunk | Note]:
    """Yield events whose times, x, y and polarities are in columns, in this order.

    Raises:
        UsageError: a column is missing, is not [N] numbers, or has another length; or see :class:`EventColumns`.
    """
    found = list(columns.values())
    shapes: list[Any] = [getattr(column, "shape", None) or ("no",) for column in found]
    dtypes = [getattr(column, "dtype", np.dtype("V")) for column in found]
    is_numbers = [dtype.kind in kinds for dtype, kinds in zip(dtypes, ("iufb", "iuf", "iuf", "iufb"), strict=True)]
    if not all(is_numbers) or len(set(shapes)) > 1 or len(shapes[0]) != 1:
        listed = ", ".join(" x ".join(map(str, shape)) for shape in shapes)
        raise UsageError(
            f"{where}: columns of {', '.join(columns)} have {listed} entries of {', '.join(map(str, dtypes))}; they "
            "must be numbers, equally many; x and y must be integers"
        )
    (count,), read = shapes[0], EventColumns(where, unit, offset_ns)
    for start in range(0, count, READ_EVENTS):
        parts = [column[start : start + READ_EVENTS] for column in found]
        end = start + min(map(len, parts))
        yield read.part(*(part[: end - start] for part in parts))
        progress(end, count)
        if end < min(start + READ_EVENTS, count):
            yield Note(f"cut: {end} of {count} events are there")
            break
    yield from read.end()


def pictures(pixels: Column, times: Column, where: str, nearest: Column | None = None) -> Iterator[Picture | Note]:
    """Yield pictures [M, H, W] whose times, s, are in a column.

    Args:
        nearest: number of the event that the published conversion pairs with each picture.

    Raises:
        UsageError: they are not uint8 [M, H, W], or there are more or fewer times.
    """
    count, *shape = pixels.shape
    if len(shape) != 2 or pixels.dtype != np.uint8:
        raise UsageError(f"{where} has {count} pictures, {pixels.dtype} {shape}, not uint8 [H, W]")
    SensorSize(*shape[::-1]).require_usable(where)
    if any(column is not None and column.shape != (count,) for column in (times, nearest)):
        raise UsageError(f"{where}: {count} pictures, but {times.shape[0]} times")
    for number in range(count):
        one = slice(number, number + 1)
        if not (len(picture := pixels[one]) and len(time := times[one])):
            yield Note(f"cut: {number} of {count} pictures are there")
            return
        event = None if nearest is None else max(0, int(nearest[one][0]))
        yield Picture(int(to_ns(time, where)[0]), picture[0], event)


def sensor_size(shape: Any, path: Path) -> SensorSize:
    """Return the size for a stated (height, width).

    Raises:
        UsageError: it is something else.
    """
    # A dataset may state any number of entries: no more than three are read.
    sides = np.asarray(shape[:3] if len(getattr(shape, "shape", ())) == 1 else shape).reshape(-1)
    if len(sides) != 2 or sides.dtype.kind not in "iu":
        raise UsageError(f"{path}: the sensor's size is stated as {shape}, not as height and width")
    return SensorSize(int(sides[1]), int(sides[0]))


_CURE = "and only data inside the file is read: make the file self-contained with h5repack or h5copy -f ext"
UNIT_ATTRIBUTES = ("unit", "units", "time_unit", "time_units")


def stated_unit(times: Column) -> Any:
    """Return the unit that an attribute of a column of times, or of its group, states; None if there is none."""
    attributes = [getattr(holder, "attrs", {}) for holder in (times, getattr(times, "parent", None))]
    return next((each[name] for each in attributes for name in UNIT_ATTRIBUTES if name in each), None)


def layout_unit(file: h5py.File, options: ConvertOptions) -> TimeUnit:
    """Return the unit of ``events/ts``. A file that v2v-convert wrote states it by ``start_ns``."""
    own = "s" if "start_ns" in file.attrs else None
    return TimeUnit.of(options, "s", own or stated_unit(file.get("events/ts")))


def event_index(index: Any, events: int, where: str) -> int:
    """Return the number of the event that the attribute ``event_idx`` of a picture names.

    Raises:
        UsageError: there are fewer events.
    """
    if not 0 <= int(index) <= events:
        raise UsageError(f"{where}: event_idx is {index}, and there are {events} events: correct the file")
    return int(index)


def require_self_contained(file: h5py.File, path: Path) -> None:
    """Check that everything in an HDF5 file is stored in that file, and is of a plausible size.

    Args:
        file: the open file.
        path: its path, for the error message.

    Raises:
        UsageError: it has an external link, a dataset with external storage or a virtual dataset; or see
            :func:`check_stated_bytes`.
        OSError, RuntimeError, KeyError, ValueError: h5py's errors, if the file is damaged.
    """
    import h5py

    groups, seen = [file["/"]], set[int]()
    while groups:
        group = groups.pop()
        for name in group:
            link, where = group.get(name, getlink=True), f"{path}: {group.name}/{name}".replace("//", "/")
            if isinstance(link, h5py.SoftLink):  # within this file: its target is visited by itself
                continue
            if isinstance(link, h5py.ExternalLink):
                raise UsageError(f"{where} links to {link.filename}, {_CURE}")
            item = group[name]
            if isinstance(item, h5py.Group):
                address = h5py.h5o.get_info(item.id).addr  # a group may have several names, its own child's among them
                if address not in seen:
                    seen.add(address)
                    groups.append(item)
            elif isinstance(item, h5py.Dataset):
                if item.external or item.is_virtual:
                    kind = "a virtual dataset" if item.is_virtual else "a dataset with external storage"
                    raise UsageError(f"{where} is {kind}, {_CURE}")
                each_bytes = item.id.get_type().get_size()
                check_stated_bytes(each_bytes * item.id.get_space().get_simple_extent_npoints(), path, where)
                check_stated_bytes(each_bytes * math.prod(item.chunks or ()), path, f"{where}: a chunk", is_piece=True)


def read_layout(path: Path, options: ConvertOptions, progress: ReadProgress) -> Iterator[Item]:
    """Yield the items of a recording.

    Raises:
        UsageError: a part is missing, damaged or has another shape.
    """
    with open_hdf5(path) as file:
        origin_ns = int(file.attrs.get("start_ns", 0))
        if "light" in file.attrs:
            yield Light.parse(str(file.attrs["light"]))
        stated = file.attrs.get("sensor_resolution", file.get("sensor_resolution"))
        if stated is not None:
            yield sensor_size(stated, path)
        columns = {name: file.get(f"events/{name}") for name in ("ts", "xs", "ys", "ps")}
        yield from events(columns, str(path), progress, unit=layout_unit(file, options), offset_ns=origin_ns)
        for kind in ("images", "flow"):
            for key in sorted(file.get(kind, ())):
                item, where, count = file[f"{kind}/{key}"], f"{path}: {kind}/{key}", len(columns["ts"])
                seconds = item.attrs.get("timestamp")
                if seconds is None and "event_idx" in item.attrs:
                    seconds = columns["ts"][min(event_index(item.attrs["event_idx"], count, where), count - 1)]
                t_ns = int(to_ns(np.array([seconds], np.float64), where, offset_ns=origin_ns)[0])
                if (item.ndim, kind) != (3, "flow") and (item.ndim, item.dtype) != (2, np.uint8):
                    raise UsageError(f"{where} is {item}, not uint8 [H, W], or flow [2, H, W]")
                SensorSize(*item.shape[:-3:-1]).require_usable(where)
                yield Picture(t_ns, item[:]) if item.ndim == 2 else FlowField(t_ns, item[:].astype(np.float32))
