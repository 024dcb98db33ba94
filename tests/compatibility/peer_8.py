"""A frozen peer: what a release of protocol 8 reads and writes. It uses no code of the project, and is never rewritten.

``protocol-8.json`` has one message of each type, in hexadecimal, with a value in every field. Such a release drops
names in ``notes`` that it does not know, and refuses a message with any other field that it does not know.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import msgpack

MESSAGES: dict[str, bytes] = {
    name: bytes.fromhex(text)
    for name, text in json.loads(Path(__file__).with_name("protocol-8.json").read_text()).items()
}
MAY_LACK = {
    "welcome": {"sidecars"}, "sample": {"arena"}, "lease-failed": {"sidecar"}, "lease": {"sidecars", "remark"},
}  # fmt: skip
"""Fields that are left out at their defaults."""
NOTES = {"worker-hello": {"memory_bytes"}, "goodbye": {"reason"}}


class Unreadable(Exception):
    """A message that this peer refuses; the text says why."""


def fields_of(name: str) -> dict[str, Any]:
    """Return the fields of the frozen message of a type."""
    fields: dict[str, Any] = msgpack.unpackb(MESSAGES[name])
    return {key: value for key, value in fields.items() if key not in ("v", "t")}


def read(frame: bytes) -> tuple[str, dict[str, Any]]:
    """Return type and fields of a message.

    Raises:
        Unreadable: it has another version, type or field.
    """
    fields = msgpack.unpackb(frame)
    version, name, notes = fields.pop("v"), fields.pop("t"), fields.pop("notes", {})
    if version != 8 or name not in MESSAGES:
        raise Unreadable(f"version {version}, type {name}")
    known = fields_of(name).keys()
    if unknown := fields.keys() - known:
        raise Unreadable(f"{name} has no field {', '.join(sorted(unknown))}")
    if lacking := known - fields.keys() - MAY_LACK.get(name, set()):
        raise Unreadable(f"{name} lacks {', '.join(sorted(lacking))}")
    return name, fields | {key: value for key, value in notes.items() if key in NOTES.get(name, ())}


def write(name: str, /, notes: dict[str, Any] | None = None, **fields: Any) -> bytes:
    """Return a message: the frozen one of its type, with these fields in place of its own."""
    rest = {} if notes is None else {"notes": notes}
    packed: bytes = msgpack.packb({"v": 8, "t": name, **fields_of(name), **fields, **rest})
    return packed


class Consumer:
    """Say hello, request samples, and count them."""

    def __init__(self, spec: dict[str, Any], arrays: tuple[str, ...]) -> None:
        self.samples: list[int] = []
        self.welcome: dict[str, Any] = {}
        self.troubles: list[str] = []
        self.hello = write(
            "hello", spec=spec, arrays=arrays, batch_size=2, seed=7, quarantine=None, stride=0, packed=False, secret=b""
        )

    def hears(self, frames: list[bytes]) -> None:
        """Handle a message.

        Raises:
            Unreadable: it cannot be read.
        """
        name, fields = read(frames[0])
        if name == "sample":
            assert len(frames) == 1 + len(fields["names"])
            self.samples.append(fields["index"])
        elif name == "welcome":
            self.welcome = fields
        elif name == "pong":
            self.troubles.append(fields["trouble"])
        else:
            raise AssertionError((name, fields))


class Worker:
    """Answer each lease with arrays of zeros."""

    def __init__(self, numerics_version: int, layout: dict[str, tuple[str, tuple[int, ...]]]) -> None:
        self.hello = write("worker-hello", name="old", numerics_version=numerics_version, credit=2, secret=b"s")
        self.is_there = True
        self._layout = layout

    def hears(self, frame: bytes) -> list[list[bytes]]:
        """Return the messages with which it answers one."""
        try:
            name, fields = read(frame)
        except Unreadable as error:
            self.is_there = False
            return [[write("goodbye", waited_seconds=0.0, notes={"reason": f"cannot read a message: {error}"})]]
        assert name == "lease"
        assert self.is_there
        shapes = [extent for _, shape in self._layout.values() for extent in (len(shape), *shape)]
        header = write(
            "sample", epoch=fields["epoch"], index=fields["indices"][0], names=list(self._layout),
            dtypes=[dtype for dtype, _ in self._layout.values()], shapes=shapes, slot=0, quarantine=0, packed=False,
            arena="", cache="",
        )  # fmt: skip
        sizes = [_bytes(dtype, shape) for dtype, shape in self._layout.values()]
        result = [write("result", lease=fields["lease"], begins=0), header, *map(bytes, sizes)]
        return [[write("begun", lease=fields["lease"])], result]


def _bytes(dtype: str, shape: tuple[int, ...]) -> int:
    size = int("".join(filter(str.isdigit, dtype))) // 8
    for extent in shape:
        size *= extent
    return size
