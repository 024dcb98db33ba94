"""Read files with the faery package: aedat4 of DAVIS cameras; Prophesee's EVT 2 and 3 (.raw) and DAT; Event Stream.

A file that ends within an event or packet is read up to it.
"""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import UsageError
from v2v_recordings.items import ConvertOptions, EventChunk, Item, Note, Picture, Progress, SensorSize

AEDAT4_MAGIC, ES_MAGIC = b"#!AER-DAT4", b"Event Stream"
ES_HEAD_BYTES, ES_EVENT_BYTES, ES_LONGEST_STEP_US = 20, 5, 127
"""Bytes before the first event and of an event; a longer time between two events is bytes of 0xff of this length."""
CUT_PACKET = "failed to fill whole buffer"
"""Error of faery where a packet of aedat4 is longer than the file."""
DAT_WORD = np.dtype("<u8")
"""An event of DAT; the lower half is its time, us."""
EVT_WORDS: dict[str, np.dtype[Any]] = {
    **dict.fromkeys(("2.0", "EVT2"), np.dtype("<u4")),
    **dict.fromkeys(("3.0", "EVT3"), np.dtype("<u2")),
}
"""Dtype of a word by the version in the header."""
NOT_DECODED = "2.1"
"""A version that faery up to 0.7.1 recognises but does not implement: it panics. It does not recognise "EVT21"."""
TIME_HIGH = 0x8
"""Value of the four upper bits of a word whose other bits are the upper bits of a time."""
TIME_HIGH_US = {8: 1, 4: 64, 2: 4096}
"""Unit of the upper bits, by the bytes of a word; DAT's words hold a whole time."""
LATEST_US = 10_000
"""The upper bits may step back by at most this without a reset."""
LOOKED_THROUGH_WORDS = 1 << 20
COPIED_BYTES = 1 << 22
LONGEST_LINE_BYTES = 1 << 12
GREY = {"RGB": cv2.COLOR_RGB2GRAY, "RGBA": cv2.COLOR_RGBA2GRAY}


def recognises_aedat4(path: Path) -> bool:
    """Return whether the file starts with aedat4's first bytes."""
    return _head(path).startswith(AEDAT4_MAGIC)


def recognises_prophesee(path: Path) -> bool:
    """Return whether the path is a ``.raw`` or ``.dat`` file whose header lines begin with %."""
    return path.suffix.lower() in (".raw", ".dat") and _head(path).startswith(b"%")


def recognises_es(path: Path) -> bool:
    """Return whether the file starts with Event Stream's first bytes."""
    return _head(path).startswith(ES_MAGIC)


def read_aedat4(path: Path, options: ConvertOptions, progress: Progress) -> Iterator[Item]:
    """Yield events and frames of a file's first camera. A frame's time is the middle of its exposure.

    Raises:
        UsageError: the file is damaged or has no events, or its frames are not 8-bit or not of the whole sensor.
    """
    with _errors_of_faery(path), _faery().aedat.Decoder(path) as decoder:
        tracks = decoder.tracks()
        events = next((track for track in tracks if track.data_type == "events"), None)
        frames = next((track for track in tracks if track.data_type == "frame"), None)
        if events is None:
            raise UsageError(f"{path} has no stream of events")
        chosen = {track.id for track in (events, frames) if track is not None}
        size = SensorSize(*events.dimensions)
        yield size
        parts = decoder.file_data_definitions()
        total, done = sum(part.size for part in parts) or None, 0
        packet_number, packets = 0, iter(decoder)
        while True:
            try:
                track, packet = next(packets)
            except StopIteration:
                return
            except RuntimeError as error:
                if packet_number and CUT_PACKET in str(error):
                    yield Note(f"cut: packet {packet_number + 1} is incomplete; the {packet_number} before it are read")
                    return
                raise
            if packet_number < len(parts):
                done += parts[packet_number].size
            packet_number += 1
            if track.id in chosen:
                yield _events(packet) if track.data_type == "events" else _frame(packet, size, path)
            progress(done, total)


def read_prophesee(path: Path, options: ConvertOptions, progress: Progress) -> Iterator[Item]:
    """Yield events of a file. The sensor's size is in its header or in ``options``.

    Event words of EVT hold only the lower bits of a time; the upper bits are words of their own, many per millisecond.
    If a recording begins in the middle of the sensor's stream, events before the first upper bits have no time, and
    are dropped.

    Raises:
        UsageError: the file is damaged, does not state the size, or has a version that faery does not decode.
    """
    faery = _faery()
    fallback = None if options.size is None else (options.size.width, options.size.height)
    version, head = _header(path)
    is_evt = bool(version) or path.suffix.lower() != ".dat"
    # DAT's header ends with two bytes of its own.
    word, head = (EVT_WORDS.get(version), head) if is_evt else (DAT_WORD, head + 2)
    module = faery.evt if is_evt else faery.dat
    with tempfile.TemporaryDirectory() as folder:
        for number, part in enumerate(_parts(path, word, head, Path(folder))):
            with _errors_of_faery(path), module.Decoder(part, fallback, None) as decoder:
                if version == NOT_DECODED:
                    raise UsageError(f"{path} is in EVT 2.1, which is not supported; EVT 2, EVT 3 and DAT are")
                if decoder.dimensions is None:
                    raise UsageError(f"{path}: its header states no size of the sensor; give --size")
                yield SensorSize(*decoder.dimensions)
                timeless = _events_without_time(path, module, fallback, word, head) if is_evt and not number else 0
                for events in _event_packets(decoder):
                    progress(0, None)
                    left_out = min(timeless, len(events))
                    timeless -= left_out
                    yield _events(events[left_out:])
    yield from _cut_note(path, head, word.itemsize if word is not None else 1)


