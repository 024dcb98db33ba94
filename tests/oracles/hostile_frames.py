"""Hostile frames (noise, damaged messages, messages with one wrong field), and the decoder's answers to them.

All frames follow from a seed. Their forms, chosen uniformly:

    noise        random bytes
    damaged      a valid message with bytes changed, removed, inserted, cut off, or part of another one appended
    bomb         a few bytes that announce gigabytes, or deeply nested containers
    replaced     a valid message with one field of the wrong type, too large, too small, missing or unknown
    true         a valid message with random values
"""

from __future__ import annotations

import dataclasses
import random
import resource
import sys
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any, get_args

import msgpack
import psutil

from v2v_protocol import PROTOCOL_VERSION
from v2v_protocol.errors import ProtocolError
from v2v_protocol.messages import ARRAY_DTYPES, Frames, Message, Notes, SampleHeader, decode, decode_sample, encode

MOST_GROWTH_MIB = 16.0
MOST_PEAK_GROWTH_MIB = 64.0
MOST_DECODE_SECONDS = 1.0
"""Processor time, which other load on the host does not change."""
_LONGEST_ERROR = 5000
_SHOWN_BYTES = 400
_MIB = float(1 << 20)
FUZZED = {"voxels": ("int16", (2, 3)), "frames": ("uint8", (5,))}
"""Layout that the frames of samples are compared with."""
MESSAGE_TYPES: tuple[type[Any], ...] = get_args(Message)
_ITEM_BYTES = {"int8": 1, "uint8": 1, "int16": 2, "float16": 2, "float32": 4}
_EDGES = (0, 1, 2, 127, 128, 255, 65_535, 65_536, 2**31 - 1, 2**31, 2**32 - 1, 2**32, 2**63, 2**64 - 1)
_VERSION = b"\xa1v" + bytes([PROTOCOL_VERSION])
_BOMBS = (
    b"\xdf\xff\xff\xff\xff",
    b"\xdd\xff\xff\xff\xff",
    b"\xc6\xff\xff\xff\xff",
    b"\xdb\xff\xff\xff\xff",
    b"\xc9\xff\xff\xff\xff\x00",
    b"\x82" + _VERSION + b"\xa1t\xdb\x7f\xff\xff\xff",
    b"\x91" * 5000,
    b"\x81\xa1a" * 2000,
    b"\x83" + _VERSION + b"\xa1t\xa4ping\xa1x" + b"\x91" * 900 + b"\x90",
)


