"""Read recordings laid out as DSEC (Gehrig et al. 2021): ``events.h5``, and PNG frames with their times.

| path | content |
|---|---|
| ``events.h5``: ``events/x``, ``y``, ``t``, ``p`` | integers [N]: px, px, us, 0 or 1 |
| ... ``t_offset`` | us to add to ``t`` for the clock of the frames |
| ... ``ms_to_idx`` | first event of each millisecond; not needed here |
| ... attributes ``width``, ``height`` | of the sensor; only ``v2v-simulate`` writes them |
| ``rectify_map.h5`` beside it: ``rectify_map`` | [H, W, 2], and so the sensor's size |
| ``*timestamps.txt`` | us, a line for each frame |
| folder of ``*.png`` | the frames, in the order of their names |

Frames of DSEC are from a second camera beside the event camera. Only frames of the sensor's size are taken.
"""

from __future__ import annotations

import posixpath
import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from v2v_protocol.errors import UsageError
from v2v_recordings import archive as archives
from v2v_recordings import hdf5
from v2v_recordings.archive import Archive
from v2v_recordings.event_columns import TimeUnit
from v2v_recordings.items import NS_PER_UNIT, ConvertOptions, Item, Note, Picture, ReadProgress, SensorSize

if TYPE_CHECKING:
    import h5py

_EVENTS, _RECTIFY_MAP, _TIMES = "events.h5", "rectify_map.h5", "timestamps.txt"
LARGEST_RATIO = 2
"""Frames more than this much larger than the area with events cannot be of the same sensor."""
OTHERS = {
    camera: re.compile(rf"(?<![a-z])({camera}|disparity|exposure|flow|semantic)(?![a-z])", re.IGNORECASE)
    for camera in ("left", "right")
}
"""What the paths of members name that are not events and frames of the camera beside this one."""


def recognises(path: Path) -> bool:
    """Return whether the path is an HDF5 file with ``events/t``, or a folder with ``events.h5`` in it."""
    if path.is_dir():
        return archives.holds(
            path, lambda archive: any(hdf5.holds(path / member, "events/t") for member in archive.named(_EVENTS))
        )
    return hdf5.holds(path, "events/t")


def read(path: Path, options: ConvertOptions, progress: ReadProgress) -> Iterator[Item]:
    """Yield the items of one camera: of a folder with two, that of ``options``.

    Raises:
        UsageError: a part is missing, damaged or has another shape.
    """
    with Archive(path) as archive:
        other = OTHERS["left" if options.camera == "right" else "right"]
        members = [member for member in archive.bytes_of if archive.is_single or not other.search(member)]
        found = [member for member in members if archive.is_single or posixpath.basename(member).lower() == _EVENTS]
        if len(found) != 1:
            listed = f" ({', '.join(found[:3])}): convert each separately" if found else "; --camera chooses another"
            raise UsageError(f"{path} holds {len(found)} recordings of the {options.camera} camera{listed}")
        events, frames = archive.folder / found[0], _frames(archive, members)
        with hdf5.open_hdf5(events) as file:
            size = options.size or _stated_size(file, events)
            if frames:
                shown, sensor = archive.size(frames[0][1]), size or _reach(file)
                ratios = shown.width / sensor.width, shown.height / sensor.height
                if shown == sensor or (size is None and 1 <= min(ratios) <= max(ratios) <= LARGEST_RATIO):
                    size = shown
                else:
                    yield Note(
                        f"{len(frames)} frames of {shown.width} x {shown.height} px are of another camera than the "
                        f"events, of {sensor.width} x {sensor.height} px: left out"
                    )
                    frames = []
            if size is not None:
                yield size
            columns = {name: file.get(f"events/{name}") for name in ("t", "x", "y", "p")}
            unit = TimeUnit.of(options, "us", hdf5.stated_unit(columns["t"]))
            offset_ns = int(NS_PER_UNIT[unit.name]) * int(np.asarray(file.get("t_offset", 0)).reshape(-1)[0])
            yield from hdf5.events(columns, str(events), progress, unit=unit, offset_ns=offset_ns)
        for t_us, member in frames:
            yield Picture(1000 * t_us, archive.picture(member))


def _stated_size(file: h5py.File, path: Path) -> SensorSize | None:
    if {"width", "height"} <= file.attrs.keys():
        return hdf5.sensor_size([file.attrs["height"], file.attrs["width"]], path)
    beside = path.with_name(_RECTIFY_MAP)
    if not beside.is_file():
        return None
    with hdf5.open_hdf5(beside) as rectify:
        return hdf5.sensor_size(rectify["rectify_map"].shape[:2], beside)


def _reach(file: h5py.File) -> SensorSize:
    """Return the area with events, of a sensor whose size is not stated."""
    columns, step = (file["events/x"], file["events/y"]), hdf5.READ_EVENTS
    return SensorSize(
        *(
            1 + max((int(column[at : at + step].max()) for at in range(0, len(column), step)), default=0)
            for column in columns
        )
    )


def _frames(archive: Archive, members: list[str]) -> list[tuple[int, str]]:
    """Return the times of the frames, us, and their members."""
    times = [member for member in members if member.lower().endswith(_TIMES)]
    frames = [member for member in members if member.lower().endswith(".png")]
    folders = sorted({posixpath.dirname(member) for member in frames})
    # DSEC-Detection has the frames twice: as seen by the event camera ("distorted"), and rectified.
    folders = [folder for folder in folders if "distorted" in folder.lower()] or folders
    if not frames:
        return []
    if len(times) != 1 or len(folders) != 1:
        raise UsageError(
            f"{archive.path} holds {len(folders)} folders of frames and {len(times)} files *{_TIMES}: give a folder "
            "with one of each"
        )
    frames = sorted(member for member in frames if posixpath.dirname(member) == folders[0])
    stamps = archive.integers(times[0])
    if len(stamps) != len(frames):
        raise UsageError(f"{archive.path}: {len(frames)} frames in {folders[0]}, but {len(stamps)} times in {times[0]}")
    return list(zip(stamps, frames, strict=True))
