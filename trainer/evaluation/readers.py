"""Read recordings in the h5 layout (IJRR, MVSEC, HQF, EVAID, your own) window by window, in bounded memory.

:mod:`trainer.evaluation.windows` defines the windows. Their first and last events are found by the time stamps of the
pictures. This repairs two known faults of published files: ``event_idx`` one event early (HQF), and a picture whose
time stamp goes back (HQF ``engineering_posters``, picture 528), which gets the mean of its neighbours.
``as_published=True`` uses the stored ``event_idx`` instead; a window that ends before it begins is empty then.
"""

from __future__ import annotations

import bisect
import contextlib
import functools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import numpy.typing as npt

from trainer.evaluation.voxelise import Events
from v2v_protocol.errors import UsageError
from v2v_recordings import layout
from v2v_recordings.event_columns import CLOCK_SLACK_SECONDS, Polarities, clock_fault
from v2v_recordings.hdf5 import event_index, layout_unit, require_self_contained
from v2v_recordings.items import ConvertOptions, Light, SensorSize

BLOCK_EVENTS = 1 << 16
CACHED_BLOCKS = 64
VIDEO_GAMMA = 2.2


@dataclass(frozen=True)
class RecordedImage:
    """Hold a picture's key in the file, its time in s, and the index of the first event at its time or later."""

    key: str
    time: float
    event_index: int


@dataclass(frozen=True)
class EventWindow:
    """Hold a window: events ``start:stop``, from ``begin`` to ``end`` s, and the picture at its end, if any."""

    start: int
    stop: int
    begin: float
    end: float
    target: RecordedImage | None


