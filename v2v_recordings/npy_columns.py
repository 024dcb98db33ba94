"""Read events in NumPy's files, a column each: EVREAL's memmap folders, and ``.npz`` as ``v2v-simulate`` writes it.

| EVREAL | ``.npz`` | content |
|---|---|---|
| ``events_ts.npy`` | ``t`` | [N] or [N, 1]: s if they are floats, else us (``--time-unit`` overrides) |
| ``events_xy.npy`` | ``x``, ``y`` | px, [N, 2] or [N] |
| ``events_p.npy`` | ``p`` | [N] or [N, 1], 0 and 1 or as :data:`~v2v_recordings.event_columns.POLARITY_CODES` |
| ``images.npy``, ``images_ts.npy`` | | uint8 [M, H, W] or [M, H, W, 1], and their times, s |
| ``metadata.json``: ``sensor_resolution`` | ``height``, ``width`` | size of the sensor |

Columns are read in parts from their streams, so a packed file takes no more memory than a plain one.
"""

from __future__ import annotations

import contextlib
import functools
import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import UsageError
from v2v_recordings import hdf5
from v2v_recordings.archive import Archive, check_stated_bytes, holds
from v2v_recordings.event_columns import TimeUnit
from v2v_recordings.items import ConvertOptions, Item, ReadProgress, SensorSize

FOLDER = ("events_ts.npy", "events_xy.npy", "events_p.npy")
NPZ = ("t.npy", "x.npy", "y.npy", "p.npy")
_METADATA, _IMAGES, _IMAGE_TIMES = "metadata.json", "images.npy", "images_ts.npy"


def recognises(path: Path) -> bool:
    """Return whether the path is a folder or zip file with EVREAL's columns, or a ``.npz`` with x, y, t and p."""
    return holds(path, lambda archive: all(map(archive.named, FOLDER))) or (
        path.is_file() and holds(path, lambda archive: all(map(archive.named, NPZ)), suffix=".npz")
    )


def read(path: Path, options: ConvertOptions, progress: ReadProgress) -> Iterator[Item]:
    """Yield the items of a recording.

    Raises:
        UsageError: a part is missing, damaged or has another shape.
    """
    with Archive(path) as archive, contextlib.ExitStack() as files:
        column = functools.partial(_column, archive, files)
        if archive.find(NPZ[0]):
            columns = {name.removesuffix(".npy"): column(name) for name in NPZ}
            if archive.find("width.npy") and archive.find("height.npy"):
                yield hdf5.sensor_size([int(column(f"{side}.npy")[:1][0]) for side in ("height", "width")], path)
        else:
            times, xy, polarities = FOLDER
            columns = {"t": column(times), "x": column(xy, 0), "y": column(xy, 1), "p": column(polarities)}
        pictures = column(_IMAGES) if archive.find(_IMAGES) else None
        if (member := archive.find(_METADATA)) is not None:
            yield _metadata_size(archive, member)
        elif pictures is not None and len(pictures.shape) == 3:
            yield SensorSize(*pictures.shape[:0:-1])
        unit = TimeUnit.of(options, "s" if columns["t"].dtype.kind == "f" else "us")
        yield from hdf5.events(columns, str(path), progress, unit=unit)
        if pictures is not None:
            yield from hdf5.pictures(pictures, column(_IMAGE_TIMES), f"{path}: {_IMAGES}")


def _column(archive: Archive, files: contextlib.ExitStack, name: str, number: int | None = None) -> _Column:
    member = archive.find(name) or name
    column = _Column(files.enter_context(archive.open(member)), archive.where(member), number)
    file = archive.path if archive.path.is_file() else archive.folder / member
    check_stated_bytes(math.prod(column.shape) * column.dtype.itemsize, file, archive.where(member))
    return column


class _Column:
    """Read a .npy file of N rows from its stream; ``number`` chooses a column of [N, 2]."""

    def __init__(self, stream: IO[bytes], where: str, number: int | None) -> None:
        try:
            version = np.lib.format.read_magic(stream)
            read_header = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
            shape, is_fortran, self.dtype = read_header[version](stream)
        except (ValueError, KeyError) as error:
            raise UsageError(f"{where} is not an array of NumPy: {error}") from error
        count, *row = shape or (1,)
        if (number is not None and row != [2]) or (is_fortran and number is None and len(shape) > 1):
            order = " in Fortran order" if is_fortran else ""
            raise UsageError(f"{where} is {list(shape)}{order}: save events_xy as [N, 2], and others in C order")
        self._stream, self._begin = stream, stream.tell()
        if is_fortran and number is not None:  # columns lie one after the other
            self._begin += number * count * self.dtype.itemsize
            row, number = [], None
        self._row, self._number = [side for side in row if side > 1], number
        self.shape = (count, *self._row) if number is None else (count,)

    def __getitem__(self, part: slice) -> npt.NDArray[Any]:
        """Return some rows."""
        first, last, _ = part.indices(self.shape[0])
        row_bytes = math.prod(self._row) * self.dtype.itemsize
        self._stream.seek(self._begin + first * row_bytes)
        data = self._stream.read((last - first) * row_bytes)
        rows = np.frombuffer(data[: len(data) // row_bytes * row_bytes], self.dtype).reshape(-1, *self._row)
        return rows if self._number is None else rows[:, self._number]


def _metadata_size(archive: Archive, member: str) -> SensorSize:
    with archive.open(member) as stream:
        try:
            stated = json.loads(stream.read(1 << 16))["sensor_resolution"]
        except (ValueError, LookupError, TypeError) as error:
            raise UsageError(f"{archive.where(member)} states no sensor_resolution: {error!r}") from error
    return hdf5.sensor_size(stated, archive.path / member)
