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
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from v2v_protocol.errors import UsageError
from v2v_recordings import hdf5
from v2v_recordings.archive import Archive
from v2v_recordings.items import ConvertOptions, EventChunk, Item, Note, Picture, Progress, SensorSize, to_ns

EVENTS, RECTIFY_MAP, TIMES = "events.h5", "rectify_map.h5", "timestamps.txt"
COLUMNS = ("x", "y", "t", "p")
LARGEST_RATIO = 2
"""Frames more than this much larger than the area with events cannot be of the same sensor."""


def recognises(path: Path) -> bool:
    """Return whether the path is an HDF5 file with ``events/t``, or a folder with ``events.h5`` in it."""
    if path.is_dir():
        with Archive(path) as archive:
            return any(hdf5.holds(path / member, "events/t") for member in archive.named(EVENTS))
    return hdf5.holds(path, "events/t")


def read(path: Path, options: ConvertOptions, progress: Progress) -> Iterator[Item]:
    """Yield the items of one camera: of a folder with two, that of ``options``.

    Raises:
        UsageError: a part is missing, damaged or has another shape.
    """
    if not path.is_dir():
        yield from _events(path, _stated_size(path), progress)
        return
    with Archive(path) as archive:
        found = _of_camera(archive.named(EVENTS), options.camera)
        if len(found) != 1:
            raise UsageError(f"{path} holds {len(found)} recordings ({', '.join(found[:3])}): convert each separately")
        events = path / found[0]
        size, frames = options.size or _stated_size(events), _frames(archive, options.camera)
        if frames:
            shown, sensor = archive.size(frames[0][1]), size or _reach(events)
            ratios = shown.width / sensor.width, shown.height / sensor.height
            if shown != sensor if size else not 1 <= min(ratios) <= max(ratios) <= LARGEST_RATIO:
                yield Note(
                    f"{len(frames)} frames of {shown.width} x {shown.height} px are of another camera than the events, "
                    f"of {sensor.width} x {sensor.height} px: left out"
                )
                frames = []
            else:
                size = shown
        yield from _events(events, size, progress)
        for t_us, member in frames:
            yield Picture(t_us * 1000, archive.picture(member))


def _of_camera(members: list[str], camera: str) -> list[str]:
    """Return the members whose path names the camera; all of them if none does."""
    return [member for member in members if camera in member.lower()] or members


def _stated_size(path: Path) -> SensorSize | None:
    with hdf5.open_hdf5(path) as file:
        if {"width", "height"} <= file.attrs.keys():
            return hdf5.sensor_size([file.attrs["height"], file.attrs["width"]], path)
    beside = path.with_name(RECTIFY_MAP)
    if not beside.is_file():
        return None
    with hdf5.open_hdf5(beside) as file:
        return hdf5.sensor_size(file["rectify_map"].shape[:2], beside)


def _events(path: Path, size: SensorSize | None, progress: Progress) -> Iterator[Item]:
    if size is not None:
        yield size
    with hdf5.open_hdf5(path) as file:
        offset_us = int(np.asarray(file.get("t_offset", 0)).reshape(-1)[0])
        for x, y, t, p in hdf5.columns(file["events"], COLUMNS, path, progress):
            yield EventChunk(to_ns(t, str(path), 1e3) + 1000 * offset_us, x, y, p > 0)


def _reach(path: Path) -> SensorSize:
    """Return the area with events, of a sensor whose size is not stated."""
    width = height = 1
    with hdf5.open_hdf5(path) as file:
        for x, y in hdf5.columns(file["events"], COLUMNS[:2], path, lambda _done, _total: None):
            width, height = max(width, int(x.max()) + 1), max(height, int(y.max()) + 1)
    return SensorSize(width, height)


def _frames(archive: Archive, camera: str) -> list[tuple[int, str]]:
    """Return the times of the frames, us, and their members."""
    times = [member for member in archive.bytes_of if posixpath.basename(member).lower().endswith(TIMES)]
    times = _of_images([member for member in times if "exposure" not in member.lower()])
    frames = _of_images(_of_camera([member for member in archive.bytes_of if member.lower().endswith(".png")], camera))
    folders = sorted({posixpath.dirname(member) for member in frames})
    # DSEC-Detection has the frames twice: as seen by the event camera ("distorted"), and rectified.
    folders = [folder for folder in folders if "distorted" in folder.lower()] or folders
    if not frames:
        return []
    if len(times) != 1 or len(folders) != 1:
        raise UsageError(
            f"{archive.path} holds {len(folders)} folders of frames and {len(times)} files *{TIMES}: give a folder "
            "with one of each"
        )
    frames = sorted(member for member in frames if posixpath.dirname(member) == folders[0])
    stamps = archive.integers(times[0])
    if len(stamps) != len(frames):
        raise UsageError(f"{archive.path}: {len(frames)} frames in {folders[0]}, but {len(stamps)} times in {times[0]}")
    return list(zip(stamps, frames, strict=True))


def _of_images(members: list[str]) -> list[str]:
    """Return the members whose path speaks of images, not of disparity or flow; all of them if none does."""
    return [member for member in members if "image" in member.lower()] or members
