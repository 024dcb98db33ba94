"""Read ROS 1 bags: ``dvs_msgs/EventArray`` (HQF, IJRR, MVSEC) or ``event_camera_msgs/EventPacket``, and images.

Images are ``sensor_msgs/Image``. This module parses the serialised messages itself: an EventArray is an array of
13-byte records, which NumPy reads in one call.
"""

from __future__ import annotations

import dataclasses
import struct
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import UsageError
from v2v_recordings import prophesee
from v2v_recordings.archive import package
from v2v_recordings.items import ConvertOptions, EventChunk, Item, Picture, ReadProgress, SensorSize

_EVENT_TYPES = ("dvs_msgs/msg/EventArray", "prophesee_event_msgs/msg/EventArray")
EVENT_PACKETS = "event_camera_msgs/msg/EventPacket"
IMAGE = "sensor_msgs/msg/Image"
RECORD = np.dtype([("x", "<u2"), ("y", "<u2"), ("secs", "<u4"), ("nsecs", "<u4"), ("polarity", "u1")])
EVT_HEADERS = {"evt2": "% evt 2.0", "evt3": "% evt 3.0"}
DAMAGE = (EOFError, RuntimeError, ValueError, LookupError, AssertionError)
"""Errors that rosbags and its decompressors raise on damaged files, in addition to their own classes."""
COLOURS = {"bgr8": cv2.COLOR_BGR2GRAY, "rgb8": cv2.COLOR_RGB2GRAY}


def read(path: Path, options: ConvertOptions, progress: ReadProgress) -> Iterator[Item]:
    """Yield events and pictures of a bag.

    Times of EventPackets start at the stamp of the first packet and advance by the sensor's clock.

    Raises:
        UsageError: the bag is damaged, has no topic or several topics of events, or an unsupported encoding.
    """
    rosbag1 = package("rosbags.rosbag1", "a bag")
    try:
        with rosbag1.Reader(path) as bag:
            events = _events_topic(bag.connections, options.events_topic, path)
            images = _images_topic(bag.connections, events, options.images_topic, path)
            is_packets = any(each.topic == events and each.msgtype == EVENT_PACKETS for each in bag.connections)
            read_messages = _read_packets if is_packets else _read_arrays
            yield from read_messages(_messages(bag, (events, images), progress), events, path)
    except (rosbag1.ReaderError, struct.error, OSError) as error:
        raise UsageError(
            f"{path}: the bag cannot be read: {error}; if it was cut, `rosbag reindex` repairs it"
        ) from error
    except DAMAGE as error:
        raise UsageError(f"{path}: the bag is damaged and cannot be read: {error!r}") from error


def _read_arrays(messages: Messages, events: str, path: Path) -> Iterator[Item]:
    size = None
    for topic, message in messages:
        if topic != events:
            yield _picture(message, path)
            continue
        message.skip_header()
        height, width, count = message.unpack("<III")
        # Some drivers write 0 here.
        if size is None and height and width:
            size = SensorSize(width, height)
            yield size
        records = message.array(RECORD, count)
        t_ns = records["secs"].astype(np.int64) * 1_000_000_000 + records["nsecs"]
        yield EventChunk(t_ns, records["x"], records["y"], records["polarity"] > 0)


def _read_packets(messages: Messages, events: str, path: Path) -> Iterator[Item]:
    """Concatenate the packets in a temporary file and decode it: they are pieces of a single stream of words."""
    first_stamp_ns = offset_ns = None
    encoding = ""
    with tempfile.TemporaryDirectory() as folder:
        raw_file = Path(folder) / "packets.raw"
        with raw_file.open("wb") as stream:
            for topic, message in messages:
                if topic != events:
                    yield _picture(message, path)
                    continue
                stamp_ns = message.skip_header()
                height, width, _, _ = message.unpack("<IIQQ")
                this_encoding = message.text()
                _, count = message.unpack("<BI")
                if this_encoding not in EVT_HEADERS or encoding not in ("", this_encoding):
                    raise UsageError(
                        f"{path}: a packet on {events} is in encoding {this_encoding!r}; supported is one of "
                        f"{', '.join(EVT_HEADERS)} for all packets"
                    )
                if not encoding:
                    first_stamp_ns, encoding = stamp_ns, this_encoding
                    stream.write(f"{EVT_HEADERS[encoding]}\n% geometry {width}x{height}\n% end\n".encode())
                stream.write(message.array(np.dtype("u1"), count).tobytes())
        for item in prophesee.read(raw_file, ConvertOptions(), lambda _done, _total: None):
            if isinstance(item, EventChunk) and len(item):
                if offset_ns is None:
                    offset_ns = (first_stamp_ns or 0) - int(item.t_ns[0])
                item = dataclasses.replace(item, t_ns=item.t_ns + offset_ns)
            yield item


