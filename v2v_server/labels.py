"""Labels of a video: read boxes from the files of three common formats, and masks; and how a virtual camera sees them.

All errors of reading are ValueErrors that name the line or entry.

    .boxes.json  COCO-VID, of one video: ``frame_id`` counts from 0; each image is an annotated frame. Without it the
                 digits at the end of ``file_name`` are the frame. ``attributes`` may hold the track, as CVAT writes it
    .boxes.txt   MOT Challenge text: frames and coordinates count from 1; with eight or nine columns the eighth is the
                 class, with ten columns too if they are VisDrone's
    .boxes/      YOLO text, a file a frame: the digits at the end of the name are the frame, from 0

In MOT and YOLO files a frame without a line has no objects. Entries marked to be ignored (``iscrowd`` or ``ignore`` of
COCO, seventh column 0 of MOT) are left out.

Coordinates of boxes are px of the upright picture, continuous: pixel (row, column) covers column <= x < column + 1.
Frames count from 0 in presentation order.

    .masks/      class masks: a PNG file a frame, whose grey levels or palette indices are the classes; the digits at
                 the end of the name are the frame, from 0

A reader cannot tell everything from the file: :func:`check_labels` compares all labels of a video with the video.

A camera crops, resizes and mirrors boxes and masks like the pictures (:mod:`v2v_server.simulation.view`). cv2 resizes
by the ratio of the whole sizes, with pixel centres at half coordinates, so a continuous coordinate x becomes
x width' / width.
"""

from __future__ import annotations

import codecs
import io
import re
import zlib
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.resources.abc import Traversable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from v2v_protocol.persisted import parse_json
from v2v_protocol.recipe import Recipe
from v2v_protocol.sample import SampleParams
from v2v_server.simulation.draw import resized_size
from v2v_server.simulation.view import Window

NO_TRACK = -1
LARGEST_NUMBER = 2**24 - 1
"""Largest class and track: float32 holds all whole numbers up to here."""
_LARGEST_FRAME = 2**40
_LARGEST_PX = 1e6
_LARGEST_BYTES = 64 << 20
"""Limit of a file of boxes. Reading one takes up to 15 s and 1 GiB."""
_MOT_COLUMNS = "frame, track, left, top, width, height, confidence, class, visibility"
_YOLO_COLUMNS = "class, centre x, centre y, width, height, and optionally the track"
_NO_COORDINATES = [-1.0, -1.0, -1.0]
_NUMBER = re.compile(r"(\d{1,12})\.\w+$", re.ASCII)
_ROBOFLOW = re.compile(r"_(jpe?g|png|bmp|webp)\.rf\.\w+(?=\.\w+$)", re.IGNORECASE)
"""What Roboflow adds to a name; its hash may end with digits."""
_NO_FRAME = re.compile(r"(\w*classes|labels|labelmap|\w*names|notes|readme.*|train|val|valid|test)\.txt", re.IGNORECASE)
"""Texts that label tools write beside those of the frames."""
_GREY, _PALETTE = 0, 3
"""Colour types of a PNG file, its byte 25; byte 24 is the number of bits."""


class Box(NamedTuple):
    """One box of one frame.

    Attributes:
        frame: from 0.
        left, top, width, height: px.
        category: class, from 0.
        track: from 0, or NO_TRACK.
    """

    frame: int
    left: float
    top: float
    width: float
    height: float
    category: int
    track: int


