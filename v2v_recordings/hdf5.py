"""Check HDF5 files from untrusted sources: a file may refer to other files, which must not be read."""

from __future__ import annotations

from pathlib import Path

import h5py

from v2v_protocol.errors import UsageError


def require_self_contained(file: h5py.File, path: Path) -> None:
    """Check that everything in an HDF5 file is stored in that file.

    Args:
        file: the open file.
        path: its path, for the error message.

    Raises:
        UsageError: it has an external link, a dataset with external storage or a virtual dataset.
        OSError, RuntimeError, KeyError, ValueError: h5py's errors, if the file is damaged.
    """
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
