"""Reads recordings in the h5 layout (IJRR, MVSEC, HQF, EVAID, own ones), window by window, in bounded memory.

A window is what lies between two consecutive pictures: its voxel grid is to become the later one. Window i holds the
events with t_i <= t < t_(i+1), found by the pictures' time stamps. Two known faults of published files are mended so:
``event_idx`` one event early (HQF), and a picture whose time stamp goes back (HQF ``engineering_posters``, picture
528), which gets the mean of its neighbours. ``as_published=True`` takes ``event_idx`` as it is stored; a window that
ends before it begins is empty then.
"""

from __future__ import annotations

import bisect
import contextlib
import dataclasses
import functools
import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import numpy.typing as npt

from trainer.evaluation import layout
from trainer.evaluation.voxelise import Events
from v2v_protocol.errors import UsageError

BLOCK_EVENTS = 1 << 16
CACHED_BLOCKS = 64
CLOCK_SLACK_SECONDS = 1.0


@dataclass(frozen=True)
class Image:
    """A picture of a recording: its key in the file, its time (s), and the index of the first event that follows it."""

    key: str
    time: float
    event_index: int


@dataclass(frozen=True)
class EventWindow:
    """Events ``start:stop``, from ``begin`` to ``end`` seconds; ``target`` is the picture at the end, or None."""

    start: int
    stop: int
    begin: float
    end: float
    target: Image | None