class FrameFuzzer:
    """Make hostile frames from a random source."""

    def __init__(self, random_source: random.Random) -> None:
        self._random = random_source
        self._forms: tuple[Callable[[], bytes], ...] = (
            self.noise,
            self.damaged,
            self.bomb,
            self.replaced,
            self.true,
        )

    def header(self) -> bytes:
        """Return one frame of any form."""
        return self._random.choice(self._forms)()

    def sample(self) -> tuple[SampleHeader, list[bytes]]:
        """Return the header of a sample, and raw frames that may or may not fit it."""
        names = tuple(self._text() for _ in range(self._random.choice((0, 1, 2, 2, 3, 9))))
        dtypes = tuple(self._random.choice((*ARRAY_DTYPES, "object", "")) for _ in names)
        shapes: list[int] = []
        payload: list[bytes] = []
        for dtype in dtypes:
            shape = [self._random.choice((0, 1, 2, 3, 5)) for _ in range(self._random.choice((0, 1, 2, 3, 9)))]
            size = _ITEM_BYTES.get(dtype, 1)
            for extent in shape:
                size *= extent
            shapes += [len(shape), *shape]
            payload.append(bytes(min(size, 1 << 16)))
        damage = self._random.randrange(6)
        if damage == 0 and shapes:
            shapes[self._random.randrange(len(shapes))] = self._random.choice(_EDGES)
        elif damage == 1 and payload:
            payload[0] += b"\0"
        elif damage == 2:
            payload.append(b"")
        elif damage == 3:
            shapes.append(1)
        header = SampleHeader(1, self._int(), names, dtypes, tuple(shapes), self.noise(), "w", 0.0)
        return header, payload

    def payload(self) -> list[bytes]:
        """Return raw frames that may or may not fit :data:`FUZZED`."""
        frames = [bytes(12), bytes(5)]
        match self._random.randrange(5):
            case 0:
                frames.pop()
            case 1:
                frames[0] += b"\0"
            case 2:
                frames.insert(self._random.randrange(3), self.noise())
        return frames

    def message(self) -> Frames:
        """Return a multipart message: a header of any form, mostly alone."""
        frames: Frames = [self.header()]
        if self._random.random() < 0.3:
            frames += [self.noise() for _ in range(self._random.randrange(1, 5))]
        return frames

    # --- the forms ----------------------------------------------------------------------------------------------------

    def noise(self) -> bytes:
        """Return random bytes, mostly few."""
        return self._random.randbytes(int(self._random.paretovariate(0.7)) % 4096)

    def true(self) -> bytes:
        """Return a valid message."""
        return bytes(encode(self._message(self._random.choice(MESSAGE_TYPES)))[0])

    def damaged(self) -> bytes:
        """Return a message with a few wrong bytes."""
        data = bytearray(self.true())
        for _ in range(self._random.randint(1, 4)):
            place = self._random.randrange(len(data) + 1)
            match self._random.randrange(5):
                case 0 if place < len(data):
                    data[place] = self._random.randrange(256)
                case 1:
                    del data[place : place + self._random.randint(1, 8)]
                case 2:
                    data[place:place] = self._random.randbytes(self._random.randint(1, 8))
                case 3:
                    del data[place:]
                case _:
                    data[place:] = self.true()[-self._random.randint(1, 60) :]
        return bytes(data)

    def bomb(self) -> bytes:
        """Return a few bytes that announce many."""
        return self._random.choice(_BOMBS) + self.noise()[:16]

    def replaced(self) -> bytes:
        """Return a message with one wrong field."""
        fields: dict[Any, Any] = msgpack.unpackb(self.true())
        match self._random.randrange(8):
            case 0:
                del fields[self._random.choice(list(fields))]
            case 1:
                fields[self._text()] = self._value(3)
            case 2:
                fields["v"] = self._value(1)
            case _:
                fields[self._random.choice(list(fields))] = self._value(3)
        return bytes(msgpack.packb(fields, use_bin_type=True))

    # --- values -------------------------------------------------------------------------------------------------------

    def _message(self, cls: type[Any]) -> Any:
        return cls(**{field.name: self._of_type(str(field.type)) for field in dataclasses.fields(cls)})

    def _of_type(self, annotation: str) -> Any:
        match annotation:
            case "int":
                return self._int()
            case "float":
                return self._float()
            case "bool":
                return self._random.random() < 0.5
            case "str":
                return self._text()
            case "bytes":
                return self._random.randbytes(self._random.randrange(20))
            case "int | None":
                return self._random.choice((None, self._int()))
            case "tuple[int, ...]":
                return tuple(self._int() for _ in range(self._random.randrange(6)))
            case "tuple[float, ...]":
                return tuple(self._float() for _ in range(self._random.randrange(4)))
            case "tuple[str, ...]":
                return tuple(self._text() for _ in range(self._random.randrange(4)))
            case "Mapping[str, Any]":
                return {self._text(): self._value(3) for _ in range(self._random.randrange(4))}
            case "Notes":
                return Notes(self._random.choice(_EDGES), self._text())
        raise TypeError(f"a message has a field of type {annotation}, which this fuzzer does not know")

    def _float(self) -> float:
        return self._random.choice((0.0, -1.5, 1e300, self._random.random()))

    def _int(self) -> int:
        return self._random.choice((self._random.choice(_EDGES), self._random.randrange(1000)))

    def _text(self) -> str:
        words: Sequence[str] = ("", "voxels", "frames", "recipe", "preset", "paper", "\0", "é", "x" * 300)
        return self._random.choice(words)

    def _value(self, depth: int) -> Any:
        kind = self._random.randrange(10 if depth else 8)
        match kind:
            case 0:
                return None
            case 1:
                return self._random.random() < 0.5
            case 2:
                return self._int()
            case 3:
                return -self._random.randrange(1, 2**63)
            case 4:
                return self._random.choice((0.0, float("nan"), float("inf"), -1e308, 0.1))
            case 5 | 6:
                return self._text()
            case 7:
                return self._random.randbytes(self._random.randrange(40))
            case 8:
                return [self._value(depth - 1) for _ in range(self._random.randrange(4))]
            case _:
                return {self._text(): self._value(depth - 1) for _ in range(self._random.randrange(4))}


