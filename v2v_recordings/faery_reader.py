"""Read files with the faery package: aedat4 of DAVIS cameras, and Event Stream.

A file that ends within an event or packet is read up to it.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import UsageError
from v2v_recordings.archive import package
from v2v_recordings.items import ConvertOptions, EventChunk, Item, Note, Picture, ReadProgress, SensorSize

ES_HEAD_BYTES, ES_EVENT_BYTES, ES_LONGEST_STEP_US = 20, 5, 127
"""Bytes before the first event and of an event; a longer time between two events is bytes of 0xff of this length."""
CUT_PACKET = "failed to fill whole buffer"
"""Error of faery where a packet of aedat4 is longer than the file."""
_TO_GREY = {"RGB": cv2.COLOR_RGB2GRAY, "RGBA": cv2.COLOR_RGBA2GRAY}


def read_aedat4(path: Path, options: ConvertOptions, progress: ReadProgress) -> Iterator[Item]:
    """Yield events and frames of a file's first camera. A frame's time is the middle of its exposure.

    Raises:
        UsageError: the file is damaged or has no events, or its frames are not 8-bit or not of the whole sensor.
    """
    with _errors_of_faery(path), package("faery", "this form").aedat.Decoder(path) as decoder:
        first = {track.data_type: track for track in reversed(decoder.tracks())}
        if "events" not in first:
            raise UsageError(f"{path} has no stream of events")
        size = SensorSize(*first["events"].dimensions)
        yield size
        total, number = len(decoder.file_data_definitions()) or None, 0
        try:
            for number, (track, packet) in enumerate(decoder, start=1):
                kind = track.data_type if track.id == first[track.data_type].id else ""
                if kind in ("events", "frame"):
                    yield _events(packet) if kind == "events" else _frame(packet, size, path)
                progress(number, total)
        except RuntimeError as error:
            if not number or CUT_PACKET not in str(error):
                raise
            yield Note(f"cut: packet {number + 1} is incomplete; the {number} before it are read")


def read_es(path: Path, _options: ConvertOptions, progress: ReadProgress) -> Iterator[Item]:
    """Yield events of an Event Stream file of a camera without grey levels.

    Raises:
        UsageError: the file is damaged or holds something else.
    """
    end, last_us = ES_HEAD_BYTES, 0
    with _errors_of_faery(path), package("faery", "this form").es.Decoder(path, 0) as decoder:
        if decoder.event_type != "dvs":
            raise UsageError(f"{path} holds {decoder.event_type} events; only dvs can be read")
        yield SensorSize(*decoder.dimensions)
        for events in decoder:
            events["y"] = decoder.dimensions[1] - 1 - events["y"]  # rows are counted from below
            yield _events(events)
            steps = np.diff(events["t"].astype(np.int64), prepend=last_us)
            end += ES_EVENT_BYTES * len(events) + int((steps // ES_LONGEST_STEP_US).sum())
            last_us = int(events["t"][-1])
            progress(end, path.stat().st_size)
    if over := path.stat().st_size - end:
        yield Note(f"cut: the last {over} bytes are an incomplete event and left out")


def _events(packet: npt.NDArray[Any]) -> EventChunk:
    t, x, y, polarity = (packet[name] for name in packet.dtype.names or ())
    return EventChunk(t.astype(np.int64) * 1000, x, y, polarity > 0)


def _frame(frame: Any, size: SensorSize, path: Path) -> Picture:
    pixels = frame.pixels
    if frame.format in _TO_GREY:
        pixels = cv2.cvtColor(pixels, _TO_GREY[frame.format])
    if pixels.dtype != np.uint8 or pixels.shape != (size.height, size.width):
        raise UsageError(
            f"{path}: a frame is {frame.format} {list(pixels.shape)} at ({frame.offset_x}, {frame.offset_y}); only "
            f"8-bit frames of the whole sensor, {size.width} x {size.height}, can be converted"
        )
    return Picture(int(frame.t) * 1000, pixels)


@contextlib.contextmanager
def _errors_of_faery(path: Path) -> Iterator[None]:
    try:
        yield
    except BaseException as error:
        # A Rust panic on unexpected bytes cannot be imported, and is not a subclass of Exception.
        is_panic = type(error).__name__ == "PanicException"
        if not is_panic and not isinstance(error, (RuntimeError, OSError, ValueError, IndexError)):
            raise
        raise UsageError(f"{path} cannot be decoded: {error}") from error
