"""Define the items that readers of raw recordings yield, in any order: sensor size, chunks of events, pictures, flow.

Times are int64 nanoseconds of the recording's own clock. Nanoseconds since 1970 fit until 2262 and subtract exactly;
seconds since 1970 in float64 are 0.24 us apart.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import UsageError

MOST_SENSOR_PIXELS = 1 << 24
"""Limit of a stated sensor's size: 4096 x 4096. Some arrays have an entry for each pixel."""
NS_PER_UNIT = {"s": 1e9, "ms": 1e6, "us": 1e3, "ns": 1.0}
ReadProgress = Callable[[int, int | None], None]
"""Progress callback: called with the amount read so far (bytes or messages), and the total if it is known."""


@dataclass(frozen=True, eq=False)
class EventChunk:
    """Hold consecutive events of a recording.

    Attributes:
        t_ns: int64 [N].
        x, y: integers [N], pixels, origin at the upper left.
        p: bool [N], True for a brightness increase.
    """

    t_ns: npt.NDArray[np.int64]
    x: npt.NDArray[np.integer]
    y: npt.NDArray[np.integer]
    p: npt.NDArray[np.bool_]

    def __post_init__(self) -> None:
        lengths = {len(self.t_ns), len(self.x), len(self.y), len(self.p)}
        if len(lengths) > 1:
            raise UsageError(f"the columns of events have different lengths: {sorted(lengths)}")

    def __len__(self) -> int:
        return len(self.t_ns)

    @classmethod
    def join(cls, chunks: Iterable[EventChunk]) -> EventChunk:
        """Return the events of chunks, at least one, in one."""
        return cls(*map(np.concatenate, zip(*((each.t_ns, each.x, each.y, each.p) for each in chunks), strict=True)))

    def part(self, first: int, last: int | None = None) -> EventChunk:
        """Return the events ``first:last``, as a view."""
        return self.take(slice(first, last))

    def take(self, chosen: slice | npt.NDArray[np.intp]) -> EventChunk:
        """Return the events of these places, a slice or [n]."""
        return EventChunk(self.t_ns[chosen], self.x[chosen], self.y[chosen], self.p[chosen])


NO_EVENTS = EventChunk(np.empty(0, np.int64), np.empty(0, np.uint16), np.empty(0, np.uint16), np.empty(0, bool))


@dataclass(frozen=True, eq=False)
class Picture:
    """Hold a frame of the same sensor.

    Attributes:
        t_ns: time of the frame.
        pixels: uint8 [H, W].
        published_event_index: index of the event that the published conversion pairs with this picture; None if the
            raw form does not state it.
    """

    t_ns: int
    pixels: npt.NDArray[np.uint8]
    published_event_index: int | None = None


@dataclass(frozen=True)
class SensorSize:
    """Hold the size of the sensor, in pixels."""

    width: int
    height: int

    @classmethod
    def parse(cls, text: str) -> SensorSize:
        """Parse WIDTHxHEIGHT, such as ``346x260``.

        Raises:
            UsageError: the text has another form, or :meth:`require_usable`.
        """
        width, _, height = text.lower().partition("x")
        if not (width.isdecimal() and height.isdecimal()):
            raise UsageError(f"size {text!r}: give WIDTHxHEIGHT in pixels, as in 346x260")
        return cls(int(width), int(height)).require_usable("--size")

    def require_usable(self, where: str) -> SensorSize:
        """Return this size if memory for such a sensor may be taken; ``where`` begins the error message.

        Raises:
            UsageError: a side is below 1, or there are more than MOST_SENSOR_PIXELS.
        """
        if min(self.width, self.height) < 1 or self.width * self.height > MOST_SENSOR_PIXELS:
            raise UsageError(
                f"{where}: a sensor of {self.width} x {self.height} px; sides must be at least 1, and width x height "
                f"at most {MOST_SENSOR_PIXELS:,} px: correct the size"
            )
        return self


@dataclass(frozen=True, eq=False)
class FlowField:
    """Hold the true flow from a time to that of the next field.

    Attributes:
        t_ns: time at which it begins.
        flow: float32 [2, H, W] (x, y), px; NaN where it is not known.
    """

    t_ns: int
    flow: npt.NDArray[np.float32]


