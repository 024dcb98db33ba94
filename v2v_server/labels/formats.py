"""Read boxes from the files of three common formats. All errors are ValueErrors that name the line or entry.

    .boxes.json  COCO-VID, of one video: ``frame_id`` counts from 0; each image is an annotated frame
    .boxes.txt   MOT Challenge text: frames and coordinates count from 1; with nine columns the eighth is the class
    .boxes/      YOLO text, a file a frame: the digits at the end of the name are the frame, from 0

In MOT and YOLO files a frame without a line has no objects. Entries marked to be ignored (``iscrowd`` or ``ignore`` of
COCO, seventh column 0 of MOT) are left out.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from importlib.resources.abc import Traversable
from typing import Any

from v2v_protocol.safe_json import parse_json
from v2v_server.labels.boxes import NO_TRACK, Box, BoxTable, checked

_MOT_COLUMNS = "frame, track, left, top, width, height, confidence, class, visibility"
_YOLO_COLUMNS = "class, centre x, centre y, width, height, and optionally the track"
_NUMBER = re.compile(r"(\d{1,12})\.\w+$", re.ASCII)


def read_coco(file: Traversable, picture_px: tuple[int, int]) -> BoxTable:
    """Read a COCO-VID file."""
    content = parse_json(file.read_bytes())
    if not isinstance(content, dict):
        raise ValueError("is not a JSON object with images and annotations")
    if len(videos := _list(content, "videos", optional=True)) > 1:
        raise ValueError(f"describes {len(videos)} videos: write one file for each video")
    frames = {}
    for place, image in enumerate(_list(content, "images")):
        with_place = _Entry(f"images[{place}]", image)
        frames[with_place.whole("id")] = with_place.whole("frame_id")
    boxes = []
    for place, annotation in enumerate(_list(content, "annotations")):
        entry = _Entry(f"annotations[{place}]", annotation)
        if entry.get("iscrowd") or entry.get("ignore"):
            continue
        if (image := entry.whole("image_id")) not in frames:
            raise ValueError(f"annotations[{place}]: images has no id {image}")
        track = next((entry.whole(key) for key in ("instance_id", "track_id") if entry.get(key) is not None), NO_TRACK)
        box = Box(frames[image], *entry.four("bbox"), entry.whole("category_id"), track)
        boxes.append(entry.checked(box))
    return BoxTable.of(boxes, frozenset(frames.values()))


def read_mot(file: Traversable, picture_px: tuple[int, int]) -> BoxTable:
    """Read a MOT Challenge text."""
    boxes = []
    for where, line in _lines(file):
        values = _numbers(where, line.split(","), _MOT_COLUMNS, 6, 10)
        if len(values) > 6 and values[6] == 0:
            continue
        frame, track, left, top, width, height = values[:6]
        if frame < 1:
            raise ValueError(f"{where}: frame {frame:g}: MOT counts frames from 1")
        category = _whole(where, values[7]) if len(values) == 9 else 0
        # Tools write -1 for the track of a detection.
        box = Box(_whole(where, frame) - 1, left - 1, top - 1, width, height, category, _whole(where, track))
        boxes.append(_checked(where, box))
    return BoxTable.of(boxes)


def read_yolo(folder: Traversable, picture_px: tuple[int, int]) -> BoxTable:
    """Read a folder of YOLO texts.

    Args:
        folder: the files.
        picture_px: height and width of the picture, which the coordinates are shares of.
    """
    boxes = []
    height_px, width_px = picture_px
    for frame, file in numbered_files(folder, ".txt").items():
        for where, line in _lines(file):
            where = f"{file.name} {where}"
            values = _numbers(where, line.split(), _YOLO_COLUMNS, 5, 6)
            x, y, width, height = (
                value * size for value, size in zip(values[1:5], (width_px, height_px) * 2, strict=True)
            )
            track = _whole(where, values[5]) if len(values) == 6 else NO_TRACK
            category = _whole(where, values[0])
            boxes.append(_checked(where, Box(frame, x - width / 2, y - height / 2, width, height, category, track)))
    return BoxTable.of(boxes)


READERS: Mapping[str, Callable[[Traversable, tuple[int, int]], BoxTable]] = {
    ".boxes.json": read_coco,
    ".boxes.txt": read_mot,
    ".boxes/": read_yolo,
}
"""Reader of each ending. Arguments: the opened sidecar, and height and width of the video's upright picture."""


def numbered_files(folder: Traversable, suffix: str) -> dict[int, Traversable]:
    """Return the files of a folder by the number at the end of their names.

    Raises:
        ValueError: a name has no number, or two have the same.
    """
    found: dict[int, Traversable] = {}
    for file in sorted(folder.iterdir(), key=lambda entry: entry.name):
        if file.name.startswith(".") or not file.name.lower().endswith(suffix):
            continue
        match = _NUMBER.search(file.name)
        if match is None:
            raise ValueError(f"{file.name}: give it a name that ends with the number of its frame, like 000012{suffix}")
        if int(match[1]) in found:
            raise ValueError(f"{found[int(match[1])].name} and {file.name} are both of frame {int(match[1])}: keep one")
        found[int(match[1])] = file
    return found


class _Entry:
    """An object of a JSON list, with its place for error messages."""

    def __init__(self, place: str, values: object) -> None:
        if not isinstance(values, dict):
            raise ValueError(f"{place} is {values!r:.40}: it must be an object")
        self._place, self._values = place, values

    def get(self, key: str) -> Any:
        return self._values.get(key)

    def whole(self, key: str) -> int:
        value = self.get(key)
        if isinstance(value, bool) or not isinstance(value, int):
            raise ValueError(f"{self._place}.{key} is {value!r:.40}: it must be a whole number")
        return value

    def four(self, key: str) -> tuple[float, float, float, float]:
        value = self.get(key)
        are_numbers = isinstance(value, list) and all(type(each) in (int, float) for each in value)
        if not isinstance(value, list) or len(value) != 4 or not are_numbers:
            raise ValueError(f"{self._place}.{key} is {value!r:.80}: it must be [left, top, width, height]")
        left, top, width, height = value
        return left, top, width, height

    def checked(self, box: Box) -> Box:
        return _checked(self._place, box)


def _list(content: Mapping[str, Any], key: str, optional: bool = False) -> list[Any]:
    value = content.get(key, [] if optional else None)
    if not isinstance(value, list):
        raise ValueError(f"has no list {key!r}: COCO-VID has images and annotations")
    return value


def _lines(file: Traversable) -> Iterator[tuple[str, str]]:
    """Yield the lines that are not empty, each with its number for error messages."""
    for number, line in enumerate(file.read_text(encoding="utf-8").splitlines(), 1):
        if line.strip():
            yield f"line {number}", line


def _numbers(where: str, values: list[str], columns: str, least: int, most: int) -> list[float]:
    if not least <= len(values) <= most:
        raise ValueError(f"{where} has {len(values)} values: give {columns}")
    try:
        return [float(value) for value in values]
    except ValueError as error:
        raise ValueError(f"{where}: {error}: give {columns}") from None


def _whole(where: str, value: float) -> int:
    if not value.is_integer():
        raise ValueError(f"{where}: {value} is not a whole number; frame, class and track are")
    return int(value)


def _checked(where: str, box: Box) -> Box:
    try:
        return checked(box)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from None
