"""Read a recording of any form: detect the form, check the size, and put all events on one clock.

Events may be out of order: sensors send rows and packets late. A clock that is set back looks similar at first. The
difference is how it ends. Late events end with a jump back to where the time was; after a reset, the time goes on from
where it is.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import UsageError, system_errors
from v2v_recordings import bag, dsec, faery_reader, hdf5, mvsec, npy_columns, prophesee, text_events
from v2v_recordings.archive import starts_with
from v2v_recordings.event_columns import TimeUnit, clock_fault
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
        text_events.recognises_ijrr,
        text_events.read_ijrr,
        light="linear",
    ),
    "evaid": RawForm(
        "EVAID-R: event/*.txt, gt/, timestamps.txt in a zip or folder",
        text_events.recognises_evaid,
        text_events.read_evaid,
    ),
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
    "h5": RawForm("the layout that v2v-convert writes", lambda path: hdf5.holds(path, "events/ts"), hdf5.read_layout),
    "mvsec": RawForm("MVSEC: *_data.hdf5", mvsec.recognises, mvsec.read, light="linear"),
    "bag": RawForm(
        "ROS 1 bag (HQF, IJRR, MVSEC)", partial(starts_with, magic=b"#ROSBAG V"), bag.read, published_shift=1
    ),
    "aedat4": RawForm(
        "aedat4 of a DAVIS", partial(starts_with, magic=b"#!AER-DAT4"), faery_reader.read_aedat4, light="linear"
    ),
    "es": RawForm("Event Stream (.es)", partial(starts_with, magic=b"Event Stream"), faery_reader.read_es),
    "prophesee": RawForm("EVT 2, 3 (.raw), DAT", prophesee.recognises, prophesee.read),
}


def recognise(path: Path) -> str:
    """Return the key of FORMS for a file or folder.

    Raises:
        UsageError: it is missing, cannot be read, or has a form that is not in FORMS.
    """
    if not path.exists():
        raise UsageError(f"no file or folder {path}")
    with system_errors(UsageError, f"{path} cannot be read"):
        for name, form in FORMS.items():
            if form.recognises(path):
                return name
    forms = "; ".join(form.title for form in FORMS.values())
    raise UsageError(f"{path} is not a known recording. Known forms: {forms}. v2v-convert takes one with --form")


LATE_NS = 10_000_000
"""Events that are earlier than others before them by at most this are late in any case."""
MOST_LATE_EVENTS = 1 << 17
"""A longer run of earlier events is no late packet."""
FEW_EVENTS = 8
"""At most this many earlier events at the very end of a recording are late ones."""
MOST_RESETS = 4
"""A recording in which the times step back more often is not in the order of time."""
GAP_NS = 1000
"""Time that stands for the unknown one between the last event before a reset and the first one after it."""


def read_items(
    path: Path, form: str | None, options: ConvertOptions, progress: ReadProgress = lambda _done, _total: None
) -> Iterator[Item]:
    """Yield the items of a recording; its light, if it is known, first.

    Args:
        path: file or folder.
        form: key of FORMS; None recognises it.

    Raises:
        UsageError: the recording is missing, damaged or of an unknown form; its sensor is too large; its clock is reset
            and it has pictures; or these are on another clock.
    """
    clock, chosen = _Clock(path), FORMS[form or recognise(path)]
    if options.light or chosen.light:
        yield options.light or Light.parse(chosen.light)
    for item in chosen.read(path, options, progress):
        if isinstance(item, Light) and options.light:
            continue
        if isinstance(item, EventChunk):
            yield from clock.pass_on(item)
            continue
        if isinstance(item, SensorSize):
            item.require_usable(str(path))
        elif isinstance(item, Picture):
            SensorSize(*item.pixels.shape[::-1]).require_usable(str(path))
            item = dataclasses.replace(item, t_ns=item.t_ns + options.frame_offset_ns)
        clock.check(item)
        yield item
    yield from clock.pass_on(None)
    clock.end(options)


class _Clock:
    """Put events after a reset of the sensor's clock behind those before it, and say so; compare that of pictures."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._newest_ns, self._oldest_ns = np.iinfo(np.int64).min // 2, np.iinfo(np.int64).max
        self._offset_ns = self._passed = self._resets = 0
        self._early: list[EventChunk] = []
        self._others: dict[type, list[float]] = {}
        self._reset = ""

    def check(self, item: Item | None = None) -> None:
        """Refuse pictures and flow fields in a recording whose clock was reset: they have times too."""
        if isinstance(item, (Picture, FlowField)):
            self._others.setdefault(type(item), []).append(item.t_ns * 1e-9)
        if self._others and self._reset:
            raise UsageError(
                f"{self._path}: {self._reset}, and its pictures may be on either clock: split the recording there"
            )

    def end(self, options: ConvertOptions) -> None:
        """Refuse a recording of impossible duration, and pictures and flow fields on another clock than the events."""
        first, last = self._oldest_ns * 1e-9, self._newest_ns * 1e-9
        if options.time_unit is None:  # columns were tested in their own unit
            TimeUnit("us", is_stated=True).check(self._passed, last - first, str(self._path))
        for times in self._others.values() if self._passed else ():
            if fault := clock_fault(times, first, last):
                raise UsageError(f"{self._path}: {fault}")

    def pass_on(self, chunk: EventChunk | None) -> Iterator[Item]:
        """Yield what is certain once these events are known; None ends the recording."""
        chunks = self._early if chunk is None else [*self._early, _later(chunk, self._offset_ns)]
        if not chunks:
            return
        rest, self._early = EventChunk.join(chunks), []
        while len(rest):
            newest = np.maximum.accumulate(np.maximum(rest.t_ns, self._newest_ns))
            count = _first(rest.t_ns < newest - LATE_NS)
            if not count:
                end = _first(rest.t_ns >= self._newest_ns - LATE_NS)
                if end == len(rest) <= MOST_LATE_EVENTS and chunk is not None:
                    self._early = [rest]
                    return
                step_ns = self._newest_ns - int(rest.t_ns[0])
                jumps_back = end < len(rest) and rest.t_ns[end] - rest.t_ns[end - 1] > step_ns // 4
                is_few = end == len(rest) <= FEW_EVENTS
                count = end if is_few or (jumps_back and end <= MOST_LATE_EVENTS) else 0
            if not count:
                back = f"the times step back by {step_ns * 1e-9:.6g} s: the clock was reset"
                self._reset = f"at event {self._passed} {back}"
                self._resets += 1
                if self._resets > MOST_RESETS:
                    raise UsageError(
                        f"{self._path}: {self._reset}, and so {self._resets} times so far: its events are not in the "
                        "order of time, or these are in another unit: sort it, or give --time-unit"
                    )
                self.check()
                yield Note(f"{self._reset}; a gap of unknown length, after which the events follow those before it")
                self._offset_ns += step_ns + GAP_NS
                rest = _later(rest, step_ns + GAP_NS)
                continue
            yield rest.part(0, count)
            self._newest_ns = int(newest[count - 1])
            self._oldest_ns = min(self._oldest_ns, int(rest.t_ns[:count].min()))
            self._passed += count
            rest = rest.part(count)


def _first(mask: npt.NDArray[np.bool_]) -> int:
    """Return the first place at which a mask is true; its length if there is none."""
    return int(mask.argmax()) if mask.any() else len(mask)


def _later(chunk: EventChunk, ns: int) -> EventChunk:
    return dataclasses.replace(chunk, t_ns=chunk.t_ns + ns)
