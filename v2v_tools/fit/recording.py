"""Read a recording once, and keep what a fit needs: the events and frames of some pixels, and counts of all pixels."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import UsageError
from v2v_recordings.items import ConvertOptions, EventChunk, Light, Note, Picture, ReadProgress, SensorSize
from v2v_recordings.reading import read_items
from v2v_tools.fit.interval import SIDE

MOST_PIXELS = 1 << 15
"""Pixels whose events and frames are kept at first."""
MOST_EVENTS, MOST_FRAME_PIXELS = 4_000_000, 16_000_000
"""Limits of what is kept of these pixels: with more, half of the tiles are dropped."""
TILE_PX = 16
Longs = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Recorded:
    """Events and frames of P pixels of a sensor.

    Attributes:
        height_px, width_px: size of the sensor.
        pixels: [P] int64, places of the pixels in row order, ascending.
        first: [P + 1] int64; the events of pixel i are ``first[i] : first[i + 1]``, in order of time.
        t_us: [N] int64, microseconds.
        p: [N] bool, True for brighter.
        frames: [n, P] uint8 grey levels; n is 0 without frames.
        frame_us: [n] int64, time of each frame, ascending.
        counts: [2, H, W] int64, darker and brighter events of the whole sensor.
        seconds: time from the first to the last event or frame.
        notes: sentences of the reader for the user.
        light: of the frames; None: not known.
    """

    height_px: int
    width_px: int
    pixels: Longs
    first: Longs
    t_us: Longs
    p: npt.NDArray[np.bool_]
    frames: npt.NDArray[np.uint8]
    frame_us: Longs
    counts: Longs
    seconds: float
    notes: tuple[str, ...] = ()
    light: Light | None = None

    @property
    def known_light(self) -> Light:
        """Return the light of the frames.

        Raises:
            UsageError: it is not known.
        """
        if self.light is None:
            raise UsageError(
                "the recording does not state the light of its frames, and a fit depends on it: give --light linear "
                "(as a DAVIS stores them), srgb, or the exponent of their light, such as 2.2"
            )
        return self.light

    def blocks(self) -> Longs:
        """Return the block of each pixel, [P], 0 .. SIDE * SIDE - 1: the sensor in rows and columns of equal parts."""
        y, x = np.divmod(self.pixels, self.width_px)
        return np.asarray((y * SIDE // self.height_px) * SIDE + x * SIDE // self.width_px)


def chosen_pixels(height_px: int, width_px: int, most: int | None = None) -> Longs:
    """Return the pixels that a fit looks at, [P]: tiles spread over the sensor, fewer of them being a part of more.

    Args:
        most: number of pixels; None: MOST_PIXELS.
    """
    y, x = np.divmod(np.arange(height_px * width_px), width_px)
    tile = y // TILE_PX * -(-width_px // TILE_PX) + x // TILE_PX
    rank = np.random.default_rng(0).permutation(tile[-1] + 1)[tile]
    return np.sort(np.argsort(rank, kind="stable")[: most or MOST_PIXELS])


def recorded(
    height_px: int,
    width_px: int,
    t_us: Longs,
    place: Longs,
    p: npt.NDArray[np.bool_],
    frames: npt.NDArray[np.uint8],
    frame_us: Longs,
    counts: Longs | None = None,
    pixels: Longs | None = None,
    light: Light | None = None,
) -> Recorded:
    """Build a recording from events in any order.

    Args:
        t_us, place, p: [N] time, pixel in row order, polarity.
        frames: [n, P] of ``pixels``, or [n, H, W].
        counts: see :class:`Recorded`; None counts the events given.
        pixels: [P] pixels to keep, in row order; None: :func:`chosen_pixels`.
        light: of the frames, if it is known.

    Raises:
        UsageError: there are no events.
    """
    if not len(t_us):
        raise UsageError("the recording has no events: a fit needs at least some seconds of them")
    if counts is None:
        counts = np.stack([np.bincount(place[p == sign], minlength=height_px * width_px) for sign in (False, True)])
        counts = counts.reshape(2, height_px, width_px)
    pixels = chosen_pixels(height_px, width_px) if pixels is None else pixels
    index = _index(pixels, height_px * width_px)
    kept = index[place] >= 0
    t_us, of_pixel, p = t_us[kept], index[place[kept]], p[kept]
    order = np.lexsort((t_us, of_pixel))
    if frames.ndim == 3:
        frames = frames.reshape(len(frames), height_px * width_px)[:, pixels]
    in_time = np.argsort(frame_us, kind="stable")
    in_time = in_time[np.concatenate([[True], np.diff(frame_us[in_time]) > 0])] if len(in_time) else in_time
    times = np.concatenate([t_us, frame_us])
    return Recorded(
        height_px, width_px, pixels, np.searchsorted(of_pixel[order], np.arange(len(pixels) + 1)), t_us[order],
        p[order], np.ascontiguousarray(frames[in_time]), frame_us[in_time], counts,
        float(times.max() - times.min()) * 1e-6, light=light,
    )  # fmt: skip


def read_recording(
    path: str | Path, options: ConvertOptions | None = None, progress: ReadProgress = lambda _done, _total: None
) -> Recorded:
    """Read a recording of any form that ``v2v-convert`` reads, chunk by chunk.

    Raises:
        UsageError: the form is not known, the file is damaged or has no events, or its sensor's size is not known.
    """
    path, options = Path(path), options or ConvertOptions()
    size, light, kept, notes = options.size, options.light, None, []
    for item in read_items(path, None, options, progress):
        if isinstance(item, Note):
            notes.append(item.text)
            continue
        if isinstance(item, Light):
            light = item
            continue
        if isinstance(item, Picture):
            size = size or SensorSize(*item.pixels.shape[::-1])
        elif isinstance(item, SensorSize):
            size = size or item
        if size is None:
            raise UsageError(f"{path} does not state the size of the sensor: give --size WIDTHxHEIGHT")
        kept = kept or _Kept(size)
        if isinstance(item, Picture):
            kept.add_frame(item, path)
        elif isinstance(item, EventChunk) and len(item):
            kept.add_events(item, path)
    if kept is None or not kept.event_count:
        raise UsageError(f"{path} has no events")
    return dataclasses.replace(kept.recorded(), notes=tuple(notes), light=light)


class _Kept:
    """What is kept of a recording while it is read."""

    def __init__(self, size: SensorSize) -> None:
        self._size = size
        self._pixels = chosen_pixels(size.height, size.width)
        self._index = _index(self._pixels, size.height * size.width)
        self._counts = np.zeros(2 * size.height * size.width, np.int64)
        self._events: list[tuple[npt.NDArray[Any], ...]] = []
        self._frames: list[npt.NDArray[np.uint8]] = []
        self._frame_us: list[int] = []
        self.event_count = 0

    def add_frame(self, picture: Picture, path: Path) -> None:
        """Add a frame.

        Raises:
            UsageError: it has another size than the sensor.
        """
        if picture.pixels.shape != (self._size.height, self._size.width):
            raise UsageError(
                f"{path}: a frame is {list(picture.pixels.shape)}, and the sensor "
                f"{self._size.width}x{self._size.height}: correct --size"
            )
        self._frames.append(picture.pixels.reshape(-1)[self._pixels])
        self._frame_us.append(picture.t_ns // 1000)
        while len(self._frames) * len(self._pixels) > MOST_FRAME_PIXELS:
            self._halve()

    def add_events(self, chunk: EventChunk, path: Path) -> None:
        """Add events.

        Raises:
            UsageError: one lies outside the sensor.
        """
        width, height = self._size.width, self._size.height
        if not (0 <= chunk.x.min() <= chunk.x.max() < width and 0 <= chunk.y.min() <= chunk.y.max() < height):
            raise UsageError(f"{path}: an event lies outside {width}x{height} px: correct --size")
        place = chunk.y.astype(np.int64) * width + chunk.x
        self._counts += np.bincount(place + chunk.p * (width * height), minlength=len(self._counts))
        mine = self._index[place] >= 0
        self._events.append((chunk.t_ns[mine] // 1000, place[mine].astype(np.int32), chunk.p[mine]))
        self.event_count += int(mine.sum())
        while self.event_count > MOST_EVENTS:
            self._halve()

    def recorded(self) -> Recorded:
        """Return the recording, its time from 0 on, without frames 50 us after the last event and later."""
        t_us, place, p = (np.concatenate(column) for column in zip(*self._events, strict=True))
        self._events.clear()
        begun = int(t_us.min())
        shown = np.array(self._frame_us, np.int64) - begun
        within = shown <= int(t_us.max()) - begun + 50  # a recording that ends with a frame has no event after it
        frames = np.stack(self._frames) if self._frames else np.empty((0, len(self._pixels)), np.uint8)
        return recorded(
            self._size.height, self._size.width, t_us - begun, place.astype(np.int64), p, frames[within], shown[within],
            self._counts.reshape(2, self._size.height, self._size.width), self._pixels,
        )  # fmt: skip

    def _halve(self) -> None:
        """Drop half of the tiles."""
        fewer = chosen_pixels(self._size.height, self._size.width, max(1, len(self._pixels) // 2))
        stays, self._pixels = np.isin(self._pixels, fewer), fewer
        self._index = _index(self._pixels, self._size.height * self._size.width)
        self._frames = [frame[stays] for frame in self._frames]
        kept = [self._index[place] >= 0 for _, place, _ in self._events]
        self._events = [tuple(part[mine] for part in chunk) for chunk, mine in zip(self._events, kept, strict=True)]
        self.event_count = sum(int(mine.sum()) for mine in kept)


def _index(pixels: Longs, count: int) -> Longs:
    """Return the number of each pixel of the sensor among those kept, or -1: [count]."""
    index = np.full(count, -1, np.int64)
    index[pixels] = np.arange(len(pixels))
    return index