@dataclass(frozen=True, slots=True, eq=False)
class BoxTable:
    """All boxes of a video, ordered by frame.

    Attributes:
        frames: [n] int64, ascending.
        corners: [n, 4] float64: x0, y0, x1, y1, px.
        numbers: [n, 2] int64: class and track.
        annotated: frames that have labels, with boxes or without; None: all frames.
    """

    frames: npt.NDArray[np.int64]
    corners: npt.NDArray[np.float64]
    numbers: npt.NDArray[np.int64]
    annotated: frozenset[int] | None = None

    @classmethod
    def of(cls, boxes: Sequence[Box], annotated: frozenset[int] | None = None) -> BoxTable:
        """Build the table from boxes that :func:`checked` has passed, in any order."""
        ordered = sorted(boxes, key=lambda box: box.frame)  # stable: boxes of a frame keep the file's order
        frames = np.array([box.frame for box in ordered], np.int64)
        places = np.array([box[1:5] for box in ordered], np.float64).reshape(-1, 4)
        numbers = np.array([box[5:] for box in ordered], np.int64).reshape(-1, 2)
        corners = np.concatenate([places[:, :2], places[:, :2] + places[:, 2:]], axis=1)
        return cls(frames, corners, numbers, annotated)

    def at(self, frame: int) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int64]]:
        """Return corners, [n, 4], and numbers, [n, 2], of the boxes of one frame.

        Raises:
            ValueError: the frame has no labels.
        """
        if self.annotated is not None and frame not in self.annotated:
            raise ValueError(f"has no frame {frame}: add it, also if it shows no object")
        first, end = np.searchsorted(self.frames, (frame, frame + 1))
        return self.corners[first:end], self.numbers[first:end]


def checked(where: str, box: Box) -> Box:
    """Return the box, which lies at ``where``.

    Raises:
        ValueError: one of its numbers is outside its limits.
    """
    if not 0 <= box.frame <= _LARGEST_FRAME:
        raise ValueError(f"{where}: frame {box.frame} of a box: give a whole number from 0")
    if not all(-_LARGEST_PX <= number <= _LARGEST_PX for number in box[1:5]):  # also NaN
        raise ValueError(f"{where}: box {list(box[1:5])}: coordinates are at most {_LARGEST_PX:g} px")
    if box.width < 0 or box.height < 0:
        raise ValueError(f"{where}: box {list(box[1:5])}: width and height are at least 0")
    if not 0 <= box.category <= LARGEST_NUMBER:
        raise ValueError(f"{where}: class {box.category}: give a whole number from 0 to {LARGEST_NUMBER}")
    if not NO_TRACK <= box.track <= LARGEST_NUMBER:
        what = f"give a whole number from 0 to {LARGEST_NUMBER}, or {NO_TRACK} for none"
        raise ValueError(f"{where}: track {box.track}: {what}")
    return box


def read_coco(file: Traversable, picture_px: tuple[int, int]) -> BoxTable:
    """Read a COCO-VID file.

    Raises:
        ValueError: it is malformed, or describes another video.
    """
    content = parse_json(_content(file))
    if not isinstance(content, dict):
        raise ValueError("is not a JSON object with images and annotations")
    if len(videos := _list(content, "videos", optional=True)) > 1:
        raise ValueError(f"describes {len(videos)} videos: write one file for each video")
    for place, video in enumerate(videos):
        _Entry(f"videos[{place}]", video).check_size(picture_px)
    frames, numbers, ids = dict[int, int](), set[int](), set[str]()
    for place, image in enumerate(_list(content, "images")):
        with_place = _Entry(f"images[{place}]", image)
        with_place.check_size(picture_px)
        id, number = with_place.whole("id"), frame_of(str(with_place.get("file_name")))
        if number is None or with_place.get("frame_id") is not None:
            number = with_place.whole("frame_id")
        if id in frames or number in numbers:
            raise ValueError(f"images[{place}]: id {id} or frame {number} is there twice: give each image its own")
        frames[id] = number
        numbers.add(number)
    boxes = []
    for place, annotation in enumerate(_list(content, "annotations")):
        entry = _Entry(f"annotations[{place}]", annotation)
        if entry.get("id") is not None and (name := repr(entry.get("id"))) in ids:
            raise ValueError(f"annotations[{place}]: id {name:.40} is there twice: give each annotation its own")
        ids.add(repr(entry.get("id")))
        if entry.get("iscrowd") or entry.get("ignore"):
            continue
        if (image := entry.whole("image_id")) not in frames:
            raise ValueError(f"annotations[{place}]: images has no id {image}")
        box = Box(frames[image], *entry.four("bbox"), entry.whole("category_id"), entry.track())
        boxes.append(checked(f"annotations[{place}]", box))
    return BoxTable.of(boxes, frozenset(numbers))