@contextlib.contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Errors of h5py while it looks into a file or reads from it, as ours."""
    try:
        yield
    except (OSError, RuntimeError, KeyError, ValueError) as error:
        raise UsageError(
            f"{path} cannot be read as HDF5: {error} (it is damaged, or compressed by a filter whose plugin is not "
            "found in HDF5_PLUGIN_PATH)"
        ) from error


class _Times(Sequence[float]):
    """``events/ts`` as a sequence that bisection can search: reads blocks, keeps the last ones."""

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
    """One h5 file. A context manager.

    Args:
        path: of the file; opened for reading.
        as_published: see the module.
        size: height and width of the sensor, where there is no picture to tell them; None: what the file states.

    Attributes:
        name: of the sequence, the file's name without its ending.
        size: height and width of the sensor.
        images: in order; may be empty.
        repaired_images: how many time stamps were mended.

    Raises:
        UsageError: no such file, not of this layout, or its clocks do not fit together.
    """

    def __init__(self, path: str | Path, *, as_published: bool = False, size: tuple[int, int] | None = None) -> None:
        self.path = Path(path)
        self._given_size = size
        self.name = self.path.stem
        if not self.path.is_file():
            raise UsageError(f"no file {self.path}")
        try:
            self._file = h5py.File(self.path, "r")
        except OSError as error:
            raise UsageError(f"{self.path} cannot be read as HDF5: {error}") from error
        try:
            with _reading(self.path):
                self._columns = self._checked_columns()
                self._times = _Times(self._columns["ts"], self.path)
                self.repaired_images = 0
                self.images = self._listed_images(as_published)
                self.size = self._sensor_size()
        except BaseException:
            self._file.close()
            raise

    def __enter__(self) -> Recording:
        return self

    def __exit__(self, *_error: object) -> None:
        self._file.close()

    def __len__(self) -> int:
        """Number of events."""
        return len(self._times)

    @property
    def span(self) -> tuple[float, float]:
        """Times of the first and the last event, seconds."""
        return self._times[0], self._times[len(self._times) - 1]

    def _checked_columns(self) -> dict[str, h5py.Dataset]:
        columns = {name: self._file.get(f"events/{name}") for name in layout.EVENT_COLUMNS}
        missing = [name for name, column in columns.items() if not isinstance(column, h5py.Dataset)]
        if missing:
            raise UsageError(
                f"{self.path} has no events/{missing[0]}: it is not in the layout of v2v-eval. v2v-convert makes that "
                "from raw recordings"
            )
        for name, column in columns.items():
            if column.ndim != 1 or (name in ("xs", "ys") and column.dtype.kind not in "iu"):
                raise UsageError(
                    f"{self.path}: events/{name} is {column.dtype} {list(column.shape)}, not a column [N], of whole "
                    "numbers for coordinates"
                )
        lengths = {len(column) for column in columns.values()}
        if lengths == {0} or len(lengths) > 1:
            raise UsageError(f"{self.path}: columns of events have {sorted(lengths)} entries")
        return columns

    def _listed_images(self, as_published: bool) -> tuple[Image, ...]:
        group = self._file.get("images", {})
        keys = sorted(group)
        if not keys:
            return ()
        name = "event_idx_published" if as_published else "event_idx"
        indices, stamps = [], []
        for key in keys:
            # Of one picture after the other: attributes keep their picture open, which takes 16 kB.
            attributes = group[key].attrs
            published = attributes.get(name)
            indices.append(attributes.get("event_idx") if published is None else published)
            stamps.append(attributes.get("timestamp"))
        if any(index is None for index in indices):
            raise UsageError(f"{self.path}: pictures without the attribute event_idx")
        stored = [int(index) for index in indices]
        if any(stamp is None for stamp in stamps):
            times = [self._times[min(index, len(self) - 1)] for index in stored]
            return self._paired(keys, times, stored)
        times = [float(stamp) for stamp in stamps]
        if as_published:
            return self._paired(keys, times, stored)
        first, last = self.span
        if times[-1] < first - CLOCK_SLACK_SECONDS or times[0] > last + CLOCK_SLACK_SECONDS:
            raise self._two_clocks(times)
        times = self._increasing(times)
        for time, index in zip(times, stored, strict=True):
            # Beyond the events, and yet with events on either side, as where one clock counts microseconds.
            if (time < first - CLOCK_SLACK_SECONDS and index > 1) or (
                time > last + CLOCK_SLACK_SECONDS and index < len(self) - 1
            ):
                raise self._two_clocks(times)
        return self._paired(keys, times, [bisect.bisect_left(self._times, time) for time in times])

    def _two_clocks(self, times: Sequence[float]) -> UsageError:
        first, last = self.span
        return UsageError(
            f"{self.path}: pictures are from {times[0]:.3f} to {times[-1]:.3f} s, events from {first:.3f} to "
            f"{last:.3f} s: not one clock. Convert the recording again with v2v-convert, or trust its event_idx with "
            "--as-published"
        )

    def _paired(self, keys: Sequence[str], times: Sequence[float], indices: Sequence[int]) -> tuple[Image, ...]:
        return tuple(Image(f"images/{key}", time, index) for key, time, index in zip(keys, times, indices, strict=True))

    def _increasing(self, times: Sequence[float]) -> list[float]:
        """Each time that is not later than the one before becomes the mean of its neighbours."""
        mended = list(times)
        for index in range(1, len(mended)):
            if mended[index] > mended[index - 1]:
                continue
            after = mended[index + 1] if index + 1 < len(mended) else 2 * mended[index - 1] - mended[max(0, index - 2)]
            if after <= mended[index - 1]:
                raise UsageError(
                    f"{self.path}: the times of pictures {index} and {index + 1} are not later than that of picture "
                    f"{index - 1}, {mended[index - 1]:.6f} s; only single ones can be mended"
                )
            mended[index] = (mended[index - 1] + after) / 2
            self.repaired_images += 1
        return mended

    def _sensor_size(self) -> tuple[int, int]:
        if self.images:
            shape = self._file[self.images[0].key].shape
            if len(shape) != 2:
                raise UsageError(f"{self.path}: {self.images[0].key} is {list(shape)}, not [H, W]")
            return int(shape[0]), int(shape[1])
        if self._given_size is not None:
            return self._given_size
        stated = self._file.attrs.get("sensor_resolution", self._file.get("sensor_resolution"))
        if stated is None or len(stated) != 2:
            raise UsageError(
                f"{self.path} has neither pictures nor sensor_resolution: say the sensor's size with --size WxH"
            )
        return int(stated[0]), int(stated[1])

    def windows(
        self, cut: tuple[float, float] | None = None, *, pictures: int = 1, later: int = 0
    ) -> list[EventWindow]:
        """Windows from picture to picture.

        Args:
            cut: from which second on and before which, counted from the first picture of the recording; None takes
                all pictures.
            pictures: how many pictures on a window ends; those between are not looked at.
            later: by how many pictures the cut begins and ends later.

        Raises:
            UsageError: fewer than two pictures in the cut, or the recording ends before the cut does; ``pictures`` not
                above 0.
        """
        if pictures < 1:
            raise UsageError(f"windows of {pictures} pictures: give at least 1")
        if not self.images:
            raise UsageError(f"{self.path} has no pictures to compare with; --fps reconstructs without")
        found = self._images_in(cut, later)
        images = found[::pictures]
        if len(images) < 2:
            raise UsageError(
                f"{self.path}: {len(found)} pictures{'' if cut is None else f' in the cut {cut}'}; "
                f"{pictures + 1} or more make a window"
            )
        return [
            EventWindow(one.event_index, max(one.event_index, other.event_index), one.time, other.time, other)
            for one, other in itertools.pairwise(images)
        ]

    def _images_in(self, cut: tuple[float, float] | None, later: int = 0) -> list[Image]:
        images = list(self.images)
        if cut is not None and images:
            start, end = cut
            zero, last = images[0].time, images[-1].time - images[0].time
            # A recording that was cut before would be cut twice. One that begins at 0 cannot be mistaken.
            if start > 0 and last < end - CLOCK_SLACK_SECONDS:
                raise UsageError(
                    f"{self.path} lasts {last:.2f} s, and the cut is from {start:g} to {end:g} s: if it is already "
                    "cut, give --cuts none"
                )
            since = [image.time - zero for image in images]
            images = images[bisect.bisect_left(since, start) + later : bisect.bisect_left(since, end) + later]
        return images

    def flow_windows(self, cut: tuple[float, float] | None = None, *, one_later: bool = False) -> list[EventWindow]:
        """Windows between the times of consecutive flow fields; the target is the field of the window.

        Args:
            cut: from which second on and before which, counted from the first picture of the recording, else its
                first field.
            one_later: pair each window with the field at its end, as V2V's released code does, not that at its start.

        Raises:
            UsageError: fewer than two fields in the cut.
        """
        with _reading(self.path):
            group = self._file.get("flow", {})
            fields = [Image(f"flow/{key}", float(group[key].attrs["timestamp"]), 0) for key in sorted(group)]
        if cut is not None and fields:
            zero = self.images[0].time if self.images else fields[0].time
            fields = [each for each in fields if cut[0] <= each.time - zero < cut[1]]
        if len(fields) < 2:
            raise UsageError(
                f"{self.path} has {len(fields)} flow fields{f' in the cut {cut}' if cut else ''}; two or more make a "
                "window. v2v-convert takes MVSEC's from *_gt.hdf5 beside *_data.hdf5"
            )
        made = []
        for one, other in itertools.pairwise(fields):
            start, stop = (bisect.bisect_left(self._times, each.time) for each in (one, other))
            made.append(EventWindow(start, max(start, stop), one.time, other.time, other if one_later else one))
        return made

    def flow(self, window: EventWindow) -> npt.NDArray[np.float32]:
        """The field of a window of :meth:`flow_windows`, [2, H, W] (x, y) px; NaN or 0 where it is not known.

        Raises:
            UsageError: it cannot be read, or is of another size.
        """
        assert window.target is not None
        with _reading(self.path):
            field: npt.NDArray[np.float32] = self._file[window.target.key][:].astype(np.float32)
        if field.shape != (2, *self.size):
            raise UsageError(f"{self.path}: {window.target.key} is {list(field.shape)}, not {[2, *self.size]}")
        return field

    def regular_windows(self, fps: float) -> list[EventWindow]:
        """Windows of equal length from the first event to the last; without targets.

        Raises:
            UsageError: ``fps`` not above 0, or the recording is shorter than one window.
        """
        if not fps > 0:
            raise UsageError(f"{fps:g} windows a second: give more than 0")
        first, last = self.span
        count = int((last - first) * fps + 1e-9)
        if count < 1:
            raise UsageError(f"{self.path} lasts {last - first:.3f} s, less than one window at {fps:g} a second")
        edges = [first + step / fps for step in range(count + 1)]
        indices = [bisect.bisect_left(self._times, edge) for edge in edges]
        return [EventWindow(indices[i], indices[i + 1], edges[i], edges[i + 1], None) for i in range(count)]

    def windows_of_seconds(self, seconds: float, cut: tuple[float, float] | None = None) -> list[EventWindow]:
        """Windows of equal length in time, without regard to pictures; :meth:`_with_targets` says which are scored.

        Args:
            seconds: of each.
            cut: as for :meth:`windows`; None takes all events.

        Raises:
            UsageError: ``seconds`` not above 0, or less than one window.
        """
        if not seconds > 0:
            raise UsageError(f"windows of {seconds:g} s: give more than 0")
        first, last, images = self._scored_span(cut)
        count = int((last - first) / seconds + 1e-9)
        if count < 1:
            raise UsageError(f"{self.path}: {last - first:.3f} s are less than one window of {seconds:g} s")
        edges = [first + step * seconds for step in range(count + 1)]
        indices = [bisect.bisect_left(self._times, edge) for edge in edges]
        return self._with_targets(
            [EventWindow(indices[i], indices[i + 1], edges[i], edges[i + 1], None) for i in range(count)], images
        )

    def windows_of_events(self, events: int, cut: tuple[float, float] | None = None) -> list[EventWindow]:
        """Windows of as many events each, which are short where much moves; the rest at the end is left out.

        Args:
            events: of each.
            cut: as for :meth:`windows`; None takes all events.

        Raises:
            UsageError: ``events`` not above 0, or less than one window.
        """
        if events < 1:
            raise UsageError(f"windows of {events} events: give at least 1")
        first, last, images = self._scored_span(cut)
        begin, end = bisect.bisect_left(self._times, first), bisect.bisect_right(self._times, last)
        if end - begin < events:
            raise UsageError(f"{self.path}: {end - begin} events are less than one window of {events}")
        starts = range(begin, end - events + 1, events)
        ends = [self._times[min(start + events, len(self) - 1)] for start in starts]
        begins = [first, *ends[:-1]]
        return self._with_targets(
            [
                EventWindow(start, start + events, at, until, None)
                for start, at, until in zip(starts, begins, ends, strict=True)
            ],
            images,
        )

    def _scored_span(self, cut: tuple[float, float] | None) -> tuple[float, float, list[Image]]:
        first, last = self.span
        images = self._images_in(cut)
        if cut is not None and self.images:
            zero = self.images[0].time
            first, last = max(first, zero + cut[0]), min(last, zero + cut[1])
        return first, last, images

    @staticmethod
    def _with_targets(windows: Sequence[EventWindow], images: Sequence[Image]) -> list[EventWindow]:
        """Each picture is the target of the window whose end is nearest to it, if that is at most half a window away;
        of several for one window, the nearest."""
        ends = [window.end for window in windows]
        nearest: dict[int, tuple[float, Image]] = {}
        for image in images:
            after = bisect.bisect_left(ends, image.time)
            places = [place for place in (after - 1, after) if 0 <= place < len(ends)]
            place = min(places, key=lambda place: abs(ends[place] - image.time))
            away = abs(ends[place] - image.time)
            if 2 * away <= windows[place].end - windows[place].begin and away < nearest.get(place, (away + 1,))[0]:
                nearest[place] = away, image
        return [
            dataclasses.replace(window, target=nearest[place][1]) if place in nearest else window
            for place, window in enumerate(windows)
        ]

    def events(self, window: EventWindow) -> Events:
        """The events of a window, in order of time.

        Raises:
            UsageError: they cannot be read, or come too late or too early to be of this window.
        """
        part = slice(window.start, window.stop)
        with _reading(self.path):
            events = Events(
                self._columns["ts"][part].astype(np.float64),
                self._columns["xs"][part],
                self._columns["ys"][part],
                np.where(self._columns["ps"][part] > 0, np.float32(1), np.float32(-1)),
            )
        return _in_order(events, window, self.path)

    def image(self, image: Image) -> npt.NDArray[np.uint8]:
        """Its pixels, uint8 [H, W].

        Raises:
            UsageError: it cannot be read, or is of another dtype or size than the first picture.
        """
        with _reading(self.path):
            pixels = self._file[image.key][:]
        if pixels.dtype != np.uint8 or pixels.shape != self.size:
            raise UsageError(
                f"{self.path}: {image.key} is {pixels.dtype} {list(pixels.shape)}, not uint8 {list(self.size)}"
            )
        return np.asarray(pixels)


def _in_order(events: Events, window: EventWindow, path: Path) -> Events:
    """Those that come a little late sorted in, as sensors and files have some; where one lies further outside of its
    window than this is long, the file has no order in which windows could be searched.
    """
    t = events.t
    if (t[1:] >= t[:-1]).all():
        return events
    reach = window.end - window.begin
    within = (t >= window.begin - reach) & (t <= window.end + reach)
    if not within.all():
        at = int(np.flatnonzero(~within)[0])
        raise UsageError(
            f"{path}: events are not in order of time: event {window.start + at}, at {t[at]:.6f} s, lies among those "
            f"from {window.begin:.6f} to {window.end:.6f} s. Sort the file"
        )
    order = np.argsort(t, kind="stable")
    return Events(t[order], events.x[order], events.y[order], events.p[order])
