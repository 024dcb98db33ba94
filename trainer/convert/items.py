"""What every reader of a raw form yields: the size of the sensor, chunks of events, pictures; in any order.

Times are int64 nanoseconds of the recording's own clock. Nanoseconds since 1970 fit until 2262 and subtract exactly;
seconds since 1970 in float64 are 0.24 us apart.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import UsageError

Progress = Callable[[int, int | None], None]
"""Called with the bytes read so far, and the bytes in all where they are known."""


@dataclass(frozen=True, eq=False)
class EventChunk:
    """Some events of a recording.

    Attributes:
        t_ns: int64 [N].
        x, y: integers [N], pixels, origin at the upper left.
        p: bool [N], True where it got brighter.
    """

    t_ns: npt.NDArray[np.int64]
    x: npt.NDArray[np.integer]
    y: npt.NDArray[np.integer]
    p: npt.NDArray[np.bool_]

    def __post_init__(self) -> None:
        lengths = {len(self.t_ns), len(self.x), len(self.y), len(self.p)}
        if len(lengths) > 1:
            raise UsageError(f"events with columns of different lengths: {sorted(lengths)}")

    def __len__(self) -> int:
        return len(self.t_ns)


@dataclass(frozen=True, eq=False)
class Picture:
    """A frame of the same sensor.

    Attributes:
        t_ns: when it was taken.
        pixels: uint8 [H, W].
        published_event_index: index of the event that the published conversion pairs with this picture, where the raw
            form states one.
    """

    t_ns: int
    pixels: npt.NDArray[np.uint8]
    published_event_index: int | None = None


@dataclass(frozen=True)
class SensorSize:
    """What the recording states about its sensor, in pixels."""

    width: int
    height: int

    @classmethod
    def parse(cls, text: str) -> SensorSize:
        """``346x260``.

        Raises:
            UsageError: anything else.
        """
        width, _, height = text.lower().partition("x")
        if not (width.isdecimal() and height.isdecimal() and int(width) and int(height)):
            raise UsageError(f"size {text!r}: give WIDTHxHEIGHT in pixels, as in 346x260")
        return cls(int(width), int(height))


@dataclass(frozen=True, eq=False)
class FlowField:
    """True flow from a time to that of the next field.

    Attributes:
        t_ns: when it begins.
        flow: float32 [2, H, W] (x, y), px; NaN where it is not known.
    """

    t_ns: int
    flow: npt.NDArray[np.float32]


Item = EventChunk | Picture | SensorSize | FlowField


@dataclass(frozen=True)
class ConvertOptions:
    """What a user may have to say because a raw form does not.

    Attributes:
        size: of the sensor, where the file does not state it.
        time_unit: "s", "us" or "ns" of the times in text files; None takes s where they have a point, else us.
        camera: "left" or "right" of a stereo recording (MVSEC).
        events_topic, images_topic: of a bag that has several.
    """

    size: SensorSize | None = None
    time_unit: str | None = None
    camera: str = "left"
    events_topic: str | None = None
    images_topic: str | None = None


LARGEST_NS = 2.0**63


def to_ns(times: npt.NDArray[np.float64], where: str, ns_per_unit: float = 1e9) -> npt.NDArray[np.int64]:
    """float64 times, in seconds unless ``ns_per_unit`` says otherwise -> int64 nanoseconds, to the nearest.

    Raises:
        UsageError: a time that int64 cannot hold, so one of another unit, or no number; ``where`` begins the message.
    """
    ns = np.rint(times * ns_per_unit)
    held = np.abs(ns) < LARGEST_NS
    if not held.all():
        # A cast would make the same number of all of them.
        raise UsageError(
            f"{where}: a time of {ns[~held][0] * 1e-9:.10g} s, which no recording has; --time-unit gives the unit of "
            "text files"
        )
    return ns.astype(np.int64)