def read_mot(file: Traversable, picture_px: tuple[int, int]) -> BoxTable:
    """Read a MOT Challenge text.

    Raises:
        ValueError: a line is malformed.
    """
    boxes = []
    for where, line in _lines(file):
        values = _numbers(where, line.split(","), _MOT_COLUMNS, 6, 10)
        category = _whole(where, _mot_class(where, values))
        if len(values) > 6 and values[6] == 0:
            continue
        frame, track, left, top, width, height = values[:6]
        if frame < 1:
            raise ValueError(f"{where}: frame {frame:g}: MOT counts frames from 1")
        # Tools write -1 for the track of a detection.
        box = Box(_whole(where, frame) - 1, left - 1, top - 1, width, height, category, _whole(where, track))
        boxes.append(checked(where, box))
    return BoxTable.of(boxes)


def _mot_class(where: str, values: list[float]) -> float:
    """Return the class of a line.

    Raises:
        ValueError: its columns mean something else than those of MOT or VisDrone.
    """
    count, more = len(values), values[6:]
    is_visdrone = count == 10 and values[7] in range(12) and values[8] in (0, 1) and values[9] in (0, 1, 2)
    if (
        (count == 7 and values[6] > 1 and values[6] % 1 == 0)  # a class where MOT has the confidence
        or (count == 9 and values[8] != -1 and not 0 <= values[8] <= 1)  # a class where MOT has the visibility
        or (count == 10 and values[7:] != _NO_COORDINATES and not is_visdrone)
    ):
        raise ValueError(f"{where} ends with {more}, columns neither of MOT nor of VisDrone: give {_MOT_COLUMNS}")
    return values[7] if count in (8, 9) or is_visdrone else 0.0


def read_yolo(folder: Traversable, picture_px: tuple[int, int]) -> BoxTable:
    """Read a folder of YOLO texts.

    Args:
        folder: the files.
        picture_px: height and width of the picture, which the coordinates are shares of.

    Raises:
        ValueError: a line is malformed.
    """
    boxes = []
    height_px, width_px = picture_px
    for frame, file in numbered_files(folder, ".txt").items():
        for where, line in _lines(file):
            where = f"{file.name} {where}"
            values = _numbers(where, line.split(), _YOLO_COLUMNS, 5, 6)
            if not all(-1 <= value <= 2 for value in values[1:5]):  # boxes may reach beyond the picture
                raise ValueError(f"{where}: box {values[1:5]}: give shares of the picture, from 0 to 1, not px")
            x, y, width, height = (
                value * size for value, size in zip(values[1:5], (width_px, height_px) * 2, strict=True)
            )
            track = _whole(where, values[5]) if len(values) == 6 else NO_TRACK
            category = _whole(where, values[0])
            boxes.append(checked(where, Box(frame, x - width / 2, y - height / 2, width, height, category, track)))
    return BoxTable.of(boxes)


