"""One raw recording -> one h5 file: which form it is, and its items into the writer."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from trainer.convert import bag, evaid, faery_reader, ijrr, mvsec
from trainer.convert.items import ConvertOptions, Item, Progress
from trainer.convert.writer import RecordingWriter, Written
from trainer.evaluation import layout
from v2v_protocol.errors import UsageError


@dataclass(frozen=True)
class RawForm:
    """A raw form.

    Attributes:
        title: what it is, for the help.
        recognises: whether a path looks like it; looks at the name and the first bytes only.
        read: yields its items.
        published_shift: see :class:`RecordingWriter`.
    """

    title: str
    recognises: Callable[[Path], bool]
    read: Callable[[Path, ConvertOptions, Progress], Iterator[Item]]
    published_shift: int = 0


FORMS = {
    "ijrr": RawForm(
        "IJRR: events.txt, images.txt, PNGs in a zip or folder; or one .txt or .csv", ijrr.recognises, ijrr.read
    ),
    "evaid": RawForm("EVAID-R: event/*.txt, gt/, timestamps.txt in a zip or folder", evaid.recognises, evaid.read),
    "mvsec": RawForm("MVSEC: *_data.hdf5", mvsec.recognises, mvsec.read),
    "bag": RawForm("ROS 1 bag (HQF, IJRR, MVSEC)", bag.recognises, bag.read, published_shift=1),
    "aedat4": RawForm("aedat4 of a DAVIS", faery_reader.recognises_aedat4, faery_reader.read_aedat4),
    "prophesee": RawForm("EVT 2, 3 (.raw), DAT", faery_reader.recognises_prophesee, faery_reader.read_prophesee),
}


@dataclass(frozen=True)
class Converted:
    """One conversion.

    Attributes:
        source, destination: paths.
        form: key of FORMS.
        written: what is in the new file.
    """

    source: Path
    destination: Path
    form: str
    written: Written


def recognise(path: Path) -> str:
    """Which of FORMS a file or folder is.

    Raises:
        UsageError: it is missing, or none of them.
    """
    if not path.exists():
        raise UsageError(f"no file or folder {path}")
    for name, form in FORMS.items():
        if form.recognises(path):
            return name
    forms = "; ".join(form.title for form in FORMS.values())
    raise UsageError(f"{path} is no recording that can be read. These can: {forms}. --form says which it is")


def default_name(source: Path) -> str:
    """Name of the file to make: the sequence's, as data sets name it."""
    stem = source.name if source.is_dir() else source.stem
    return stem.removesuffix("_data") + layout.SUFFIXES[0]


def convert(
    source: str | Path,
    destination: str | Path,
    *,
    form: str | None = None,
    options: ConvertOptions | None = None,
    overwrite: bool = False,
    progress: Progress = lambda _done, _total: None,
) -> Converted:
    """Convert one recording. The source is opened for reading only; the destination appears when it is complete.

    Args:
        source: file or folder.
        destination: file to make.
        form: key of FORMS; None looks.
        overwrite: replace an existing destination.
        progress: see :data:`trainer.convert.items.Progress`.

    Raises:
        UsageError: the source is missing, damaged or not understood; the destination exists or lies in the source.
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
        raise UsageError(f"{destination} lies in the source folder, which is never written to; give another --out")
    if destination.exists() and not overwrite:
        raise UsageError(f"{destination} exists; --overwrite replaces it")
    chosen = FORMS[form]
    try:
        with RecordingWriter(
            destination, source=source.name, size=options.size, published_shift=chosen.published_shift
        ) as writer:
            for item in chosen.read(source, options, progress):
                writer.add(item)
    except OSError as error:
        # Readers name their own: what is left is the disk under the destination.
        raise UsageError(f"{destination}: cannot be written: {error}") from error
    if writer.written is None:
        raise RuntimeError("the writer was left without finishing")
    return Converted(source, destination, form, writer.written)
