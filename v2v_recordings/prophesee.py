"""Read Prophesee's files: EVT 2 and EVT 3 (.raw), and DAT. Lines of text, which begin with %, are before their words.

    EVT 2   32 bits, the upper four of which are the type of a word: 0x0 and 0x1, a darker and a brighter event (6 bits
            of its time, column, row); 0x8, the upper 28 bits of the time of the events that follow; others: passed over
    DAT     two bytes, the type of event and the size of one; then for each event 32 bits of time, and 32 of column, row
            and polarity

A file that ends within an event is read up to it.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import UsageError
from v2v_recordings import evt3
from v2v_recordings.archive import starts_with
from v2v_recordings.event_columns import Rounds
from v2v_recordings.items import ConvertOptions, EventChunk, Item, Note, ReadProgress, SensorSize
from v2v_recordings.limits import LARGER, check_size

HEADER_LINE = re.compile(rb"%( .*|[\t\x20-\x7e]*)\r?\n?")
"""Words may begin like such a line, but not with a space after it or like text."""
LONGEST_LINE_BYTES = 1 << 12
VERSIONS = re.compile(rb"(?im)^% *format +EVT(\d+)"), re.compile(rb"(?im)^% *evt +(\d(?:\.[1-9])?)")
"""Lines with the version of EVT; the first decides where a header has both."""
DAT_1 = re.compile(rb"(?im)^% *version +1\b")
DAT_EVENTS = (b"\x00\x08", b"\x0c\x08")
"""Types of events with a place, and their size in bytes."""
GEOMETRY = re.compile(rb"(?im)^% *geometry +(-?\d{1,9}) *x *(-?\d{1,9})")
WIDTH, HEIGHT = (re.compile(rb"(?im)^%% .*?\b%b[ =](\d{1,9})" % name) for name in (b"width", b"height"))
"""Where the lines of a header state the size: ``geometry 1280x720``, ``format EVT3;height=720;width=1280``."""


def recognises(path: Path) -> bool:
    """Return whether the path is a ``.raw`` or ``.dat`` file whose header lines begin with %."""
    return path.suffix.lower() in (".raw", ".dat") and starts_with(path, b"%")


def read(path: Path, options: ConvertOptions, progress: ReadProgress) -> Iterator[Item]:
    """Yield the sensor's size and the events of a file, and notes on what is left out.

    If a recording begins in the middle of the sensor's stream, events of EVT before the first upper bits of a time have
    no time, and are left out.

    Raises:
        UsageError: the words are not those of the form, or it is not one of these three; the size is not stated, stated
            twice, or beyond the coordinates.
    """
    header = _header(path)
    version = next((found[1] for line in VERSIONS if (found := line.search(header))), b"").decode().replace(".", "")
    is_dat = path.suffix.lower() == ".dat" and not version
    form = "DAT" if is_dat else f"EVT {'.'.join(version) or 'of no stated version'}"
    if form not in ("EVT 2", "EVT 3", "DAT"):
        raise UsageError(f"{path} is in {form}, which is not supported; EVT 2, EVT 3 and DAT are")
    yield (size := _size(path, header, options.size))
    check_size(str(path), form, size.width, size.height, LARGER)
    with path.open("rb") as file:
        file.seek(len(header))
        if is_dat and (kind := file.read(2)) not in DAT_EVENTS:
            raise UsageError(f"{path}: its events are of type and size {kind.hex(' ')}; 00 08 and 0c 08 can be read")
        begin, total = file.tell(), path.stat().st_size
        decoder: Any = _Dat(header) if is_dat else _Evt2() if form == "EVT 2" else evt3.Decoder()
        while len(words := np.fromfile(file, decoder.word, evt3.BLOCK_WORDS)):
            try:
                yield decoder.decode(words)
            except UsageError as error:
                raise UsageError(f"{path}: {error}") from error
            progress(file.tell(), total)
    if isinstance(decoder, evt3.Decoder):
        yield from decoder.notes()
    if over := (total - begin) % decoder.word.itemsize:
        yield Note(f"cut: the last {over} bytes are an incomplete event and left out")


def _header(path: Path) -> bytes:
    """Return the lines of the header, which begin with %; the last one may be ``% end``."""
    header = b""
    with path.open("rb") as file:
        while HEADER_LINE.fullmatch(line := file.readline(LONGEST_LINE_BYTES)):
            header += line
            if line.strip(b"% \t\r\n").lower() == b"end":
                break
    return header


def _size(path: Path, header: bytes, given: SensorSize | None) -> SensorSize:
    stated = {*GEOMETRY.findall(header), *zip(WIDTH.findall(header), HEIGHT.findall(header), strict=False)}
    sizes = {SensorSize(int(width), int(height)) for width, height in stated}
    if given is not None and (not sizes or given in sizes):
        return given
    if len(sizes) != 1:
        count = "several sizes" if sizes else "no size"
        raise UsageError(f"{path}: its header states {count} of the sensor; give --size WIDTHxHEIGHT")
    return sizes.pop()


class _Evt2:
    word = np.dtype("<u4")

    def __init__(self) -> None:
        self._high, self._rounds = -1, Rounds(34)

    def decode(self, words: npt.NDArray[Any]) -> EventChunk:
        kinds = words >> 28
        places, times = np.flatnonzero(kinds <= 1), np.flatnonzero(kinds == 8)
        highs = np.append(self._high, words[times] & 0xFFFFFFF)
        self._high = int(highs[-1])
        t_us = highs[np.searchsorted(times, places)] << 6 | words[places] >> 22 & 0x3F
        events, t_us = words[places[t_us >= 0]], t_us[t_us >= 0]
        return EventChunk(self._rounds.unwrap(t_us) * 1000, events >> 11 & 0x7FF, events & 0x7FF, events >> 28 == 1)


class _Dat:
    word = np.dtype([("t", "<u4"), ("event", "<u4")])

    def __init__(self, header: bytes) -> None:
        self._bits, self._rounds = (9, 8) if DAT_1.search(header) else (14, 14), Rounds(32)

    def decode(self, words: npt.NDArray[Any]) -> EventChunk:
        (width, height), events = self._bits, words["event"]
        x, y = events & (1 << width) - 1, events >> width & (1 << height) - 1
        return EventChunk(self._rounds.unwrap(words["t"]) * 1000, x, y, events >> width + height > 0)
