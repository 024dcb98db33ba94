"""List the known forms of recordings, and find which of them a path has."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from v2v_protocol.errors import UsageError
from v2v_recordings import bag, dsec, evaid, faery_reader, ijrr, layout_h5, mvsec, npy_columns
from v2v_recordings.items import ConvertOptions, Item, ReadProgress


@dataclass(frozen=True)
class RawForm:
    """Describe a raw form.

    Attributes:
        title: description for the help text.
        recognises: returns whether a path has this form, judged by the name and the first bytes only.
        read: yields the items of a recording.
        light: how the pictures of this camera follow light; "" if the form does not tell.
        published_shift: how many events earlier the published conversion of this form pairs a picture.
    """

    title: str
    recognises: Callable[[Path], bool]
    read: Callable[[Path, ConvertOptions, ReadProgress], Iterator[Item]]
    published_shift: int = 0
    light: str = ""


# IJRR, MVSEC and aedat4 are of DAVIS cameras, whose frames are linear in intensity.
FORMS = {
    "ijrr": RawForm(
        "IJRR: events.txt, images.txt, PNGs in a zip or folder; or one .txt or .csv",
        ijrr.recognises,
        ijrr.read,
        light="linear",
    ),
    "evaid": RawForm("EVAID-R: event/*.txt, gt/, timestamps.txt in a zip or folder", evaid.recognises, evaid.read),
    "dsec": RawForm(
        "DSEC: events.h5, PNGs and *timestamps.txt in a folder; or one .h5, as of v2v-simulate",
        dsec.recognises,
        dsec.read,
    ),
    "columns": RawForm(
        "EVREAL: events_ts.npy ... in a folder or zip; or .npz with x, y, t, p",
        npy_columns.recognises,
        npy_columns.read,
    ),
    "h5": RawForm("the layout that v2v-convert writes", layout_h5.recognises, layout_h5.read),
    "mvsec": RawForm("MVSEC: *_data.hdf5", mvsec.recognises, mvsec.read, light="linear"),
    "bag": RawForm("ROS 1 bag (HQF, IJRR, MVSEC)", bag.recognises, bag.read, published_shift=1),
    "aedat4": RawForm("aedat4 of a DAVIS", faery_reader.recognises_aedat4, faery_reader.read_aedat4, light="linear"),
    "es": RawForm("Event Stream (.es)", faery_reader.recognises_es, faery_reader.read_es),
    "prophesee": RawForm("EVT 2, 3 (.raw), DAT", faery_reader.recognises_prophesee, faery_reader.read_prophesee),
}


def recognise(path: Path) -> str:
    """Return the key of FORMS for a file or folder.

    Raises:
        UsageError: it is missing, cannot be read, or has a form that is not in FORMS.
    """
    if not path.exists():
        raise UsageError(f"no file or folder {path}")
    try:
        for name, form in FORMS.items():
            if form.recognises(path):
                return name
    except OSError as error:
        raise UsageError(f"{path} cannot be read: {error.strerror or error}") from error
    forms = "; ".join(form.title for form in FORMS.values())
    raise UsageError(f"{path} is not a known recording. Known forms: {forms}. v2v-convert takes one with --form")