def fuzz_decoder(frames: int, seed: int) -> dict[str, Any]:
    """Decode that many frames; return a flat record. Memory is compared with that after the first tenth."""
    fuzzer = FrameFuzzer(random.Random(seed))
    outcomes: Counter[str] = Counter()
    failures: list[str] = []
    longest = before = peak_before = 0.0
    began = time.perf_counter()
    for number in range(frames):
        if number == frames // 10:
            before, peak_before = psutil.Process().memory_info().rss / _MIB, _peak_mib()
        header, payload = fuzzer.header(), fuzzer.payload() if number % 5 == 4 else None
        started = time.thread_time()
        try:
            if payload is not None:
                decode_sample(FUZZED, payload)
                outcomes["samples"] += 1
            else:
                message = decode(header)
                outcomes["messages"] += 1
                if type(message) not in MESSAGE_TYPES:
                    failures.append(f"frame {number}: decode returned {type(message).__name__}")
        except ProtocolError as error:
            outcomes["refused"] += 1
            if len(str(error)) > _LONGEST_ERROR:
                failures.append(f"frame {number}: an error of {len(str(error))} characters")
        except Exception as error:  # noqa: BLE001 - any other exception is what this looks for
            shown = header[:_SHOWN_BYTES].hex() if payload is None else repr(header)
            failures.append(f"frame {number}: {type(error).__name__}: {error}; {shown[: 2 * _SHOWN_BYTES]}")
        longest = max(longest, time.thread_time() - started)
    return {
        "target": "decoder",
        "frames": frames,
        "seed": seed,
        **{outcome: outcomes[outcome] for outcome in ("messages", "samples", "refused")},
        "failures": failures,
        "seconds": time.perf_counter() - began,
        "longest_cpu_seconds": longest,
        "rss_before_mib": before,
        "rss_after_mib": psutil.Process().memory_info().rss / _MIB,
        "peak_growth_mib": _peak_mib() - peak_before,
    }


def _peak_mib() -> float:
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (_MIB if sys.platform == "darwin" else 1024.0)


def failed(record: Mapping[str, Any]) -> list[str]:
    """Return what went wrong according to a record."""
    wrong = list(record["failures"])
    growth = record["rss_after_mib"] - record["rss_before_mib"]
    if growth > MOST_GROWTH_MIB:
        wrong.append(f"resident memory grew by {growth:.1f} MiB; the bar is {MOST_GROWTH_MIB:g}")
    if record.get("peak_growth_mib", 0.0) > MOST_PEAK_GROWTH_MIB:
        wrong.append(f"the peak grew by {record['peak_growth_mib']:.1f} MiB; the bar is {MOST_PEAK_GROWTH_MIB:g}")
    if record.get("longest_cpu_seconds", 0.0) > MOST_DECODE_SECONDS:
        wrong.append(f"one frame took {record['longest_cpu_seconds']:.2f} CPU s; the bar is {MOST_DECODE_SECONDS:g}")
    return wrong