def read_mask(file: Traversable, picture_px: tuple[int, int]) -> npt.NDArray[np.uint8]:
    """Read the mask of one frame: [height, width] uint8.

    Args:
        file: a PNG file of 8 bits a pixel or fewer, grey or with a palette.
        picture_px: height and width of the video's upright picture.

    Raises:
        ValueError: it is another kind of picture, has another size, or is damaged.
    """
    from PIL import Image  # only samples with masks need it

    from v2v_server.video.picture_file import check_rows, read_head

    data = file.read_bytes()
    try:
        with Image.open(io.BytesIO(data), formats=["PNG"]) as picture:
            if (size := (picture.height, picture.width)) != picture_px:
                raise ValueError(f"has {size[1]}x{size[0]} px: the video has {picture_px[1]}x{picture_px[0]} px")
            if data[25] != _PALETTE and (data[25], data[24]) not in ((_GREY, 1), (_GREY, 8)):  # Pillow rescales others
                raise ValueError("is neither 8-bit grey nor a palette: write the classes as one of these")
            check_rows(data)
            if (exif := read_head(data).exif) != 1:
                raise ValueError(f"has Exif orientation {exif}: write it upright")
            return np.asarray(picture).astype(np.uint8)
    except (OSError, SyntaxError, ValueError, zlib.error, Image.DecompressionBombError) as error:  # Pillow raises most
        raise ValueError(f"{file.name} {error}") from error


READERS: Mapping[str, Callable[[Traversable, tuple[int, int]], BoxTable]] = {
    ".boxes.json": read_coco,
    ".boxes.txt": read_mot,
    ".boxes/": read_yolo,
}
"""Reader of each ending. Arguments: the opened sidecar, and height and width of the video's upright picture."""


_MEANING = {
    ".boxes.json": ("COCO", "left, top, width, height", 0, False),
    ".boxes.txt": ("MOT", "left, top, width, height", 1, False),
    ".boxes/": ("YOLO", "centre x, centre y, width, height", 0, True),
}
"""Name of the format, meaning of its numbers, offset of the file's coordinates, whether two are centres in shares."""
_BORDER_PX = 1.0
"""Boxes may leave the picture by this: formats round and count differently."""
_FRAME_FILES = {".boxes/": ".txt", ".masks/": ".png"}


def check_labels(ending: str, opened: Traversable, picture_px: tuple[int, int], frames: int) -> str:
    """Check that labels fit their video, and return which files of a folder are not read; "" if all are.

    Args:
        ending: of the sidecar; one of another ending is not checked.
        opened: the sidecar, whole.
        picture_px: height and width of the video's upright picture.
        frames: number of frames of the video.

    Raises:
        ValueError: the labels are malformed, or do not fit.
    """
    numbers: Collection[int] = ()
    first, not_read = int(ending == ".boxes.txt"), ""
    if suffix := _FRAME_FILES.get(ending):
        numbers = files = numbered_files(opened, suffix)
        if not files:
            raise ValueError(f"has no file named by the number of a frame, like 000012{suffix}")
        others = {each.name for each in opened.iterdir()} - {file.name for file in files.values()}
        if others := {name for name in others if not name.startswith(".")}:
            not_read = f"{len(others)} of its files are not read, such as {min(others)}"
    if ending == ".masks/":
        read_mask(files[min(files)], picture_px)
    elif ending in READERS:
        table = READERS[ending](opened, picture_px)
        numbers = numbers or (table.frames.tolist() if table.annotated is None else table.annotated)
        _check_meaning(ending, table, picture_px)
        _check_boxes(table, picture_px)
    if numbers and (max(numbers) >= frames or (not first and min(numbers) == 1)):
        raise ValueError(
            f"has labels of frames {min(numbers) + first} to {max(numbers) + first}: the video has frames {first} to "
            f"{frames - 1 + first}, so number them from {first}. If frame {first} has no labels, add it without any"
        )
    return not_read


