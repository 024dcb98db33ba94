"""Frames that no peer of ours would send: noise, damaged messages, and messages that are right but for one field.

All of it follows from a seed. The forms, in the proportions of a uniform choice:

    noise        random bytes
    damaged      a true message with bytes changed, cut out, put in, cut off, or the half of another one behind it
    bomb         a few bytes that announce gigabytes, or containers in containers without end
    replaced     a true message with one field of the wrong type, too large, too small, missing or too many
    true         a message as it should be, with random values in it
"""

from __future__ import annotations

import dataclasses
import random
from collections.abc import Callable, Sequence
from typing import Any, get_args

import msgpack

from v2v_protocol import PROTOCOL_VERSION
from v2v_protocol.messages import Message, SampleHeader
from v2v_protocol.wire import ARRAY_DTYPES, Frames, encode

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
    """
    Args:
        random_source: of everything it makes.
    """

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
        """One frame of any form."""
        return self._random.choice(self._forms)()

    def sample(self) -> tuple[SampleHeader, list[bytes]]:
        """The header of a sample and raw frames that may or may not fit it."""
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

    def message(self) -> Frames:
        """A whole multipart message: a header of any form, mostly alone."""
        frames: Frames = [self.header()]
        if self._random.random() < 0.3:
            frames += [self.noise() for _ in range(self._random.randrange(1, 5))]
        return frames

    # --- the forms ----------------------------------------------------------------------------------------------------

    def noise(self) -> bytes:
        """Random bytes, mostly few."""
        return self._random.randbytes(int(self._random.paretovariate(0.7)) % 4096)

    def true(self) -> bytes:
        """A message of ours."""
        return bytes(encode(self._message(self._random.choice(MESSAGE_TYPES)))[0])

    def damaged(self) -> bytes:
        """A message with a few bytes that are not its own."""
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
        """Few bytes that promise many."""
        return self._random.choice(_BOMBS) + self.noise()[:16]

    def replaced(self) -> bytes:
        """A message with one field that is not what it should be."""
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