def read_es(path: Path, _options: ConvertOptions, progress: Progress) -> Iterator[Item]:
    """Yield events of an Event Stream file of a camera without grey levels.

    Raises:
        UsageError: the file is damaged or holds something else.
    """
    end, last_us = ES_HEAD_BYTES, 0
    with _errors_of_faery(path), _faery().es.Decoder(path, 0) as decoder:
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


def _parts(path: Path, word: np.dtype[Any] | None, head: int, folder: Path) -> Iterator[Path]:
    """Yield the file; or, if the sensor's clock is reset in it, a file in ``folder`` for each stretch of one clock.

    faery takes a clock that steps back for one that went round.
    """
    edges, whole_bytes = [head, *_resets(path, word, head)], path.stat().st_size
    if len(edges) == 1:
        yield path
        return
    with path.open("rb") as file:
        header = file.read(head)
        for begin, end in zip(edges, [*edges[1:], whole_bytes], strict=True):
            part = folder / "part.raw"
            with part.open("wb") as copy:
                copy.write(header)
                for start in range(begin, end, COPIED_BYTES):
                    copy.write(file.read(min(COPIED_BYTES, end - start)))
            yield part


def _resets(path: Path, word: np.dtype[Any] | None, head: int) -> list[int]:
    """Return the bytes at which the (upper bits of the) time step back, and do not go round."""
    found: list[int] = []
    if word is None:
        return found
    bits, last = 32 if word == DAT_WORD else 8 * word.itemsize - 4, None
    for begin in range(head, path.stat().st_size, LOOKED_THROUGH_WORDS * word.itemsize):
        words = np.fromfile(path, word, LOOKED_THROUGH_WORDS, offset=begin)
        times = np.flatnonzero((words >> bits == TIME_HIGH) | (word == DAT_WORD))
        highs = (words[times] & ((1 << bits) - 1)).astype(np.int64)
        steps = np.diff(highs, prepend=highs[:1] if last is None else last)
        is_back = (-steps * TIME_HIGH_US[word.itemsize] > LATEST_US) & (steps % (1 << bits) > 1 << (bits - 2))
        found += (begin + word.itemsize * times[is_back]).tolist()
        last = highs[-1:] if len(highs) else last
    return found


def _event_packets(decoder: Any) -> Iterator[npt.NDArray[Any]]:
    for packet in decoder:
        if not isinstance(packet, dict):
            yield packet
        elif "events" in packet:
            yield packet["events"]


def _events_without_time(
    path: Path, module: Any, fallback: tuple[int, int] | None, word: np.dtype[Any] | None, head: int
) -> int:
    """Return the number of events of an EVT file before the first upper bits of a time, by decoding only that part."""
    if word is None:
        return 0
    kinds = np.fromfile(path, word, LOOKED_THROUGH_WORDS, offset=head) >> (8 * word.itemsize - 4)
    times = np.flatnonzero(kinds == TIME_HIGH)
    if not len(times) or not times[0]:
        return 0
    with tempfile.TemporaryDirectory() as folder, path.open("rb") as file:
        front = Path(folder) / "front.raw"
        front.write_bytes(file.read(head + int(times[0]) * word.itemsize))
        with module.Decoder(front, fallback, None) as decoder:
            return sum(len(events) for events in _event_packets(decoder))


def _header(path: Path) -> tuple[str, int]:
    """Return the version that the header of an EVT file states ("" in DAT), and the first byte after the header."""
    version = ""
    with path.open("rb") as file:
        while True:
            begin = file.tell()
            line = file.readline(LONGEST_LINE_BYTES)
            if not line.startswith(b"%"):
                return version, begin
            key, _, value = line[1:].decode("ascii", "replace").strip().partition(" ")
            if key in ("evt", "format"):
                version = value.partition(";")[0]
            elif key == "end":
                return version, file.tell()


def _events(packet: npt.NDArray[Any]) -> EventChunk:
    polarity = next(name for name in ("payload", "p", "on") if name in (packet.dtype.names or ()))
    return EventChunk(packet["t"].astype(np.int64) * 1000, packet["x"], packet["y"], packet[polarity] > 0)


def _frame(frame: Any, size: SensorSize, path: Path) -> Picture:
    pixels = frame.pixels
    if frame.format in GREY:
        pixels = cv2.cvtColor(pixels, GREY[frame.format])
    if pixels.dtype != np.uint8 or pixels.shape != (size.height, size.width):
        raise UsageError(
            f"{path}: a frame is {frame.format} {list(pixels.shape)} at ({frame.offset_x}, {frame.offset_y}); only "
            f"8-bit frames of the whole sensor, {size.width} x {size.height}, can be converted"
        )
    return Picture(int(frame.t) * 1000, pixels)


def _head(path: Path) -> bytes:
    if not path.is_file():
        return b""
    with path.open("rb") as file:
        return file.read(len(ES_MAGIC))


def _faery() -> ModuleType:
    try:
        import faery
    except ImportError as error:
        raise UsageError(
            "this form needs the faery package: pip install '.[convert]' in a checkout of v2v-stream"
        ) from error
    module: ModuleType = faery
    return module


@contextlib.contextmanager
def _errors_of_faery(path: Path) -> Iterator[None]:
    try:
        yield
    except (RuntimeError, OSError, ValueError, IndexError) as error:
        text = str(error)
        hint = "; give --size WIDTHxHEIGHT" if "size" in text else ""
        raise UsageError(f"{path} cannot be decoded: {text}{hint}") from error
    except BaseException as error:
        # A Rust panic on unexpected bytes. Its class cannot be imported, and is not a subclass of Exception.
        if type(error).__name__ != "PanicException":
            raise
        raise UsageError(f"{path} cannot be decoded: {error}") from error