def _check_meaning(ending: str, table: BoxTable, picture_px: tuple[int, int]) -> None:
    """Check that the boxes are not corners, read as what the format has.

    Raises:
        ValueError: at least half of them leave the picture, and those are boxes in the picture if they are corners.
    """
    (name, numbers, offset, has_centres), size = _MEANING[ending], np.array(picture_px[::-1])
    starts, ends = np.hsplit(table.corners, 2)
    leaves = np.flatnonzero(((starts < -_BORDER_PX) | (ends > size + _BORDER_PX)).any(axis=1))
    sides = (ends - starts)[leaves]
    firsts = starts[leaves] + has_centres * sides / 2
    are_corners = (firsts >= -_BORDER_PX) & (firsts < sides) & (sides <= size + _BORDER_PX)
    if len(leaves) and 2 * len(leaves) >= len(starts) and are_corners.all():
        given = np.concatenate([firsts[0] + offset, sides[0]]) / ([*size, *size] if has_centres else 1)
        shown = f"{[float(f'{value:.6g}') for value in given]} of frame {table.frames[leaves[0]]} (from 0)"
        raise ValueError(
            f"{len(leaves)} of {len(starts)} boxes leave the picture of {size[0]}x{size[1]} px, such as {shown}, but "
            f"none if the numbers are corners: left, top, right, bottom. {name} has {numbers}: convert them"
        )


def _check_boxes(table: BoxTable, picture_px: tuple[int, int]) -> None:
    """Check the unit of the boxes, and that no object is twice in a frame.

    Raises:
        ValueError: they are in shares, were drawn at another size, or a track repeats.
    """
    (height, width), (left, top, right, bottom) = picture_px, table.corners.T
    if len(left) and max(right.max(), bottom.max()) <= 1:
        raise ValueError("all boxes lie in the first pixel: give px, not shares of the picture")
    is_outside = (right <= 0) | (bottom <= 0) | (left >= width) | (top >= height)
    if 2 * (count := np.count_nonzero(is_outside)) > len(left):
        what = f"{count} of {len(left)} boxes lie outside the picture of {width}x{height} px"
        raise ValueError(f"{what}: draw them at the size of the video")
    objects = np.column_stack([table.frames, table.numbers])[table.numbers[:, 1] != NO_TRACK]
    found, counts = np.unique(objects, axis=0, return_counts=True)
    if len(found) < len(objects):
        frame, category, track = found[counts.argmax()].tolist()
        raise ValueError(
            f"frame {frame} (from 0) has track {track} of class {category} twice: give each object its own"
        )


def frame_of(name: str) -> int | None:
    """Return the number at the end of a file's name; None if there is none."""
    match = _NUMBER.search(_ROBOFLOW.sub("", name))
    return None if match is None else int(match[1])


def numbered_files(folder: Traversable, suffix: str) -> dict[int, Traversable]:
    """Return the files of a folder by the number at the end of their names.

    Raises:
        ValueError: a name has no number, or two have the same.
    """
    found: dict[int, Traversable] = {}
    for file in sorted(folder.iterdir(), key=lambda entry: entry.name):
        if file.name.startswith(".") or not file.name.lower().endswith(suffix) or _NO_FRAME.fullmatch(file.name):
            continue
        number = frame_of(file.name)
        if number is None:
            raise ValueError(f"{file.name}: give it a name that ends with the number of its frame, like 000012{suffix}")
        if number in found:
            raise ValueError(f"{found[number].name} and {file.name} are both of frame {number}: keep one")
        found[number] = file
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

    def track(self) -> int:
        inner = self.get("attributes")
        for entry in self, _Entry(f"{self._place}.attributes", inner if isinstance(inner, dict) else {}):
            for key in ("instance_id", "track_id"):
                if entry.get(key) is not None:
                    return entry.whole(key)
        return NO_TRACK

    def check_size(self, picture_px: tuple[int, int]) -> None:
        height, width = picture_px
        if (stated := (self.get("width") or width, self.get("height") or height)) != (width, height):
            what = f"{self._place} has {stated[0]!r:.20}x{stated[1]!r:.20} px, the video {width}x{height} px"
            raise ValueError(f"{what}: scale its boxes to the video, and state that size")


def _list(content: Mapping[str, Any], key: str, optional: bool = False) -> list[Any]:
    value = content.get(key, [] if optional else None)
    if not isinstance(value, list):
        raise ValueError(f"has no list {key!r}: COCO-VID has images and annotations")
    return value


