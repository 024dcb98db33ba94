"""Define the items that readers of raw recordings yield, in any order: sensor size, chunks of events, pictures, flow.

Times are int64 nanoseconds of the recording's own clock. Nanoseconds since 1970 fit until 2262 and subtract exactly;
seconds since 1970 in float64 are 0.24 us apart.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import UsageError

MOST_SENSOR_PIXELS = 1 << 24
"""Limit of a stated sensor's size: 4096 x 4096. Some arrays have an entry for each pixel."""
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
        if {self.x.dtype.kind, self.y.dtype.kind} - {"i", "u"}:
            raise UsageError(f"coordinates of events are {self.x.dtype} and {self.y.dtype}: they must be integers")

    def __len__(self) -> int:
        return len(self.t_ns)

    def part(self, first: int, last: int | None = None) -> EventChunk:
        """Return the events ``first:last``."""
        chosen = slice(first, last)
        return EventChunk(self.t_ns[chosen], self.x[chosen], self.y[chosen], self.p[chosen])


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


Item = EventChunk | Picture | SensorSize | FlowField | Note


@dataclass(frozen=True)
class ConvertOptions:
    """Hold information that some raw forms lack and the user supplies.

    Attributes:
        size: size of the sensor, if the file does not state it.
        time_unit: unit "s", "us" or "ns" of the times in text files; None takes s if they have a decimal point, else
            us.
        camera: "left" or "right" of a stereo recording (MVSEC).
        events_topic, images_topic: topics to read from a bag that has several.
    """

    size: SensorSize | None = None
    time_unit: str | None = None
    camera: str = "left"
    events_topic: str | None = None
    images_topic: str | None = None


LARGEST_NS = 2.0**63
NS_PER_UNIT = {"s": 1e9, "us": 1e3, "ns": 1.0}


def to_ns(times: npt.NDArray[Any], where: str, ns_per_unit: float = 1e9) -> npt.NDArray[np.int64]:
    """Convert times to int64 nanoseconds: integers exactly, others as float64, rounded to the nearest.

    Args:
        where: beginning of the error message.
        ns_per_unit: nanoseconds per unit of ``times``; the default means seconds.

    Raises:
        UsageError: a time is NaN or does not fit int64, so its unit is probably wrong.
    """
    ns = np.rint(times.astype(np.float64) * ns_per_unit)
    held = np.abs(ns) < LARGEST_NS
    if not held.all():
        # A cast would turn all of them into the same number.
        raise UsageError(
            f"{where}: a time is {ns[~held][0] * 1e-9:.10g} s, which is out of range; give the unit of text files with "
            "--time-unit"
        )
    return times.astype(np.int64) * int(ns_per_unit) if times.dtype.kind in "iu" else ns.astype(np.int64)
