"""Read events in NumPy's files, a column each: EVREAL's memmap folders, and ``.npz`` as ``v2v-simulate`` writes it.

| EVREAL | ``.npz`` | content |
|---|---|---|
| ``events_ts.npy`` | ``t`` | [N] or [N, 1]: s if they are floats, else us (``--time-unit`` overrides) |
| ``events_xy.npy`` | ``x``, ``y`` | px, [N, 2] or [N] |
| ``events_p.npy`` | ``p`` | [N] or [N, 1], above 0 for a brightness increase |
| ``images.npy``, ``images_ts.npy`` | | uint8 [M, H, W] or [M, H, W, 1], and their times, s |
| ``metadata.json``: ``sensor_resolution`` | ``height``, ``width`` | size of the sensor |

Columns are read in parts from their streams, so a packed file takes no more memory than a plain one.
"""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import UsageError
from v2v_recordings import hdf5
from v2v_recordings.archive import Archive
from v2v_recordings.items import ConvertOptions, EventChunk, Item, Note, Picture, Progress, SensorSize, to_ns
from v2v_recordings.items import NS_PER_UNIT

FOLDER = ("events_ts.npy", "events_xy.npy", "events_p.npy")
NPZ = ("t.npy", "x.npy", "y.npy", "p.npy")
METADATA, IMAGES, IMAGE_TIMES = "metadata.json", "images.npy", "images_ts.npy"


def recognises(path: Path) -> bool:
    """Return whether the path is a folder or zip file with EVREAL's columns, or a ``.npz`` with x, y, t and p."""
    is_npz = path.is_file() and path.suffix.lower() == ".npz"
    if not (is_npz or path.is_dir() or (path.is_file() and path.suffix.lower() == ".zip")):
        return False
    with Archive(path) as archive:
        return all(archive.find(name) is not None for name in (NPZ if is_npz else FOLDER))


def read(path: Path, options: ConvertOptions, progress: Progress) -> Iterator[Item]:
    """Yield the items of a recording.

    Raises:
        UsageError: a part is missing, damaged or has another shape.
    """
    with Archive(path) as archive, contextlib.ExitStack() as files:
        is_npz = archive.find(NPZ[0]) is not None

        def column(name: str, number: int = 0) -> _Column:
            member = archive.find(name)
            if member is None:
                raise UsageError(f"{path} has no {name}")
            return _Column(files.enter_context(archive.open(member)), f"{path}: {member}", number)

        if is_npz and archive.find("width.npy") and archive.find("height.npy"):
            yield hdf5.sensor_size([int(column(f"{side}.npy").take(1)[0]) for side in ("height", "width")], path)
        elif (member := archive.find(METADATA)) is not None:
            with archive.open(member) as stream:
                yield _metadata_size(stream, f"{path}: {member}")
        t, p = column(NPZ[0] if is_npz else FOLDER[0]), column(NPZ[3] if is_npz else FOLDER[2])
        x, y = (column("x.npy"), column("y.npy")) if is_npz else (column(FOLDER[1]), column(FOLDER[1], 1))
        if len({each.count for each in (t, x, y, p)}) > 1 or {t.row_shape, x.row_shape, p.row_shape} - {(), (2,)}:
            raise UsageError(f"{path}: columns of t, x, y, p have {t.count}, {x.count}, {y.count}, {p.count} entries")
        unit = NS_PER_UNIT[options.time_unit or ("s" if t.is_float else "us")]
        for start in range(0, t.count, hdf5.READ_EVENTS):
            parts = [each.take(hdf5.READ_EVENTS) for each in (t, x, y, p)]
            count = min(map(len, parts))
            times, columns, rows, signs = (part[:count] for part in parts)
            yield EventChunk(to_ns(times, str(path), unit), columns, rows, signs > 0)
            progress(start + count, t.count)
            if count < min(hdf5.READ_EVENTS, t.count - start):
                yield Note(f"cut: {start + count} of {t.count} events are there")
                break
        if not is_npz and archive.find(IMAGES) is not None:
            yield from _pictures(column(IMAGES), column(IMAGE_TIMES), path)


class _Column:
    """Read a .npy file of N rows from its stream; ``number`` chooses a column of [N, k]."""

    def __init__(self, stream: IO[bytes], where: str, number: int = 0) -> None:
        try:
            version = np.lib.format.read_magic(stream)
            read_header = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
            shape, is_fortran, self.dtype = read_header[version](stream)
        except (ValueError, KeyError) as error:
            raise UsageError(f"{where} is not an array of NumPy: {error}") from error
        if self.dtype.kind not in "iufb":
            raise UsageError(f"{where} holds {self.dtype}, not numbers")
        self.count, self.is_float = (shape[0] if shape else 1), self.dtype.kind == "f"
        self.row_shape = tuple(side for side in shape[1:] if side > 1)
        if is_fortran and len(shape) > 1:  # columns lie one after the other
            stream.seek(number * self.count * self.dtype.itemsize, 1)
            self.row_shape, number = (), 0
        self._stream, self._number = stream, number

    def take(self, most: int) -> npt.NDArray[Any]:
        """Return the next rows, at most this many: [n, ...] as in the file, or [n] of a chosen column."""
        row_bytes = math.prod(self.row_shape) * self.dtype.itemsize
        data = self._stream.read(min(most, self.count) * row_bytes)
        rows = np.frombuffer(data[: len(data) // row_bytes * row_bytes], self.dtype).reshape(-1, *self.row_shape)
        return rows[:, self._number] if rows.ndim == 2 else rows


def _metadata_size(stream: IO[bytes], where: str) -> Any:
    try:
        stated = json.loads(stream.read(1 << 16))["sensor_resolution"]
    except (ValueError, LookupError, TypeError) as error:
        raise UsageError(f"{where} states no sensor_resolution: {error!r}") from error
    return hdf5.sensor_size(stated, Path(where))


def _pictures(pictures: _Column, times: _Column, path: Path) -> Iterator[Item]:
    if len(pictures.row_shape) != 2 or times.row_shape or pictures.count != times.count or pictures.dtype != np.uint8:
        raise UsageError(
            f"{path}: {IMAGES} has {pictures.count} pictures, {pictures.dtype} {list(pictures.row_shape)}, and "
            f"{IMAGE_TIMES} {times.count} times; they must be as many, and uint8 [H, W]"
        )
    SensorSize(*pictures.row_shape[::-1]).require_usable(f"{path}: {IMAGES}")
    for number in range(pictures.count):
        time, picture = times.take(1), pictures.take(1)
        if not (len(time) and len(picture)):
            yield Note(f"cut: {number} of {pictures.count} pictures are there")
            return
        yield Picture(int(to_ns(time, f"{path}: {IMAGE_TIMES}")[0]), picture[0])
