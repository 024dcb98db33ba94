"""Convert a raw recording to an h5 file: recognise its form, and pass its items to the writer."""

from __future__ import annotations

import contextlib
import os
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from v2v_protocol.errors import UsageError, V2VError
from v2v_protocol.programs import show
from v2v_recordings import layout
from v2v_recordings.item_writer import Written
from v2v_recordings.items import ConvertOptions, ReadProgress
from v2v_recordings.late_signals import late_signals
from v2v_recordings.layout_writer import RecordingWriter
from v2v_recordings.reading import FORMS, read_items, recognise

EVENT_SUFFIXES = (*layout.SUFFIXES, ".npz", ".raw", ".aedat4", ".es", ".dat", ".bag")
"""Suffixes of files that hold events and nothing else; a text may be anything."""


@dataclass(frozen=True)
class Converted:
    """Report one conversion.

    Attributes:
        source, destination: paths.
        form: key of FORMS.
        written: content of the new file.
    """

    source: Path
    destination: Path
    form: str
    written: Written


def default_name(source: Path) -> str:
    """Return the name of the new file: the sequence's name in data sets, with the ending .h5."""
    stem = Path(os.path.abspath(source)).name if source.is_dir() else source.stem  # "." has no name
    return stem.removesuffix("_data") + layout.SUFFIXES[0]


def convert(
    source: str | Path,
    destination: str | Path,
    *,
    form: str | None = None,
    options: ConvertOptions | None = None,
    overwrite: bool = False,
    progress: ReadProgress = lambda _done, _total: None,
) -> Converted:
    """Convert one recording. The source is opened for reading only; the destination appears when it is complete.

    Args:
        source: file or folder.
        destination: file to write.
        form: key of FORMS; None recognises it.
        options: information that the recording lacks; None for the defaults.
        overwrite: whether to replace an existing destination.
        progress: see :data:`v2v_recordings.items.ReadProgress`.

    Raises:
        UsageError: the source is missing, damaged or of an unknown form; or the destination exists or lies in the
            source.
        V2VError: the destination cannot be written, for instance on a full disk.
        KeyboardInterrupt: by a Ctrl-C or SIGTERM.
    """
    source, destination = Path(source), Path(destination)
    options = options or ConvertOptions()
    if form is None:
        form = recognise(source)
    elif form not in FORMS:
        raise UsageError(f"form {form!r}: give one of {', '.join(FORMS)}")
    elif not source.exists():
        raise UsageError(f"no file or folder {source}")
    if destination.exists() and destination.samefile(source):
        raise UsageError(f"{destination} is the source itself")
    if source.is_dir() and destination.resolve().is_relative_to(source.resolve()):
        raise UsageError(f"{destination} lies in the source folder, which is read-only here; give another --out")
    if destination.exists() and not overwrite:
        raise UsageError(f"{destination} exists; --overwrite replaces it")
    chosen = FORMS[form]
    try:
        with (
            late_signals() as check,
            RecordingWriter(
                destination, source=source.name, size=options.size, published_shift=chosen.published_shift
            ) as writer,
        ):

            def step(done: int, total: int | None) -> None:
                check()
                progress(done, total)

            for item in read_items(source, form, options, step):
                check()
                writer.add(item)
    except OSError as error:
        # Readers convert their own errors, so this one comes from writing the destination.
        raise V2VError(f"{destination}: cannot be written: {error.strerror or error}") from error
    if writer.written is None:
        raise RuntimeError("the writer was left without finishing")
    return Converted(source, destination, form, writer.written)


@contextlib.contextmanager
def in_layout(data: Path, options: ConvertOptions, progress: ReadProgress) -> Iterator[Path]:
    """Yield a path whose recordings are in the layout, for ``v2v-eval``: ``data``, or a folder for as long as needed.

    Args:
        data: a recording of any form, or a folder of files. Of a folder's files, those with the suffixes of event files
            are converted, unless one in the layout has the same name.

    Raises:
        UsageError: a recording is damaged.
    """
    raw = [path for path in _recordings(data) if _form(path) not in (None, "h5")]
    if not raw:
        yield data
        return
    with tempfile.TemporaryDirectory(prefix="v2v-") as scratch:
        folder = Path(scratch) / Path(os.path.abspath(data)).stem
        folder.mkdir()
        for path in _recordings(data):
            if path not in raw:
                (folder / path.name).symlink_to(path.resolve())
        for path in raw:
            if not (folder / default_name(path)).exists():
                done = convert(path, folder / default_name(path), options=options, progress=progress)
                for note in done.written.notes:
                    show(f"{path.name}: {note}", sys.stderr)
        yield folder


def _recordings(data: Path) -> list[Path]:
    if data.is_file() or _form(data) is not None:
        return [data]
    return sorted(path for path in data.iterdir() if path.is_file() and path.suffix.lower() in EVENT_SUFFIXES)


def _form(path: Path) -> str | None:
    """Return the form of a recording; None if it is not known, or damaged."""
    try:
        return recognise(path)
    except UsageError:
        return None
