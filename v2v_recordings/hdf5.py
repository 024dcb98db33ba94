"""Open HDF5 files from untrusted sources: a file may refer to other files, which must not be read."""

from __future__ import annotations

import contextlib
import importlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import UsageError
from v2v_recordings.items import Progress, SensorSize

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
    if not path.is_file() or path.suffix.lower() not in SUFFIXES or not _h5py(path).is_hdf5(path):
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
        with _h5py(path).File(path, "r") as file:
            require_self_contained(file, path)
            yield file
    except (OSError, RuntimeError, KeyError, ValueError) as error:  # h5py's errors, for truncated or damaged files
        hint = f"; its filter may be in the package {_PLUGIN}" if "filter" in str(error) else ""
        raise UsageError(f"{path} cannot be read as HDF5: {error}{hint}") from error


def columns(
    group: h5py.Group, names: tuple[str, ...], path: Path, progress: Progress
) -> Iterator[list[npt.NDArray[Any]]]:
    """Yield parts of columns that have an entry for each event.

    Raises:
        UsageError: a column is missing, is not [N] numbers, or has another length.
    """
    found = [group.get(name) for name in names]
    forms = {getattr(column, "shape", None) for column in found}
    if len(forms) > 1 or len(forms.pop() or ()) != 1 or any(column.dtype.kind not in "iufb" for column in found):
        shapes = ", ".join(
            f"{name} {getattr(column, 'shape', 'missing')}" for name, column in zip(names, found, strict=True)
        )
        raise UsageError(f"{path}: columns of events must be numbers and of one length, and are {shapes}")
    for start in range(0, len(found[0]), READ_EVENTS):
        yield [column[start : start + READ_EVENTS] for column in found]
        progress(min(start + READ_EVENTS, len(found[0])), len(found[0]))


def sensor_size(shape: Any, path: Path) -> SensorSize:
    """Return the size for a stated (height, width).

    Raises:
        UsageError: it is something else.
    """
    sides = np.asarray(shape).reshape(-1)
    if len(sides) != 2 or sides.dtype.kind not in "iu":
        raise UsageError(f"{path}: the sensor's size is stated as {shape}, not as height and width")
    return SensorSize(int(sides[1]), int(sides[0]))


def _h5py(path: Path) -> Any:
    try:
        return importlib.import_module("h5py")
    except ModuleNotFoundError as error:
        raise UsageError(f"{path}: needs the package {error.name}: pip install h5py") from error


def require_self_contained(file: h5py.File, path: Path) -> None:
    """Check that everything in an HDF5 file is stored in that file.

    Args:
        file: the open file.
        path: its path, for the error message.

    Raises:
        UsageError: it has an external link, a dataset with external storage or a virtual dataset.
        OSError, RuntimeError, KeyError, ValueError: h5py's errors, if the file is damaged.
    """
    import h5py

    groups, seen = [file["/"]], set[int]()
    while groups:
        group = groups.pop()
        for name in group:
            link = group.get(name, getlink=True)
            if isinstance(link, h5py.ExternalLink):
                raise _external_error(path, f"{group.name}/{name}", f"links to {link.filename}")
            if isinstance(link, h5py.SoftLink):  # within this file: its target is visited by itself
                continue
            item = group[name]
            if isinstance(item, h5py.Group):
                address = h5py.h5o.get_info(item.id).addr  # a group may have several names, its own child's among them
                if address not in seen:
                    seen.add(address)
                    groups.append(item)
            elif isinstance(item, h5py.Dataset) and (item.external or item.is_virtual):
                kind = "a virtual dataset" if item.is_virtual else "a dataset with external storage"
                raise _external_error(path, f"{group.name}/{name}", f"is {kind}")


def _external_error(path: Path, name: str, what: str) -> UsageError:
    return UsageError(
        f"{path}: {name.replace('//', '/')} {what}, and only data inside the file is read: make the file "
        "self-contained with h5repack or h5copy -f ext"
    )
