"""Convert a raw recording to an h5 file: recognise its form, and pass its items to the writer."""

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
    """Describe a raw form.

    Attributes:
        title: description for the help text.
        recognises: returns whether a path has this form, judged by the name and the first bytes only.
        read: yields the items of a recording.
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


def recognise(path: Path) -> str:
    """Return the key of FORMS for a file or folder.

    Raises:
        UsageError: it is missing, or has a form that is not in FORMS.
    """
    if not path.exists():
        raise UsageError(f"no file or folder {path}")
    for name, form in FORMS.items():
        if form.recognises(path):
            return name
    forms = "; ".join(form.title for form in FORMS.values())
    raise UsageError(f"{path} is not a known recording. Known forms: {forms}. Give the form with --form")


def default_name(source: Path) -> str:
    """Return the name of the new file: the sequence's name in data sets, with the ending .h5."""
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
        destination: file to write.
        form: key of FORMS; None recognises it.
        options: information that the recording lacks; None for the defaults.
        overwrite: whether to replace an existing destination.
        progress: see :data:`trainer.convert.items.Progress`.

    Raises:
        UsageError: the source is missing, damaged or of an unknown form; or the destination exists or lies in the
            source.
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
        with RecordingWriter(
            destination, source=source.name, size=options.size, published_shift=chosen.published_shift
        ) as writer:
            for item in chosen.read(source, options, progress):
                writer.add(item)
    except OSError as error:
        # Readers convert their own errors, so this one comes from writing the destination.
        raise UsageError(f"{destination}: cannot be written: {error}") from error
    if writer.written is None:
        raise RuntimeError("the writer was left without finishing")
    return Converted(source, destination, form, writer.written)
