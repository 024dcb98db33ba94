"""Pack a folder of files into archives, as corpora of videos are published."""

from __future__ import annotations

import tarfile
from pathlib import Path
from zipfile import ZIP_STORED, ZipFile


def pack(folder: Path, path: Path) -> Path:
    """Write all files below a folder to a tar or zip archive, under their relative names; return its path."""
    path.parent.mkdir(parents=True, exist_ok=True)
    files = [(file, file.relative_to(folder).as_posix()) for file in sorted(folder.rglob("*")) if file.is_file()]
    if path.suffix == ".zip":
        with ZipFile(path, "w", ZIP_STORED) as packed:
            for file, name in files:
                packed.write(file, name)
    else:
        with tarfile.open(path, "w") as tar:
            for file, name in files:
                tar.add(file, name)
    return path


def packed_forms(folder: Path, into: Path) -> dict[str, Path]:
    """Return corpora of equal ids: a folder of folders as it is, and with each of its folders as an archive."""
    forms = {"folder": folder}
    for ending in ("tar", "zip"):
        forms[ending] = into / ending
        for below in sorted(folder.iterdir()):
            pack(below, forms[ending] / f"{below.name}.{ending}")
    return forms