def _content(file: Traversable) -> bytes:
    with file.open("rb") as stream:
        data: bytes = stream.read(_LARGEST_BYTES + 1)
    if len(data) > _LARGEST_BYTES:
        raise ValueError(f"has more than {_LARGEST_BYTES} bytes, the limit of a file of boxes: cut the video")
    return data


def _lines(file: Traversable) -> Iterator[tuple[str, str]]:
    """Yield the lines that are not empty, each with its number for error messages."""
    data = _content(file)
    is_wide = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    for number, line in enumerate(io.TextIOWrapper(io.BytesIO(data), "utf-16" if is_wide else "utf-8-sig"), 1):
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


LEAST_SHARE = 0.1
"""Smallest share of a box in the crop with which the box stays."""
LEAST_SIDE_PX = 2.0
"""Smallest width and height in the crop with which a box stays, px."""


def view_boxes(
    corners: npt.NDArray[np.float64], picture: Window, params: SampleParams, recipe: Recipe
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return boxes in the crop, clipped to it, and the share of each box's area that lies in it.

    Args:
        corners: [n, 4], x0, y0, x1, y1 in the upright picture, px.
        picture: its usable part.
        params, recipe: the draw and its recipe.

    Returns:
        [n, 4] corners in the crop, and [n] shares; 0 for a box without area.
    """
    height, width = resized_size(picture.height_px, picture.width_px, params.scale)
    scale = np.array([width / picture.width_px, height / picture.height_px])
    shift = np.array([params.crop_left_px, params.crop_top_px])
    points = (corners.reshape(-1, 2, 2) - (picture.left_px, picture.top_px)) * scale - shift
    if params.flip:
        points[:, :, 0] = recipe.crop_width_px - points[:, ::-1, 0]
    clipped = np.clip(points, 0.0, (recipe.crop_width_px, recipe.crop_height_px))
    whole, seen = (np.prod(each[:, 1] - each[:, 0], axis=1) for each in (points, clipped))
    share = np.divide(seen, whole, out=np.zeros_like(seen), where=whole > 0)
    return clipped.reshape(-1, 4), np.minimum(share, 1.0)


def kept_boxes(corners: npt.NDArray[np.float64], share: npt.NDArray[np.float64]) -> npt.NDArray[np.int64]:
    """Return the numbers of the boxes that stay, largest area in the crop first; equal ones keep their order.

    Args:
        corners, share: [n, 4] and [n], as :func:`view_boxes` returns them.
    """
    sides = corners[:, 2:] - corners[:, :2]
    stays = (share >= LEAST_SHARE) & (sides >= LEAST_SIDE_PX).all(axis=1)
    (kept,) = np.nonzero(stays)
    order = np.argsort(-np.prod(sides[kept], axis=1), kind="stable")
    return np.asarray(kept[order], np.int64)


def view_mask(mask: npt.NDArray[Any], picture: Window, params: SampleParams, recipe: Recipe) -> npt.NDArray[Any]:
    """Return a map of the upright picture as the camera sees it: the value at each pixel's centre.

    Args:
        mask: [height, width] of the whole upright picture.
        picture: its usable part.
        params, recipe: the draw and its recipe.

    Returns:
        [crop_height_px, crop_width_px].
    """
    height, width = resized_size(picture.height_px, picture.width_px, params.scale)
    rows = _nearest(params.crop_top_px, recipe.crop_height_px, height, picture.height_px) + picture.top_px
    columns = _nearest(params.crop_left_px, recipe.crop_width_px, width, picture.width_px) + picture.left_px
    return mask[np.ix_(rows, columns[::-1] if params.flip else columns)]


def _nearest(first: int, count: int, resized: int, size: int) -> npt.NDArray[np.int64]:
    """Return which of ``size`` pixels lies at the centre of each of ``count`` pixels of the resized picture."""
    # floor((place + 1/2) size / resized) in whole numbers.
    return (2 * np.arange(first, first + count, dtype=np.int64) + 1) * size // (2 * resized)