@dataclass(frozen=True)
class Note:
    """Hold a sentence for the user about the recording, such as where it was cut."""

    text: str


@dataclass(frozen=True)
class Light:
    """Say how the grey levels of pictures follow light.

    Attributes:
        name: "linear", "srgb", or the exponent.
        gamma: light is a grey level to this power; 0: the curve of sRGB.
    """

    name: str
    gamma: float

    @classmethod
    def parse(cls, text: str) -> Light:
        """Read a name or an exponent.

        Raises:
            UsageError: it is neither.
        """
        known = {"linear": 1.0, "srgb": 0.0}
        try:
            gamma = known[text] if text in known else float(text)
        except ValueError:
            gamma = math.nan
        if text not in known and not 0.05 <= gamma <= 20.0:
            raise UsageError(f"light {text!r}: give linear, srgb or an exponent from 0.05 to 20, such as 2.2")
        return cls("linear" if gamma == 1.0 else f"{gamma:g}" if gamma else "srgb", gamma)

    def of(self, grey: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
        """Return light, [...], 0 (black) to 1 (white), of grey levels 0 .. 255."""
        share = np.asarray(grey, np.float64) / 255.0
        if self.gamma:
            return np.asarray(share**self.gamma)
        return np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)


Item = EventChunk | Picture | SensorSize | FlowField | Note | Light


@dataclass(frozen=True)
class ConvertOptions:
    """Hold information that some raw forms lack and the user supplies.

    Attributes:
        size: size of the sensor, if the file does not state it.
        time_unit: unit "s", "ms", "us" or "ns" of the times of events in text, NumPy's files and HDF5; None takes what
            the file states, else what is usual.
        camera: "left" or "right" of a stereo recording (MVSEC).
        events_topic, images_topic: topics to read from a bag that has several.
        light: of the pictures; None takes what the form or the file states.
        frame_offset_ns: added to the times of the pictures.
    """

    size: SensorSize | None = None
    time_unit: str | None = None
    camera: str = "left"
    events_topic: str | None = None
    images_topic: str | None = None
    light: Light | None = None
    frame_offset_ns: int = 0


def add_options(group: argparse._ArgumentGroup) -> None:
    """Add the flags of :class:`ConvertOptions`."""
    group.add_argument("--size", metavar="WxH", help="size of the sensor in px, if a recording does not state it")
    group.add_argument(
        "--time-unit", choices=tuple(NS_PER_UNIT),
        help="unit of the events' times in text, NumPy's files and HDF5 (default: as the file states, else s if they "
        "have a decimal point, us if not)",
    )  # fmt: skip
    group.add_argument(
        "--camera", choices=("left", "right"), default="left",
        help="camera of a stereo recording (MVSEC; default left)",
    )  # fmt: skip
    group.add_argument("--events-topic", metavar="TOPIC", help="topic of events, for a bag with several")
    group.add_argument("--images-topic", metavar="TOPIC", help="topic of pictures, for a bag with several")
    group.add_argument(
        "--light", metavar="CURVE",
        help="light of the pictures: linear, srgb, or the exponent of their light, such as 2.2 (default: that of the "
        "camera or file, if it is known)",
    )  # fmt: skip
    group.add_argument(
        "--frame-offset", default="0", metavar="MS", help="milliseconds to add to the times of the pictures"
    )


def options_of(arguments: argparse.Namespace) -> ConvertOptions:
    """Return the options that the flags of :func:`add_options` state.

    Raises:
        UsageError: a flag has a wrong value.
    """
    try:
        offset_ns = round(1e6 * float(arguments.frame_offset))
    except (ValueError, OverflowError):
        raise UsageError(f"--frame-offset {arguments.frame_offset}: give milliseconds, such as 7 or -2.5") from None
    return ConvertOptions(
        size=None if arguments.size is None else SensorSize.parse(arguments.size),
        time_unit=arguments.time_unit,
        camera=arguments.camera,
        events_topic=arguments.events_topic,
        images_topic=arguments.images_topic,
        light=None if arguments.light is None else Light.parse(arguments.light),
        frame_offset_ns=offset_ns,
    )
