"""Write the scene in each raw form, without code of the readers. The rosbags package serialises bags."""

from __future__ import annotations

import io
import json
import struct
import zipfile
from pathlib import Path

import cv2
import h5py
import numpy as np

from tests.trainer.convert.scene import HEIGHT, WIDTH, Scene

EVENT_ARRAY = "dvs_msgs/msg/EventArray"
EVENT_PACKET = "event_camera_msgs/msg/EventPacket"
IMAGE = "sensor_msgs/msg/Image"


def png(pixels: np.ndarray) -> bytes:
    return cv2.imencode(".png", pixels)[1].tobytes()


def ijrr_members(scene: Scene) -> dict[str, bytes]:
    events = "".join(
        f"{t / 1e6:.9f} {x} {y} {int(p)}\n" for t, x, y, p in zip(scene.t_us, scene.x, scene.y, scene.p, strict=True)
    )
    listing = "".join(f"{t / 1e6:.9f} images/frame_{i:08d}.png\n" for i, t in enumerate(scene.picture_us))
    members = {"slow/events.txt": events.encode(), "slow/images.txt": listing.encode()}
    return members | {f"slow/images/frame_{i:08d}.png": png(pixels) for i, pixels in enumerate(scene.pictures)}


def evaid_members(scene: Scene) -> dict[str, bytes]:
    """Write events in eleven files, so that 10.txt comes after 2.txt only if names are compared as numbers."""
    members = {
        "shape.txt": f"{WIDTH} {HEIGHT}\n".encode(),
        "timestamps.txt": "\n".join(map(str, scene.picture_us)).encode(),
    }
    for part, indices in enumerate(np.array_split(np.arange(len(scene.t_us)), 11)):
        lines = [f"{scene.t_us[i]} {scene.x[i]} {scene.y[i]} {int(scene.p[i])}" for i in indices]
        members[f"event/{part}.txt"] = "\n".join(lines).encode()
    return members | {f"gt/{i}.png": png(pixels) for i, pixels in enumerate(scene.pictures)}


def with_macos_notes(members: dict[str, bytes]) -> dict[str, bytes]:
    """Add files as the Finder does when it packs: metadata of each file, in a file with the same ending."""
    notes = {f"__MACOSX/{Path(name).parent / f'._{Path(name).name}'}": b"\0\5\x16\7" for name in members}
    return members | notes


def write_zip(path: Path, members: dict[str, bytes]) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(name, content)


def write_folder(path: Path, members: dict[str, bytes]) -> None:
    for name, content in members.items():
        (path / name).parent.mkdir(parents=True, exist_ok=True)
        (path / name).write_bytes(content)


def write_mvsec(path: Path, scene: Scene) -> None:
    with h5py.File(path, "w") as file:
        for camera, shift in (("left", 0), ("right", 1)):
            group = file.create_group(f"davis/{camera}")
            rows = [scene.x + shift, scene.y, scene.t_us / 1e6, np.where(scene.p, 1, -1)]
            group["events"] = np.stack(rows, axis=1)
            group["image_raw"] = scene.pictures
            group["image_raw_ts"] = scene.picture_us / 1e6
            # "Nearest": here the last event before.
            group["image_raw_event_inds"] = np.searchsorted(scene.t_us, scene.picture_us) - 1


DSEC_OFFSET_US = 4_000_000


