"""Write aedat4 files as DV does: flatbuffers assembled by hand, uncompressed.

A flatbuffer table is: i32 distance back to its vtable, then its fields; the vtable is u16 own size, u16 table size,
u16 offset of each field (0 where it is absent). A vector is u32 count and its elements; a field refers to it by u32
distance.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from tests.trainer.convert.scene import HEIGHT, WIDTH, Scene

MAGIC = b"#!AER-DAT4.0\r\n"
EVENT = np.dtype({"names": ["t", "x", "y", "p"], "formats": ["<i8", "<i2", "<i2", "u1"], "itemsize": 16})
HALF_EXPOSURE_US = 1000


def table(identifier: bytes, scalars: list[tuple[int, str, int]], slots: int, vector: tuple[int, int, bytes]) -> bytes:
    """Return a size-prefixed buffer of one table with scalar fields and one vector.

    Args:
        identifier: four bytes.
        scalars: slot, struct code and value, widest first.
        slots: of the vtable.
        vector: slot, count and bytes.
    """
    vtable_size = 4 + 2 * slots
    head = 12  # size prefix, root offset, identifier
    table_at = -(-(head + vtable_size) // 8) * 8 + 4  # so that 8-byte fields, 4 bytes behind, are aligned
    offsets, body = {}, b""
    for slot, code, value in scalars:
        offsets[slot] = 4 + len(body)
        body += struct.pack(f"<{code}", value)
    body += b"\0" * (-len(body) % 4)
    offsets[vector[0]] = 4 + len(body)
    reference_at = table_at + 4 + len(body)
    table_size = 4 + len(body) + 4
    vector_at = -(-(table_at + table_size + 4) // 8) * 8 - 4  # its elements are then aligned to 8
    vtable = struct.pack(f"<HH{slots}H", vtable_size, table_size, *(offsets.get(slot, 0) for slot in range(slots)))
    vtable_at = table_at - vtable_size
    content = bytearray(vector_at + 4 + len(vector[2]))
    struct.pack_into("<II4s", content, 0, len(content) - 4, table_at - 4, identifier)
    content[vtable_at:table_at] = vtable
    struct.pack_into("<i", content, table_at, vtable_size)
    content[table_at + 4 : table_at + 4 + len(body)] = body
    struct.pack_into("<I", content, reference_at, vector_at - reference_at)
    struct.pack_into("<I", content, vector_at, vector[1])
    content[vector_at + 4 :] = vector[2]
    return bytes(content)


def description() -> bytes:
    def output(number: int, kind: str) -> str:
        path = f"/mainloop/Recorder/outInfo/{number}/"
        return (
            f'<node name="{number}" path="{path}"><attr key="compression" type="string">NONE</attr>'
            f'<attr key="typeIdentifier" type="string">{kind}</attr><node name="info" path="{path}info/">'
            f'<attr key="sizeX" type="int">{WIDTH}</attr><attr key="sizeY" type="int">{HEIGHT}</attr></node></node>'
        )

    return (
        '<dv version="2.0"><node name="outInfo" path="/mainloop/Recorder/outInfo/">'
        f"{output(0, 'EVTS')}{output(1, 'FRME')}</node></dv>"
    ).encode()


def event_packet(scene: Scene, part: slice) -> bytes:
    records = np.zeros(len(scene.t_us[part]), EVENT)
    records["t"], records["x"], records["y"], records["p"] = (
        scene.t_us[part], scene.x[part], scene.y[part], scene.p[part]
    )  # fmt: skip
    return table(b"EVTS", [], 1, (0, len(records), records.tobytes()))


def frame_packet(pixels: np.ndarray, t_us: int) -> bytes:
    height, width = pixels.shape
    times = (t_us, t_us - 2000, t_us + 2000, t_us - HALF_EXPOSURE_US, t_us + HALF_EXPOSURE_US)
    scalars = [(slot, "q", time) for slot, time in enumerate(times)]
    scalars += [(slot, "h", value) for slot, value in ((6, width), (7, height), (8, 0), (9, 0))]
    scalars += [(5, "b", 0)]
    return table(b"FRME", scalars, 11, (10, pixels.size, pixels.tobytes()))


def write_aedat4(path: Path, scene: Scene) -> None:
    """Write events in two packets, then the frames."""
    half = len(scene.t_us) // 2
    packets = [(0, event_packet(scene, slice(0, half))), (0, event_packet(scene, slice(half, None)))]
    packets += [(1, frame_packet(*pair)) for pair in zip(scene.pictures, scene.picture_us.tolist(), strict=True)]
    info = description()
    with path.open("wb") as file:
        # Compression none; a position of -1 says that there is no table of the packets at the end.
        file.write(MAGIC + table(b"IOHE", [(1, "q", -1), (0, "i", 0)], 3, (2, len(info), info + b"\0")))
        for stream, packet in packets:
            file.write(struct.pack("<ii", stream, len(packet)) + packet)