def _messages(bag: Any, topics: tuple[str | None, ...], progress: ReadProgress) -> Messages:
    wanted = [connection for connection in bag.connections if connection.topic in topics]
    total = sum(connection.msgcount for connection in wanted)
    for number, (connection, _, raw) in enumerate(bag.messages(connections=wanted), start=1):
        yield connection.topic, _Message(bytes(raw))
        progress(number, total)


class _Message:
    """Read a ROS 1 message from its start: little endian, unaligned, with lengths before variable-size fields."""

    def __init__(self, raw: bytes) -> None:
        self._raw, self._at = raw, 0

    def unpack(self, form: str) -> tuple[Any, ...]:
        values = struct.unpack_from(form, self._raw, self._at)
        self._at += struct.calcsize(form)
        return values

    def text(self) -> str:
        (length,) = self.unpack("<I")
        return self.array(np.dtype("u1"), length).tobytes().decode("utf-8", "replace")

    def skip_header(self) -> int:
        """Skip a std_msgs/Header and return its stamp in ns."""
        _, seconds, nanoseconds = self.unpack("<III")
        self.text()
        return int(seconds) * 1_000_000_000 + int(nanoseconds)

    def array(self, dtype: np.dtype[Any], count: int) -> npt.NDArray[Any]:
        end = self._at + count * dtype.itemsize
        if end > len(self._raw):
            raise struct.error(f"a message is {end - len(self._raw)} bytes too short")
        values = np.frombuffer(self._raw, dtype, count, self._at)
        self._at = end
        return values


Messages = Iterator[tuple[str, _Message]]
"""Topic and content."""


def _picture(message: _Message, path: Path) -> Picture:
    t_ns = message.skip_header()
    height, width = message.unpack("<II")
    encoding = message.text()
    _, step, count = message.unpack("<BII")
    channels = 3 if encoding in COLOURS else 1
    if encoding not in ("mono8", "8UC1", *COLOURS) or step < width * channels or count < height * step:
        raise UsageError(
            f"{path}: a picture is {encoding!r}, {width} x {height}; supported are mono8, 8UC1, bgr8, rgb8"
        )
    rows = message.array(np.dtype("u1"), height * step).reshape(height, step)[:, : width * channels]
    if encoding in COLOURS:
        rows = cv2.cvtColor(np.ascontiguousarray(rows).reshape(height, width, 3), COLOURS[encoding])
    return Picture(t_ns, np.array(rows, np.uint8))


def _events_topic(connections: list[Any], wanted: str | None, path: Path) -> str:
    topics = {connection.topic for connection in connections if connection.msgtype in (*_EVENT_TYPES, EVENT_PACKETS)}
    if wanted is not None:
        topics &= {wanted}
    if len(topics) != 1:
        present = ", ".join(sorted(f"{connection.topic} ({connection.msgtype})" for connection in connections))
        raise UsageError(f"{path}: {len(topics)} topics of events; choose one with --events-topic. It has {present}")
    return str(topics.pop())


def _images_topic(connections: list[Any], events: str, wanted: str | None, path: Path) -> str | None:
    """Return the requested topic, else ``image_raw`` next to the events, else the only one; None without pictures."""
    found = sorted({connection.topic for connection in connections if connection.msgtype == IMAGE})
    beside = f"{events.rpartition('/')[0]}/image_raw"
    if wanted is not None and wanted not in found:
        raise UsageError(f"{path}: no pictures on {wanted}; topics with pictures: {', '.join(found) or '-'}")
    if wanted is None and beside not in found and len(found) > 1:
        raise UsageError(f"{path}: pictures on {', '.join(found)}; choose one with --images-topic")
    return wanted or (beside if beside in found else next(iter(found), None))
