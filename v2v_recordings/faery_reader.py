"""Read files with the faery package: aedat4 of DAVIS cameras; Prophesee's EVT 2 and 3 (.raw) and DAT; Event Stream.

A file that ends within an event or packet is read up to it.
"""

from __future__ import annotations

import contextlib
import itertools
import re
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import UsageError
from v2v_recordings.archive import package, starts_with
from v2v_recordings.items import ConvertOptions, EventChunk, Item, Note, Picture, ReadProgress, SensorSize

ES_HEAD_BYTES, ES_EVENT_BYTES, ES_LONGEST_STEP_US = 20, 5, 127
"""Bytes before the first event and of an event; a longer time between two events is bytes of 0xff of this length."""
CUT_PACKET = "failed to fill whole buffer"
"""Error of faery where a packet of aedat4 is longer than the file."""
EVT_LINE = re.compile(rb"^% *(evt|format) ", re.MULTILINE)
"""Line of a header that only EVT has."""
WORDS: dict[str, np.dtype[Any]] = {"evt2": np.dtype("<u4"), "evt3": np.dtype("<u2")}
"""Words of the versions that are decoded: for another one that it recognises, EVT 2.1, faery up to 0.7.1 panics."""
DAT_WORD = np.dtype("<u8")
"""An event of DAT; the lower half is its time, us."""
TIME_HIGH = 0x8
"""Value of the four upper bits of a word whose other bits are the upper bits of a time."""
TIME_HIGH_US = {8: 1, 4: 64, 2: 4096}
"""Unit of the upper bits, by the bytes of a word; DAT's words hold a whole time."""
LATEST_US = 10_000
"""The upper bits may step back by at most this without a reset."""
LOOKED_THROUGH_WORDS = 1 << 20
LONGEST_LINE_BYTES = 1 << 12
_TO_GREY = {"RGB": cv2.COLOR_RGB2GRAY, "RGBA": cv2.COLOR_RGBA2GRAY}


def recognises_aedat4(path: Path) -> bool:
    """Return whether the file starts with aedat4's first bytes."""
    return starts_with(path, b"#!AER-DAT4")


def recognises_prophesee(path: Path) -> bool:
    """Return whether the path is a ``.raw`` or ``.dat`` file whose header lines begin with %."""
    return path.suffix.lower() in (".raw", ".dat") and starts_with(path, b"%")


def recognises_es(path: Path) -> bool:
    """Return whether the file starts with Event Stream's first bytes."""
    return starts_with(path, b"Event Stream")


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


def read_prophesee(path: Path, options: ConvertOptions, progress: ReadProgress) -> Iterator[Item]:
    """Yield events of a file. The sensor's size is in its header or in ``options``.

    Event words of EVT hold only the lower bits of a time; the upper bits are words of their own, many per millisecond.
    If a recording begins in the middle of the sensor's stream, events before the first upper bits have no time, and
    are dropped.

    Raises:
        UsageError: the file is damaged, does not state the size, or has a version that faery does not decode.
    """
    fallback = None if options.size is None else (options.size.width, options.size.height)
    header = _header(path)
    is_evt = path.suffix.lower() != ".dat" or EVT_LINE.search(header) is not None
    faery = package("faery", "this form")
    decode = faery.evt.Decoder if is_evt else faery.dat.Decoder
    with _errors_of_faery(path), decode(path, fallback, None) as decoder:
        if is_evt and decoder.version not in WORDS:
            raise UsageError(f"{path} is in EVT 2.1, which is not supported; EVT 2, EVT 3 and DAT are")
        if decoder.dimensions is None:
            raise UsageError(f"{path}: its header states no size of the sensor; give --size")
        yield SensorSize(*decoder.dimensions)
        word: np.dtype[Any] = WORDS[decoder.version] if is_evt else DAT_WORD
    # DAT's header ends with two bytes of its own.
    begin = len(header) if is_evt else len(header) + 2
    first_us, resets = _clock(path, word, begin)
    is_timeless = True
    with tempfile.TemporaryDirectory() as folder:
        for part in _parts(path, [begin, *resets], Path(folder)):
            with _errors_of_faery(path), decode(part, fallback, None) as decoder:
                for packet in decoder:
                    progress(0, None)
                    events = packet.get("events", ()) if isinstance(packet, dict) else packet
                    if is_timeless and len(events):
                        has_time = events["t"] >= first_us
                        events, is_timeless = events[has_time.argmax() :] if has_time.any() else (), not has_time.any()
                    if len(events):
                        yield _events(events)
    yield from _cut_note(path, begin, word.itemsize)


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
    yield from _cut_note(path, end, path.stat().st_size)


def _cut_note(path: Path, begin: int, item_bytes: int) -> Iterator[Item]:
    """Yield a note if the bytes from ``begin`` on are no whole number of items."""
    over = (path.stat().st_size - begin) % item_bytes
    if over:
        yield Note(f"cut: the last {over} bytes are an incomplete event and left out")


def _header(path: Path) -> bytes:
    """Return the lines of the header, which begin with %; the last one may be ``% end``."""
    header = b""
    with path.open("rb") as file:
        while (line := file.readline(LONGEST_LINE_BYTES)).startswith(b"%"):
            header += line
            if line.strip() == b"% end":
                break
    return header


def _clock(path: Path, word: np.dtype[Any], begin: int) -> tuple[int, list[int]]:
    """Return the first (upper bits of a) time, us, and the bytes at which it steps back without wrapping around."""
    bits = 32 if word == DAT_WORD else 8 * word.itemsize - 4
    unit_us, first, last, resets = TIME_HIGH_US[word.itemsize], 0, None, list[int]()
    for start in range(begin, path.stat().st_size, LOOKED_THROUGH_WORDS * word.itemsize):
        words = np.fromfile(path, word, LOOKED_THROUGH_WORDS, offset=start)
        times = np.flatnonzero((words >> bits == TIME_HIGH) | (word == DAT_WORD))
        if not len(times):
            continue
        highs = (words[times] & ((1 << bits) - 1)).astype(np.int64)
        if last is None:
            first = last = int(highs[0])
        steps = np.diff(highs, prepend=last)
        is_back = (-steps * unit_us > LATEST_US) & (steps % (1 << bits) > 1 << (bits - 2))
        resets += (start + word.itemsize * times[is_back]).tolist()
        last = int(highs[-1])
    return first * unit_us, resets


def _parts(path: Path, edges: list[int], folder: Path) -> Iterator[Path]:
    """Yield the file; or, if the sensor's clock is reset in it, a file in ``folder`` for each stretch of one clock.

    faery takes a clock that steps back for one that wrapped around.

    Args:
        edges: bytes at which the stretches begin; the header is before the first.
    """
    if len(edges) == 1:
        yield path
        return
    content, part = np.memmap(path, np.uint8, "r"), folder / "part.raw"
    for begin, end in itertools.pairwise([*edges, len(content)]):
        with part.open("wb") as copy:
            copy.write(content[: edges[0]].data)
            copy.write(content[begin:end].data)
        yield part


def _events(packet: npt.NDArray[Any]) -> EventChunk:
    polarity = next(name for name in ("payload", "p", "on") if name in (packet.dtype.names or ()))
    return EventChunk(packet["t"].astype(np.int64) * 1000, packet["x"], packet["y"], packet[polarity] > 0)


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
        hint = "; give --size WIDTHxHEIGHT" if "size" in str(error) else ""
        raise UsageError(f"{path} cannot be decoded: {error}{hint}") from error