def write_dsec(path: Path, scene: Scene, camera: str = "left", **stated: int) -> None:
    """Write a sequence as unpacked by DSEC's instructions. ``stated``: attributes, which DSEC itself does not have."""
    folder = path / "events" / camera
    folder.mkdir(parents=True)
    with h5py.File(folder / "events.h5", "w") as file:
        t_us = (scene.t_us - DSEC_OFFSET_US).astype(np.uint32)
        for name, values, dtype in (
            ("x", scene.x, "u2"),
            ("y", scene.y, "u2"),
            ("t", t_us, "u4"),
            ("p", scene.p, "u1"),
        ):
            file.create_dataset(f"events/{name}", data=values.astype(dtype))
        file["ms_to_idx"] = np.searchsorted(t_us, 1000 * np.arange(int(t_us[-1]) // 1000 + 1)).astype(np.uint64)
        file["t_offset"] = np.int64(DSEC_OFFSET_US)
        file.attrs.update(stated)
    frames = path / "images" / camera / "rectified"
    frames.mkdir(parents=True)
    for number, pixels in enumerate(scene.pictures):
        (frames / f"{number:06d}.png").write_bytes(png(np.repeat(pixels[..., None], 3, axis=2)))
    (path / "images" / "timestamps.txt").write_text("".join(f"{t}\n" for t in scene.picture_us))
    exposures = "".join(f"{t - 50},{t + 50}\n" for t in scene.picture_us)
    header = "# exposure_start_timestamp_us, exposure_end_timestamp_us\n"
    (path / "images" / camera / "exposure_timestamps.txt").write_text(header + exposures)
    (path / "disparity").mkdir(exist_ok=True)
    (path / "disparity" / "timestamps.txt").write_text("0\n")
    (path / "disparity" / "000000.png").write_bytes(png(scene.pictures[0]))


def evreal_members(scene: Scene) -> dict[str, bytes]:
    """Return the files that EVREAL's tools save: xy as the transpose of two rows, and so in Fortran's order."""
    columns = {
        "events_ts": scene.t_us / 1e6,
        "events_xy": np.array([scene.x, scene.y]).transpose(),
        "events_p": scene.p.astype(np.int64),
        "images": scene.pictures[..., None],
        "images_ts": (scene.picture_us / 1e6)[:, None],
        "image_event_indices": np.searchsorted(scene.t_us, scene.picture_us, "right")[:, None] - 1,
    }
    members = {}
    for name, values in columns.items():
        stream = io.BytesIO()
        np.save(stream, values, allow_pickle=False)
        members[f"{name}.npy"] = stream.getvalue()
    return members | {"metadata.json": json.dumps({"sensor_resolution": [HEIGHT, WIDTH]}).encode()}


def write_npz(path: Path, scene: Scene) -> None:
    with path.open("wb") as file:
        np.savez_compressed(file, t=scene.t_us, x=scene.x, y=scene.y, p=scene.p, width=WIDTH, height=HEIGHT)


def write_bag(
    path: Path, scene: Scene, *, packets: bool = False, front: bytes = b"", image_encoding: str = "mono8"
) -> None:
    """Write two messages of events, and one of each picture.

    ``packets`` writes EventPackets of EVT 3 instead of EventArrays; the first starts with the words ``front``.
    """
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg("uint16 x\nuint16 y\ntime ts\nbool polarity\n", "dvs_msgs/msg/Event"))
    store.register(
        get_types_from_msg(
            "std_msgs/Header header\nuint32 height\nuint32 width\ndvs_msgs/Event[] events\n", EVENT_ARRAY
        )
    )
    store.register(
        get_types_from_msg(
            "std_msgs/Header header\nuint32 height\nuint32 width\nuint64 seq\nuint64 time_base\nstring encoding\n"
            "bool is_bigendian\nuint8[] events\n",
            EVENT_PACKET,
        )
    )
    types = store.types

    def stamp(t_us: int) -> object:
        return types["builtin_interfaces/msg/Time"](sec=int(t_us) // 1_000_000, nanosec=int(t_us) % 1_000_000 * 1000)

    def header(t_us: int) -> object:
        return types["std_msgs/msg/Header"](seq=0, stamp=stamp(t_us), frame_id="camera")

    def event_message(part: slice) -> object:
        t_us, x, y, p = scene.t_us[part], scene.x[part], scene.y[part], scene.p[part]
        if packets:
            # The sensor's clock has another origin than ROS.
            words = np.frombuffer(
                (b"" if part.start else front) + evt3_words(t_us - scene.t_us[0] + 77_000, x, y, p), np.uint8
            )
            return types[EVENT_PACKET](
                header=header(t_us[0]), height=HEIGHT, width=WIDTH, seq=0, time_base=0, encoding="evt3",
                is_bigendian=False, events=words,
            )  # fmt: skip
        event = types["dvs_msgs/msg/Event"]
        events = [
            event(x=int(a), y=int(b), ts=stamp(t), polarity=bool(c)) for t, a, b, c in zip(t_us, x, y, p, strict=True)
        ]
        return types[EVENT_ARRAY](header=header(t_us[-1]), height=HEIGHT, width=WIDTH, events=events)

    def image_message(pixels: np.ndarray, t_us: int) -> object:
        if image_encoding == "bgr8":
            pixels = np.repeat(pixels[..., None], 3, axis=2)
        return types[IMAGE](
            header=header(t_us), height=HEIGHT, width=WIDTH, encoding=image_encoding, is_bigendian=0,
            step=pixels.size // HEIGHT, data=pixels.reshape(-1),
        )  # fmt: skip

    event_type = EVENT_PACKET if packets else EVENT_ARRAY
    half = len(scene.t_us) // 2
    with Writer(path) as bag:
        events = bag.add_connection("/dvs/events", event_type, typestore=store)
        images = bag.add_connection("/dvs/image_raw", IMAGE, typestore=store)
        bag.add_connection("/dvs/image_reconstruction", IMAGE, typestore=store)
        for part in (slice(0, half), slice(half, None)):
            data = store.serialize_ros1(event_message(part), event_type)
            bag.write(events, int(scene.t_us[part][-1]) * 1000, bytes(data))
        for pixels, t_us in zip(scene.pictures, scene.picture_us.tolist(), strict=True):
            bag.write(images, t_us * 1000, bytes(store.serialize_ros1(image_message(pixels, t_us), IMAGE)))


def write_evt2(path: Path, scene: Scene, *, geometry: bool = True, front: bytes = b"") -> None:
    """Words of 32 bits: 0x8 upper time, 0x0 and 0x1 an event of either polarity with the lower 6 bits of its time.

    The words ``front`` come in front of them.
    """
    words, upper = [], -1
    for t, x, y, p in zip(scene.t_us.tolist(), scene.x.tolist(), scene.y.tolist(), scene.p.tolist(), strict=True):
        if t >> 6 != upper:
            upper = t >> 6
            words.append(0x8 << 28 | upper)
        words.append(int(p) << 28 | (t & 0x3F) << 22 | x << 11 | y)
    size = f"% geometry {WIDTH}x{HEIGHT}\n" if geometry else ""
    path.write_bytes(f"% evt 2.0\n{size}% end\n".encode() + front + struct.pack(f"<{len(words)}I", *words))


def evt3_words(t_us: np.ndarray, x: np.ndarray, y: np.ndarray, p: np.ndarray) -> bytes:
    """Words of 16 bits: 0x8 and 0x6 upper and lower 12 bits of the time, 0x0 the row, 0x2 an event of that row."""
    words = []
    for t, column, row, on in zip(t_us.tolist(), x.tolist(), y.tolist(), p.tolist(), strict=True):
        words += [0x8 << 12 | t >> 12 & 0xFFF, 0x6 << 12 | t & 0xFFF, row, 0x2 << 12 | int(on) << 11 | column]
    return struct.pack(f"<{len(words)}H", *words)


EVT3_MIDDLE = struct.pack("<8H", 0x2807, 0x6005, 0x0003, 0x2004, 0x3001, 0x4003, 0x6E4B, 0x2809)
"""Words as they come in the middle of a stream, with five events, before the upper bits of a time."""


def write_evt3(path: Path, scene: Scene, *, front: bytes = b"") -> None:
    header = f"% evt 3.0\n% geometry {WIDTH}x{HEIGHT}\n% end\n".encode()
    path.write_bytes(header + front + evt3_words(scene.t_us, scene.x, scene.y, scene.p))
