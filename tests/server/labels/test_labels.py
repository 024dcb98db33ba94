"""Labels: three formats of boxes say the same, errors name line and remedy, and labels follow the view."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from PIL import Image

from tests.server.picture_files import encoded, png_of_ffmpeg, shortened
from v2v_protocol.recipe import Recipe
from v2v_protocol.sample import SampleParams
from v2v_server import labels as formats
from v2v_server.labels import (
    LEAST_SHARE,
    LEAST_SIDE_PX,
    READERS,
    BoxTable,
    check_labels,
    frame_of,
    kept_boxes,
    numbered_files,
    read_mask,
    view_boxes,
)
from v2v_server.simulation.view import Window

PICTURE_PX = (60, 80)
Boxes = list[tuple[int, int, int, int, int, int, int]]
box = st.tuples(
    st.integers(0, 9), st.integers(-8, 70), st.integers(-8, 50), st.integers(1, 40), st.integers(1, 40),
    st.integers(0, 90), st.integers(0, 5),
)  # fmt: skip


def write_coco(path: Path, boxes: Boxes, frames: int = 10) -> Path:
    images = [{"id": 7 + frame, "frame_id": frame} for frame in range(frames)]
    annotations = [
        {"image_id": 7 + frame, "bbox": list(place), "category_id": category, "instance_id": track}
        for frame, *place, category, track in boxes
    ]
    path.write_text(json.dumps({"videos": [{"id": 1}], "images": images, "annotations": annotations}))
    return path


def write_mot(path: Path, boxes: Boxes) -> Path:
    lines = [
        f"{frame + 1},{track},{left + 1},{top + 1},{width},{height},1,{category},0.5"
        for frame, left, top, width, height, category, track in boxes
    ]
    path.write_text("\n".join([*lines, "1,9,1,1,5,5,0,1,1.0", ""]))  # confidence 0: to be ignored
    return path


def write_yolo(folder: Path, boxes: Boxes) -> Path:
    folder.mkdir(exist_ok=True)
    for frame in range(10):
        lines = [
            f"{category} {(left + width / 2) / 80!r} {(top + height / 2) / 60!r} {width / 80!r} {height / 60!r} {track}"
            for number, left, top, width, height, category, track in boxes
            if number == frame
        ]
        (folder / f"clip_{frame:04}.txt").write_text("\n".join(lines))
    return folder


def read(ending: str, path: Path) -> BoxTable:
    return READERS[ending](path, PICTURE_PX)


@settings(max_examples=50)
@given(boxes=st.lists(box, max_size=12))
def test_all_formats_give_the_same_boxes(tmp_path_factory: pytest.TempPathFactory, boxes: Boxes) -> None:
    folder = tmp_path_factory.mktemp("labels")
    tables = [
        read(".boxes.json", write_coco(folder / "a.boxes.json", boxes)),
        read(".boxes.txt", write_mot(folder / "a.boxes.txt", boxes)),
        read(".boxes/", write_yolo(folder / "a.boxes", boxes)),
    ]
    for frame in range(10):
        here = [each for each in boxes if each[0] == frame]
        corners = [[left, top, left + width, top + height] for _, left, top, width, height, *_ in here]
        for table in tables:
            found, numbers = table.at(frame)
            np.testing.assert_allclose(found, np.array(corners, float).reshape(-1, 4), atol=1e-9)
            assert numbers.tolist() == [list(each[5:]) for each in here]


def test_a_frame_that_coco_does_not_list_has_no_labels(tmp_path: Path) -> None:
    table = read(".boxes.json", write_coco(tmp_path / "a.boxes.json", [(2, 0, 0, 4, 4, 1, 1)], frames=3))
    assert len(table.at(1)[0]) == 0
    with pytest.raises(ValueError, match="has no frame 3"):
        table.at(3)


def check(ending: str, path: Path, frames: int = 10) -> str:
    return check_labels(ending, path, PICTURE_PX, frames)


def sized(**size: int) -> dict[str, Any]:
    box = {"id": 1, "image_id": 1, "bbox": [4, 5, 6, 7], "category_id": 2}
    return {"images": [{"id": 1, "frame_id": 0, **size}], "annotations": [box]}


def mot(frame: int, tail: str = "") -> str:
    return f"{frame},7,11,21,30,20{tail}\n"


GOOD = {"images": [{"id": 1, "frame_id": 0}], "annotations": []}


@pytest.mark.parametrize(
    ("ending", "content", "message"),
    [
        (".boxes.json", sized(width=160, height=120), r"images\[0\] has 160x120 px, the video 80x60 px"),
        (".boxes.json", sized(width=60, height=80), r"has 60x80 px, the video 80x60 px"),
        (".boxes.json", sized() | {"videos": [{"width": 81}]}, r"videos\[0\] has 81x60 px"),
        (".boxes.json", {"images": [{"id": 1, "frame_id": 1}], "annotations": []}, "frames 1 to 1: .* frames 0 to 9"),
        (
            ".boxes.json",
            {"images": [{"id": 1, "frame_id": 10}], "annotations": []},
            "frames 10 to 10: .* frames 0 to 9",
        ),
        (
            ".boxes.json",
            {"images": [{"id": 1, "frame_id": 0}] * 2, "annotations": []},
            "id 1 or frame 0 is there twice",
        ),
        (
            ".boxes.json",
            {"images": [{"id": 1, "frame_id": 0}, {"id": 2, "frame_id": 0}], "annotations": []},
            r"images\[1\]: id 2 or frame 0 is there twice",
        ),
        (
            ".boxes.json",
            sized() | {"annotations": sized()["annotations"] * 2},
            r"annotations\[1\]: id 1 is there twice",
        ),
        (
            ".boxes.json",
            sized() | {"annotations": [{"image_id": 1, "bbox": [0.1, 0.2, 0.3, 0.4], "category_id": 1}]},
            "first pixel: give px, not shares",
        ),
        (
            ".boxes.json",
            sized() | {"annotations": [{"image_id": 1, "bbox": [400, 200, 30, 40], "category_id": 1}]},
            "1 of 1 boxes lie outside the picture of 80x60 px",
        ),
        (".boxes.txt", mot(11, ",1,2,1"), "frames 11 to 11: the video has frames 1 to 10"),
        (".boxes.txt", "1,7,0.1,0.2,0.1,0.1\n", "give px, not shares"),
        (".boxes.txt", mot(1) * 2, r"frame 0 \(from 0\) has track 7 of class 0 twice"),
        (".boxes.txt", mot(1, ",3"), r"line 1 ends with \[3\.0\], columns neither of MOT nor"),
        (".boxes.txt", mot(1, ",1,2,3"), r"ends with \[1\.0, 2\.0, 3\.0\]"),
        (".boxes.txt", mot(1, ",1,0.5,2.5,0.1"), r"ends with \[1\.0, 0\.5, 2\.5, 0\.1\]"),
        (".boxes.txt", mot(1, ",1,-1"), "line 1: class -1: give a whole number"),
        (".boxes/", {"1": "2 0.5 0.5 0.1 0.1"}, "frames 1 to 1: .* frames 0 to 9, so number them from 0"),
        (".boxes/", {"0": "", "10": ""}, "frames 0 to 10: .* frames 0 to 9"),
        (".boxes/", {"0": "2 41 40 60 40"}, r"0\.txt line 1: box \[41\.0, .*: give shares of the picture"),
        (".boxes/", {"0": "2 50.5 33.1 18.75 16.7"}, "give shares of the picture"),
        (".boxes/", {"classes": "person"}, r"has no file named by the number of a frame, like 000012\.txt"),
        (".boxes/", {"0": "2 0.5 0.5 0.1 0.1 3\n" * 2}, "has track 3 of class 2 twice"),
        (".boxes.json", "{", "line 1"),
        (".boxes.json", "[]", "is not a JSON object"),
        (".boxes.json", {"images": []}, "has no list 'annotations'"),
        (".boxes.json", GOOD | {"videos": [{}, {}]}, "describes 2 videos: write one file for each"),
        (".boxes.json", {"images": [{"id": 1}], "annotations": []}, r"images\[0\].frame_id is None"),
        (".boxes.json", GOOD | {"annotations": [{"image_id": 2}]}, r"annotations\[0\]: images has no id 2"),
        (".boxes.json", GOOD | {"annotations": [3]}, r"annotations\[0\] is 3"),
        (
            ".boxes.json",
            GOOD | {"annotations": [{"image_id": 1, "bbox": [1, 2, 3], "category_id": 1}]},
            r"annotations\[0\].bbox is \[1, 2, 3\]: it must be \[left, top, width, height\]",
        ),
        (
            ".boxes.json",
            GOOD | {"annotations": [{"image_id": 1, "bbox": [1, 2, -3, 4], "category_id": 1}]},
            r"annotations\[0\]: box .* width and height are at least 0",
        ),
        (".boxes.txt", "1,1,2,3\n", "line 1 has 4 values: give frame, track"),
        (".boxes.txt", "1,1,2,3,4,5\n\n2,1,2,x,4,5\n", "line 3: could not convert"),
        (".boxes.txt", "0,1,2,3,4,5\n", "line 1: frame 0: MOT counts frames from 1"),
        (".boxes.txt", "1.5,1,2,3,4,5\n", "line 1: 1.5 is not a whole number"),
        (".boxes.txt", "1,1,nan,3,4,5\n", "line 1: box .*: coordinates are at most"),
        (".boxes.txt", "1,99999999,2,3,4,5\n", "line 1: track 99999999: give"),
    ],
)
def test_labels_that_do_not_fit_are_refused_in_words(
    tmp_path: Path, ending: str, content: str | Mapping[str, Any], message: str
) -> None:
    path = tmp_path / f"a{ending}"
    if isinstance(content, str):
        path.write_text(content)
    elif ending.endswith("/"):
        path.mkdir()
        for name, text in content.items():
            (path / f"{name}.txt").write_text(text)
    else:
        path.write_text(json.dumps(content))
    with pytest.raises(ValueError, match=message):
        check(ending, path)


WRITERS = {".boxes.json": write_coco, ".boxes.txt": write_mot, ".boxes/": write_yolo}
HAS = {".boxes.json": "COCO has left, top, width, height", ".boxes.txt": "MOT has left, top, width, height",
       ".boxes/": "YOLO has centre x, centre y, width, height"}  # fmt: skip


def as_corners(ending: str, boxes: Boxes) -> Boxes:
    """Return boxes that a writer writes as corners."""
    shift = 0.5 if ending == ".boxes/" else 0  # the writer adds half of what it takes for a side
    return [
        (frame, left - shift * (left + width), top - shift * (top + height), left + width, top + height, *rest)
        for frame, left, top, width, height, *rest in boxes
    ]  # type: ignore[misc]


@pytest.mark.parametrize("ending", WRITERS)
@pytest.mark.parametrize(
    ("true", "wrong", "refused"),
    [
        (0, 10, "10 of 10 boxes"),
        (5, 5, "5 of 10 boxes"),
        (6, 4, ""),
    ],
)
def test_corners_are_refused_and_named(tmp_path: Path, ending: str, true: int, wrong: int, refused: str) -> None:
    """Boxes at the lower right, some of them written as corners."""
    boxes: Boxes = [(frame, 60, 45, 10 + frame, 12, 2, 3) for frame in range(10)]
    path = tmp_path / f"a{ending.rstrip('/')}"
    WRITERS[ending](path, as_corners(ending, boxes[:wrong]) + boxes[wrong:])
    if refused:
        given = {".boxes.json": "60.0, 45.0, 70.0, 57.0", ".boxes.txt": "61.0, 46.0, 70.0, 57.0"}
        place = given.get(ending, "0.75, 0.75, 0.875, 0.95")
        message = rf"{refused} leave the picture of 80x60 px, such as \[{place}\] of frame 0 .*corners.*{HAS[ending]}"
        with pytest.raises(ValueError, match=message):
            check(ending, path)
    else:
        assert check(ending, path) == ""


@pytest.mark.parametrize("ending", WRITERS)
@settings(max_examples=40)
@given(data=st.data())
def test_boxes_that_are_meant_so_are_taken(
    tmp_path_factory: pytest.TempPathFactory, ending: str, data: st.DataObject
) -> None:
    """Boxes in the picture up to its border, and any that leave it and are no corners: their width is below x."""
    inside = data.draw(st.lists(st.tuples(st.integers(0, 79), st.integers(0, 59)), max_size=4))
    leaving = data.draw(st.lists(st.tuples(st.integers(42, 78), st.integers(0, 50), st.integers(40, 41)), max_size=4))
    boxes: Boxes = [(frame, x, y, 80 - x, 60 - y, 1, 1) for frame, (x, y) in enumerate(inside)]
    boxes += [(4 + frame, x, y, width, 20, 1, 1) for frame, (x, y, width) in enumerate(leaving)]
    path = tmp_path_factory.mktemp("labels") / f"a{ending.rstrip('/')}"
    WRITERS[ending](path, [(8, 30, 20, 10, 10, 1, 1), *boxes])
    if ending == ".boxes/":  # centres may be corners even so
        table = read(ending, path)
        numbers = np.hstack([table.corners.reshape(-1, 2, 2).mean(1), table.corners[:, 2:] - table.corners[:, :2]])
        leaves = (table.corners < -1).any(1) | (table.corners > [81, 61, 81, 61]).any(1)
        assume(not (numbers[leaves, :2] < numbers[leaves, 2:]).all(1).all() or not leaves.any())
    assert check(ending, path) == ""


@pytest.mark.parametrize(
    ("text", "category"),
    [
        (mot(1, ",1,4,0,1"), 4),  # VisDrone
        (mot(1, ",0.9,-1,-1,-1"), 0),  # detections, trackers, MOT15
        (mot(1, ",1,5,0.25"), 5),
        (mot(1, ",1,5"), 5),
        (mot(1, ",0.93"), 0),
        (mot(1), 0),
    ],
)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_a_class_is_read_where_the_dialect_has_it(tmp_path: Path, text: str, category: int, encoding: str) -> None:
    path = tmp_path / "a.boxes.txt"
    path.write_text(text, encoding=encoding)
    assert check(".boxes.txt", path) == ""
    assert read(".boxes.txt", path).at(0)[1].tolist() == [[category, 7]]


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_coco_as_cvat_writes_it(tmp_path: Path, encoding: str) -> None:
    path, labels = tmp_path / "a.boxes.json", sized(width=80, height=60)
    labels["images"] = [{"id": 1, "file_name": "frame_000003.PNG", "width": 80, "height": 60}]
    labels["annotations"][0]["attributes"] = {"occluded": False, "track_id": 9}
    path.write_text(json.dumps(labels), encoding=encoding)
    assert check(".boxes.json", path) == ""
    assert read(".boxes.json", path).at(3)[1].tolist() == [[2, 9]]


def test_what_tools_write_beside_the_frames_is_not_read_and_said(tmp_path: Path) -> None:
    for name in ("clip_00_jpg.rf.0a1b2c3d4e5f60718293a4b5c6d7e8f9.txt", "clip_01_png.rf.ab12.txt"):
        (tmp_path / name).write_bytes(b"\xef\xbb\xbf2 0.5 0.5 0.1 0.1\n")
    assert check(".boxes/", tmp_path) == ""
    for name in ("classes.txt", "notes.json", "README.roboflow.txt", ".hidden"):
        (tmp_path / name).write_text("person\n")
    assert check(".boxes/", tmp_path) == "3 of its files are not read, such as README.roboflow.txt"
    assert read(".boxes/", tmp_path).at(1)[1].tolist() == [[2, -1]]


def test_a_mask_of_another_size_is_refused(tmp_path: Path) -> None:
    Image.new("L", (80, 60)).save(tmp_path / "0.png")
    assert check(".masks/", tmp_path) == ""
    Image.new("L", (60, 80)).save(tmp_path / "0.png")
    with pytest.raises(ValueError, match=r"0\.png has 60x80 px: the video has 80x60 px"):
        check(".masks/", tmp_path)


def test_a_file_beyond_the_limit_is_not_parsed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(formats, "_LARGEST_BYTES", 100)
    (tmp_path / "a.boxes.txt").write_text(mot(1) * 9)
    with pytest.raises(ValueError, match="has more than 100 bytes, the limit of a file of boxes"):
        check(".boxes.txt", tmp_path / "a.boxes.txt")


@given(st.integers(0, 10**12 - 1), st.sampled_from(["", "clip_", "a-b.c_"]), st.integers(0, 12))
def test_the_number_at_the_end_of_a_name_is_the_frame(number: int, before: str, width: int) -> None:
    assert frame_of(f"{before}{number:0{width}}.png") == number
    assert frame_of(f"{before}{number:0{width}}_jpg.rf.123456.txt") == number
    assert frame_of("classes.txt") is None


def test_files_are_numbered_by_the_end_of_their_names(tmp_path: Path) -> None:
    for name in ("a2_07.txt", ".hidden.txt", "notes.md", "11.TXT"):
        (tmp_path / name).write_text("5 0.5 0.5 2 2\n")
    assert {number: file.name for number, file in numbered_files(tmp_path, ".txt").items()} == {
        7: "a2_07.txt", 11: "11.TXT",
    }  # fmt: skip
    assert read(".boxes/", tmp_path).at(7)[1].tolist() == [[5, -1]]
    (tmp_path / "7.txt").write_text("5 0.5\n")
    with pytest.raises(ValueError, match=r"7\.txt and a2_07\.txt are both of frame 7: keep one"):
        read(".boxes/", tmp_path)
    (tmp_path / "a2_07.txt").unlink()
    with pytest.raises(ValueError, match=r"7\.txt line 1 has 2 values: give class, centre x"):
        read(".boxes/", tmp_path)
    (tmp_path / "frame.txt").write_text("person\n")
    with pytest.raises(ValueError, match=r"frame\.txt: give it a name that ends with the number"):
        read(".boxes/", tmp_path)


# --- labels of a view -------------------------------------------------------------------------------------------------


def test_the_share_counts_what_lies_in_the_crop() -> None:
    recipe = Recipe(crop_height_px=10, crop_width_px=10)
    params = SampleParams(0.2, 0.2, 0.0, 0, 0.0, (), 1.0, 20, 30, True, 0.0, (0, 0, 0, 0))
    boxes = np.array([[25.0, 20, 35, 30], [0, 0, 5, 5], [31, 21, 31, 25], [28, 18, 42, 32]])
    corners, share = view_boxes(boxes, Window(0, 0, 60, 80), params, recipe)
    assert corners[0].tolist() == [5.0, 0.0, 10.0, 10.0]
    np.testing.assert_allclose(share, [0.5, 0.0, 0.0, 100 / 196])
    assert kept_boxes(corners, share).tolist() == [3, 0], "the largest first; the empty ones are left out"
    thin = np.array([[0.0, 0, LEAST_SIDE_PX, 9], [0, 0, LEAST_SIDE_PX - 0.01, 9], [0, 0, 9, 9]])
    assert kept_boxes(thin, np.array([LEAST_SHARE, 1.0, LEAST_SHARE - 0.01])).tolist() == [0]


def png(path: Path, picture: Image.Image) -> Path:
    picture.save(path)
    return path


def test_classes_are_grey_levels_or_palette_indices(tmp_path: Path) -> None:
    classes = np.arange(12, dtype=np.uint8).reshape(3, 4)
    grey = Image.fromarray(classes)
    palette = Image.fromarray(classes, "P")
    palette.putpalette([number % 256 for number in range(768)])
    for name, picture in (("grey", grey), ("palette", palette)):
        np.testing.assert_array_equal(read_mask(png(tmp_path / f"{name}.png", picture), (3, 4)), classes)
    few = png(tmp_path / "few.png", Image.fromarray(classes % 2 == 1))
    np.testing.assert_array_equal(read_mask(few, (3, 4)), classes % 2)


NOISE = Image.fromarray(np.random.default_rng(0).integers(0, 9, (64, 64), np.uint8))


@pytest.mark.parametrize(
    "data",
    [
        encoded(NOISE, "png"),
        encoded(NOISE.point(lambda level: 255 * (level > 4)).convert("1"), "png"),
        *(encoded(NOISE.quantize(1 << bits), "png", bits=bits) for bits in (1, 2, 4, 8)),
        png_of_ffmpeg("gray", True, 64, 64),
    ],
)
def test_masks_without_all_rows_are_refused(tmp_path: Path, data: bytes) -> None:
    """Their classes would be 0."""
    path = tmp_path / "12.png"
    path.write_bytes(data)
    assert read_mask(path, (64, 64)).any()
    for share in (0.0, 0.4, 0.99):
        path.write_bytes(shortened(data, lambda length, kept=share: int(length * kept)))
        with pytest.raises(ValueError, match=r"^12\.png is truncated or damaged: it has \d+ of \d+ bytes of its rows"):
            read_mask(path, (64, 64))


def test_masks_that_lie_are_refused(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = 3
    NOISE.save(tmp_path / "12.png", exif=exif)
    with pytest.raises(ValueError, match=r"^12\.png has Exif orientation 3: write it upright"):
        read_mask(tmp_path / "12.png", (64, 64))


@pytest.mark.parametrize(
    ("picture", "kept", "message"),
    [
        (Image.new("RGB", (64, 64)), None, "is neither 8-bit grey nor a palette"),
        (Image.new("I;16", (64, 64)), None, "is neither 8-bit grey nor a palette"),
        (Image.new("L", (63, 64)), None, "has 63x64 px: the video has 64x64 px"),
        (NOISE, 4, "cannot identify"),
        (NOISE, -200, ".*truncated"),
    ],
)
def test_other_pictures_are_refused(tmp_path: Path, picture: Image.Image, kept: int | None, message: str) -> None:
    path = png(tmp_path / "12.png", picture)
    path.write_bytes(path.read_bytes()[:kept])
    with pytest.raises(ValueError, match=rf"^12\.png {message}"):
        read_mask(path, (64, 64))