@contextlib.contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Convert errors of h5py in the block to UsageError."""
    try:
        yield
    except (OSError, RuntimeError, KeyError, ValueError) as error:
        raise UsageError(
            f"{path} cannot be read as HDF5: {error} (the file is damaged, or compressed by a filter whose plugin is "
            "not in HDF5_PLUGIN_PATH)"
        ) from error


class _Times(Sequence[float]):
    """Give ``events/ts`` as a sequence for bisection. It reads blocks, and caches the last ones used."""

    def __init__(self, dataset: h5py.Dataset, path: Path) -> None:
        self._dataset, self._path = dataset, path
        self._block = functools.lru_cache(CACHED_BLOCKS)(self._read)

    def _read(self, block: int) -> npt.NDArray[np.float64]:
        with _reading(self._path):
            values: npt.NDArray[np.float64] = self._dataset[block * BLOCK_EVENTS : (block + 1) * BLOCK_EVENTS]
        return values.astype(np.float64)

    def __len__(self) -> int:
        return len(self._dataset)

    def __getitem__(self, index: int) -> float:  # type: ignore[override]
        return float(self._block(index // BLOCK_EVENTS)[index % BLOCK_EVENTS])


class Recording:
    """Read one h5 file, as a context manager.

    Args:
        path: file, opened for reading.
        as_published: see the module.
        size: height and width of the sensor, used if the file has no pictures; None takes those that the file states.
        light: of the pictures, which are then read as a video codes them (VIDEO_GAMMA); None reads them as stored.

    Attributes:
        name: name of the sequence, the file's name without its ending.
        size: height and width of the sensor.
        images: the pictures in order; may be empty.
        times: times of the events in s; reads blocks of the file, for searching.
        repaired_images: number of repaired time stamps.

    Raises:
        UsageError: there is no such file, it has another layout, or its clocks disagree.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        as_published: bool = False,
        size: tuple[int, int] | None = None,
        light: Light | None = None,
    ) -> None:
        self.path = Path(path)
        self._given_size = size
        self._table = None
        if light is not None:
            self._table = np.rint(255.0 * light.of(np.arange(256.0)) ** (1 / VIDEO_GAMMA)).astype(np.uint8)
        self.name = self.path.stem
        if not self.path.is_file():
            raise UsageError(f"no file {self.path}")
        try:
            self._file = h5py.File(self.path, "r")
        except OSError as error:
            raise UsageError(f"{self.path} cannot be read as HDF5: {error}") from error
        try:
            with _reading(self.path):
                require_self_contained(self._file, self.path)
                self._columns = self._check_columns()
                self.times: Sequence[float] = _Times(self._columns["ts"], self.path)
                self._polarities = Polarities()
                self._check_numbers()
                self.repaired_images = 0
                self.images = self._list_images(as_published)
                self.size = self._sensor_size()
        except BaseException:
            self._file.close()
            raise

    def __enter__(self) -> Recording:
        return self

    def __exit__(self, *_error: object) -> None:
        self._file.close()

    def __len__(self) -> int:
        """Return the number of events."""
        return len(self.times)

    @property
    def span(self) -> tuple[float, float]:
        """Return the times of the first and the last event, in s."""
        return self.times[0], self.times[len(self.times) - 1]

    def _check_columns(self) -> dict[str, h5py.Dataset]:
        columns = {name: self._file.get(f"events/{name}") for name in layout.EVENT_COLUMNS}
        missing = [name for name, column in columns.items() if not isinstance(column, h5py.Dataset)]
        if missing:
            raise UsageError(
                f"{self.path} has no events/{missing[0]}: it is not in the layout of v2v-eval. Convert raw recordings "
                "with v2v-convert"
            )
        for name, column in columns.items():
            if column.ndim != 1 or (name in ("xs", "ys") and column.dtype.kind not in "iu"):
                raise UsageError(
                    f"{self.path}: events/{name} is {column.dtype} {list(column.shape)}, not a column [N]; "
                    "coordinates must be integers"
                )
        lengths = {len(column) for column in columns.values()}
        if lengths == {0} or len(lengths) > 1:
            raise UsageError(
                f"{self.path}: columns of events have {sorted(lengths)} entries; they must be of one length above 0"
            )
        return columns

    def _check_numbers(self) -> None:
        """Check the unit of the times and, in the first block, what polarities mean."""
        unit, (first, last) = layout_unit(self._file, ConvertOptions()), self.span
        self._polarities.are_brighter(self._columns["ps"][:BLOCK_EVENTS], str(self.path))
        if unit.name != "s" or self._polarities.meaning:
            other = self._polarities.meaning or f"times are in {unit.name}"
            raise UsageError(f"{self.path}: {other}: convert it with v2v-convert")
        unit.check(len(self), last - first, str(self.path))

    def _list_images(self, as_published: bool) -> tuple[RecordedImage, ...]:
        group = self._file.get("images", {})
        keys = sorted(group)
        if not keys:
            return ()
        name = "event_idx_published" if as_published else "event_idx"
        indices, stamps = [], []
        for key in keys:
            # One picture at a time: attributes keep their picture open, which takes 16 kB.
            attributes = group[key].attrs
            published = attributes.get(name)
            indices.append(attributes.get("event_idx") if published is None else published)
            stamps.append(attributes.get("timestamp"))
        if any(index is None for index in indices):
            raise UsageError(f"{self.path}: pictures without the attribute event_idx")
        stored = [event_index(index, len(self), str(self.path)) for index in indices]
        if any(stamp is None for stamp in stamps):
            times = [self.times[min(index, len(self) - 1)] for index in stored]
            return self._make_images(keys, times, stored)
        times = [float(stamp) for stamp in stamps]
        if as_published:
            return self._make_images(keys, times, stored)
        first, last = self.span
        if fault := clock_fault(times, first, last):
            raise self._clock_error(fault)
        times = self._repair_times(times)
        for time, index in zip(times, stored, strict=True):
            # The time is outside the events' times, but its index has events on both sides: one clock may be in us.
            if (time < first - CLOCK_SLACK_SECONDS and index > 1) or (
                time > last + CLOCK_SLACK_SECONDS and index < len(self) - 1
            ):
                raise self._clock_error(
                    f"a picture is at {time:.6f} s, outside of the events' {first:.6f} to {last:.6f} s, and its "
                    f"event_idx {index} is one of them: they have different clocks"
                )
        return self._make_images(keys, times, [bisect.bisect_left(self.times, time) for time in times])

    def _clock_error(self, fault: str) -> UsageError:
        return UsageError(
            f"{self.path}: {fault}. Convert the recording again with v2v-convert, or trust its event_idx with "
            "--as-published"
        )

    def _make_images(
        self, keys: Sequence[str], times: Sequence[float], indices: Sequence[int]
    ) -> tuple[RecordedImage, ...]:
        return tuple(
            RecordedImage(f"images/{key}", time, index) for key, time, index in zip(keys, times, indices, strict=True)
        )

    def _repair_times(self, times: Sequence[float]) -> list[float]:
        """Replace each time that is not later than its predecessor by the mean of its neighbours."""
        fixed = list(times)
        for index in range(1, len(fixed)):
            if fixed[index] > fixed[index - 1]:
                continue
            after = fixed[index + 1] if index + 1 < len(fixed) else 2 * fixed[index - 1] - fixed[max(0, index - 2)]
            if after <= fixed[index - 1]:
                late = (
                    f"pictures {index} and {index + 1} are"
                    if index + 1 < len(fixed)
                    else f"picture {index}, the last, is"
                )
                raise UsageError(
                    f"{self.path}: the time of {late} not later than that of picture {index - 1}, "
                    f"{fixed[index - 1]:.6f} s; only single times between others can be repaired"
                )
            fixed[index] = (fixed[index - 1] + after) / 2
            self.repaired_images += 1
        return fixed

    def _sensor_size(self) -> tuple[int, int]:
        if self.images:
            shape = self._file[self.images[0].key].shape
            if len(shape) != 2:
                raise UsageError(f"{self.path}: {self.images[0].key} is {list(shape)}, not [H, W]")
            SensorSize(int(shape[1]), int(shape[0])).require_usable(f"{self.path}: {self.images[0].key}")
            return int(shape[0]), int(shape[1])
        if self._given_size is not None:
            return self._given_size
        stated = self._file.attrs.get("sensor_resolution", self._file.get("sensor_resolution"))
        if stated is None or len(stated) != 2:
            raise UsageError(
                f"{self.path} has neither pictures nor sensor_resolution: give the sensor's size with --size WxH"
            )
        SensorSize(int(stated[1]), int(stated[0])).require_usable(str(self.path))
        return int(stated[0]), int(stated[1])

    def flow_fields(self) -> list[RecordedImage]:
        """Return the flow fields in order of their keys. Their event indices are 0."""
        with _reading(self.path):
            group = self._file.get("flow", {})
            return [RecordedImage(f"flow/{key}", float(group[key].attrs["timestamp"]), 0) for key in sorted(group)]

    def flow(self, window: EventWindow) -> npt.NDArray[np.float32]:
        """Read the field that is the target of a window, [2, H, W] (x, y) px; NaN or 0 where it is not known.

        Raises:
            UsageError: the field cannot be read or has another size.
        """
        assert window.target is not None
        with _reading(self.path):
            dataset = self._file[window.target.key]
            if dataset.shape != (2, *self.size):
                raise UsageError(f"{self.path}: {window.target.key} is {list(dataset.shape)}, not {[2, *self.size]}")
            field: npt.NDArray[np.float32] = dataset[:].astype(np.float32)
        return field

    def events(self, window: EventWindow) -> Events:
        """Read the events of a window, sorted by time.

        Raises:
            UsageError: they cannot be read, or an event lies too far outside the window.
        """
        part = slice(window.start, window.stop)
        with _reading(self.path):
            events = Events(
                self._columns["ts"][part].astype(np.float64),
                self._columns["xs"][part],
                self._columns["ys"][part],
                np.where(
                    self._polarities.are_brighter(self._columns["ps"][part], str(self.path)),
                    np.float32(1),
                    np.float32(-1),
                ),
            )
        return _in_order(events, window, self.path)

    def image(self, image: RecordedImage) -> npt.NDArray[np.uint8]:
        """Read the pixels of a picture, uint8 [H, W].

        Raises:
            UsageError: the picture cannot be read, or has another dtype or size than the first one.
        """
        with _reading(self.path):
            dataset = self._file[image.key]
            if dataset.dtype != np.uint8 or dataset.shape != self.size:
                raise UsageError(
                    f"{self.path}: {image.key} is {dataset.dtype} {list(dataset.shape)}, not uint8 {list(self.size)}"
                )
            pixels = dataset[:]
        return np.asarray(pixels if self._table is None else self._table[pixels])

    @property
    def stated_light(self) -> str:
        """Return the light of the pictures that the file states; "" if it states none."""
        return str(self._file.attrs.get("light", ""))


def _in_order(events: Events, window: EventWindow, path: Path) -> Events:
    """Sort the events of a window, since sensors and files have some slightly late ones.

    Raises:
        UsageError: an event lies further outside its window than the window is long. The file is then not sorted well
            enough for searching windows.
    """
    t = events.t
    if (t[1:] >= t[:-1]).all():
        return events
    reach = window.end - window.begin
    within = (t >= window.begin - reach) & (t <= window.end + reach)
    if not within.all():
        at = int(np.flatnonzero(~within)[0])
        raise UsageError(
            f"{path}: events are not sorted by time: event {window.start + at}, at {t[at]:.6f} s, lies among those "
            f"from {window.begin:.6f} to {window.end:.6f} s. Sort the file"
        )
    order = np.argsort(t, kind="stable")
    return Events(t[order], events.x[order], events.y[order], events.p[order])
