"""Test damaged, incomplete and wrong sources: each gives one clear message, and no file."""

from __future__ import annotations

import io
import json
import re
import struct
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest

from tests.trainer.convert import raw_forms
from tests.trainer.convert.aedat4_file import write_aedat4
from tests.trainer.convert.scene import scene
from trainer.convert import cli, convert
from v2v_protocol.errors import UsageError
from v2v_protocol.programs import install_line
from v2v_recordings import text_events
from v2v_recordings.faery_reader import _errors_of_faery
from v2v_recordings.items import ConvertOptions, EventChunk, SensorSize
from v2v_recordings.text_events import read_text_events


def ijrr(path: Path, **changes: bytes | None) -> Path:
    members = raw_forms.ijrr_members(scene())
    for name, content in changes.items():
        member = {"events": "slow/events.txt", "images": "slow/images.txt", "frame": "slow/images/frame_00000002.png"}[
            name
        ]
        if content is None:
            del members[member]
        else:
            members[member] = content
    raw_forms.write_zip(path / "slow.zip", members)
    return path / "slow.zip"


def evaid(path: Path, **changes: bytes) -> Path:
    members = raw_forms.evaid_members(scene())
    raw_forms.write_zip(path / "ball.zip", members | {f"{name}.txt": text for name, text in changes.items()})
    return path / "ball.zip"


def patched_zip(path: Path, *, flags: int = 0, method: int = 8) -> Path:
    """Write the same bytes with other flags or another method, in both headers of every member."""
    source = ijrr(path)
    content = bytearray(source.read_bytes())
    for signature, at in ((b"PK\3\4", 6), (b"PK\1\2", 8)):
        found = content.find(signature)
        while found >= 0:
            struct.pack_into("<HH", content, found + at, flags, method)
            found = content.find(signature, found + 1)
    return written(source, bytes(content))


def several(path: Path, members: dict[str, bytes]) -> Path:
    for name in ("one", "two"):
        raw_forms.write_folder(path / "all" / name, members)
    return path / "all"


def mvsec(path: Path, **datasets: np.ndarray | None) -> Path:
    raw_forms.write_mvsec(path / "fly_data.hdf5", scene())
    with h5py.File(path / "fly_data.hdf5", "a") as file:
        for name, values in datasets.items():
            del file[f"davis/left/{name}"]
            if values is not None:
                file[f"davis/left/{name}"] = values
    return path / "fly_data.hdf5"


def written(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


def cut_short(path: Path, share: float) -> Path:
    return written(path, path.read_bytes()[: int(path.stat().st_size * share)])


def short_bag(path: Path) -> Path:
    raw_forms.write_bag(path / "a.bag", scene())
    return cut_short(path / "a.bag", 0.7)


def bag_with(path: Path, **changes: bytes) -> Path:
    """Write a bag in which header fields of the first message begin with other values."""
    raw_forms.write_bag(path / "a.bag", scene())
    content = bytearray((path / "a.bag").read_bytes())
    for name, value in changes.items():
        at = content.index(b"%s=" % name.encode(), content.index(b"op=\2")) + len(name) + 1
        content[at : at + len(value)] = value
    return written(path / "a.bag", bytes(content))


def other_packets(path: Path) -> Path:
    raw_forms.write_bag(path / "a.bag", scene(), packets=True)
    return written(path / "a.bag", (path / "a.bag").read_bytes().replace(b"evt3", b"evt9"))


def short_aedat4(path: Path) -> Path:
    write_aedat4(path / "a.aedat4", scene())
    return cut_short(path / "a.aedat4", 0.03)


def evt2_without_size(path: Path) -> Path:
    raw_forms.write_evt2(path / "a.raw", scene(), geometry=False)
    return path / "a.raw"


def evt21(path: Path, header: bytes) -> Path:
    return written(
        path / "a.raw", header + b"\n% geometry 24x18\n% end\n" + struct.pack("<2Q", 0x8 << 60, 0x1 << 60 | 1)
    )


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda path: path / "absent.zip", "no file or folder"),
        (lambda path: written(path / "a.bin", b"nothing"), "is not a known recording.*--form"),
        (lambda path: written(path / "a.zip", b"nothing"), "neither a folder nor a complete zip"),
        (lambda path: cut_short(ijrr(path), 0.6), "neither a folder nor a complete zip"),
        (lambda path: patched_zip(path, method=9), "images.txt cannot be read: That compression method.*unpack"),
        (lambda path: patched_zip(path, flags=1), "images.txt cannot be read: .*encrypted.*unpack the file"),
        (lambda path: ijrr(path, events=b"0.1 1 2 1\n0.2 1 2\n"), r"line 2: '0.2 1 2' is not `t x y p`"),
        (lambda path: ijrr(path, events=b"0.1 1 2 1\n0.2 1 2 3\n"), r"events.txt: polarities are 1, 3; they must be"),
        (lambda path: ijrr(path, events=b"0.1 1 2 1\n0.2 1 x 0\n"), r"line 2: '0.2 1 x 0' is not"),
        (lambda path: ijrr(path, events=b"0.1 1 2 1\nnan 1 2 0\n"), r"line 2: 'nan 1 2 0' is not"),
        (lambda path: ijrr(path, events=b"a b\n0.2 1 2 1\n"), r"the first line is b'a b'"),
        (lambda path: ijrr(path, events=b""), "has no events"),
        (
            lambda path: ijrr(path, events=b"1468939993067416.0 1 2 1\n"),
            r"events.txt: a time is 1.468939993e\+15 s.*--time-unit",
        ),
        (lambda path: ijrr(path, events=b"1468939993067416019 1 2 1\n"), r"a time is 1.468939993e\+12 s"),
        (
            lambda path: ijrr(path, images=b"1e15 images/frame_00000000.png\n"),
            r"images.txt, line 1: a time is 1e\+15 s",
        ),
        (lambda path: ijrr(path, frame=None), r"line 3 names images/frame_00000002.png, which does not exist"),
        (lambda path: ijrr(path, frame=b"no picture"), r"frame_00000002.png is not a readable picture"),
        (lambda path: ijrr(path, images=b"one two three\n"), r"line 1: 'one two three' is not `seconds path`"),
        (lambda path: several(path, raw_forms.ijrr_members(scene())), r"holds 2 recordings \(one/slow, two/slow"),
        (lambda path: several(path, raw_forms.evaid_members(scene())), r"holds 2 recordings \(one, two"),
        (lambda path: evaid(path, timestamps=b"1 2 3"), r"5 pictures in gt/, but 3 times"),
        (lambda path: evaid(path, timestamps=b"1 2 x"), r"text that is not a number"),
        (lambda path: evaid(path, shape=b"24"), r"shape.txt holds \[24\]"),
        (lambda path: evaid(path, shape=b"20 18"), r"the sensor is SensorSize\(width=20"),
        (lambda path: mvsec(path, events=np.zeros((4, 3))), r"is \[4, 3\], not \[N, 4\]"),
        (lambda path: mvsec(path, image_raw_ts=np.zeros(2)), "5 pictures, but 2 times"),
        (lambda path: mvsec(path, image_raw_ts=np.full(5, np.nan)), "a time is nan s"),
        (lambda path: mvsec(path, image_raw=np.zeros((5, 18, 24))), "not uint8"),
        (lambda path: cut_short(mvsec(path), 0.6), "fly_data.hdf5 cannot be read as HDF5: .*truncated"),
        (lambda path: mvsec(path, image_raw_ts=None), "fly_data.hdf5 cannot be read as HDF5: .*image_raw_ts"),
        (short_bag, "the bag cannot be read"),
        (other_packets, r"a packet on /dvs/events is in encoding 'evt9'; supported is one of evt2, evt3"),
        (lambda path: bag_with(path, time=b"\1\1"), r"the bag is damaged and cannot be read: AssertionError\(\)"),
        (lambda path: bag_with(path, conn=b"\x77"), r"the bag is damaged and cannot be read: KeyError\(119\)"),
        (short_aedat4, "cannot be decoded"),
        (evt2_without_size, "give --size WIDTHxHEIGHT"),
        (lambda path: evt21(path, b"% evt 2.1"), "a.raw is in EVT 2.1, which is not supported"),
        (lambda path: evt21(path, b"% evt 2.1\n% format EVT21;height=18;width=24"), "is in EVT 2.1, which is not"),
    ],
)
def test_errors_name_the_fault(tmp_path: Path, make: object, message: str) -> None:
    source = make(tmp_path)  # type: ignore[operator]
    with pytest.raises(UsageError, match=message):
        convert(source, tmp_path / "out" / "a.h5")
    assert not list(tmp_path.glob("out/*"))


class PanicException(BaseException):
    """Stand in for Rust's panic, which Python code can recognise only by its name and base class."""


@pytest.mark.parametrize(
    ("raised", "expected"),
    [
        (PanicException("index out of bounds"), UsageError),
        (KeyboardInterrupt("index out of bounds"), KeyboardInterrupt),
    ],
)
def test_a_panic_of_the_decoder_is_reported_as_damage(raised: BaseException, expected: type[BaseException]) -> None:
    with pytest.raises(expected, match="index out of bounds"), _errors_of_faery(Path("a.aedat4")):
        raise raised


def test_a_bag_with_several_topics_needs_a_choice(tmp_path: Path) -> None:
    raw_forms.write_bag(tmp_path / "a.bag", scene())
    for options, message in (
        (ConvertOptions(events_topic="/none"), r"0 topics of events; .*/dvs/events \(dvs_msgs/msg/EventArray\)"),
        (ConvertOptions(images_topic="/none"), r"no pictures on /none; topics with pictures: /dvs/image_raw"),
    ):
        with pytest.raises(UsageError, match=message):
            convert(tmp_path / "a.bag", tmp_path / "a.h5", options=options)
    raw_forms.write_bag(tmp_path / "b.bag", scene(), image_encoding="16UC1")
    with pytest.raises(UsageError, match="a picture is '16UC1'"):
        convert(tmp_path / "b.bag", tmp_path / "b.h5")


def test_source_and_destination_must_differ(tmp_path: Path) -> None:
    folder = tmp_path / "slow"
    raw_forms.write_folder(folder, raw_forms.ijrr_members(scene()))
    with pytest.raises(UsageError, match="lies in the source folder"):
        convert(folder, folder / "a.h5")
    source = mvsec(tmp_path)
    with pytest.raises(UsageError, match="is the source itself"):
        convert(source, source, overwrite=True)
    convert(source, tmp_path / "a.h5")
    with pytest.raises(UsageError, match="--overwrite"):
        convert(source, tmp_path / "a.h5")
    convert(source, tmp_path / "a.h5", overwrite=True)


@pytest.mark.parametrize("block", [1, 7, 64, 1000])
def test_blocks_may_end_anywhere(monkeypatch: pytest.MonkeyPatch, block: int) -> None:
    monkeypatch.setattr(text_events, "BLOCK_BYTES", block)
    content = b"24 18\n" + b"".join(b"%d %d %d %d\n" % (t, t % 24, t % 18, t % 2) for t in range(100))
    items = list(read_text_events(io.BytesIO(content), "a.txt"))
    assert items[0] == SensorSize(24, 18)
    chunks = [item for item in items[1:] if isinstance(item, EventChunk)]
    assert np.concatenate([chunk.t_ns for chunk in chunks]).tolist() == [1000 * t for t in range(100)]
    broken = content.replace(b"\n77 5 5 1\n", b"\n77 5 5\n")
    with pytest.raises(UsageError, match=r"line 79: '77 5 5'"):
        list(read_text_events(io.BytesIO(broken), "a.txt"))


def test_a_guessed_size_is_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "own.txt").write_text("10 3 2 1\n20 7 4 0\n")
    for name, flags, size, guessed in (("a", [], "8 x 5", True), ("b", ["--size", "24x18"], "24 x 18", False)):
        cli.main([str(tmp_path / "own.txt"), "--out", str(tmp_path / f"{name}.h5"), *flags])
        printed = capsys.readouterr().out
        assert size in printed
        assert ("give --size" in printed) == guessed


@pytest.mark.parametrize("package", ["faery", "rosbags"])
def test_a_missing_package_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, package: str) -> None:
    source = tmp_path / ("a.aedat4" if package == "faery" else "a.bag")
    (write_aedat4 if package == "faery" else raw_forms.write_bag)(source, scene())
    for module in ("faery", "rosbags", "rosbags.rosbag1"):
        if module.startswith(package):
            monkeypatch.setitem(sys.modules, module, None)
    remedy = rf"needs the Python package {package}, .*: {re.escape(install_line('convert'))}$"
    with pytest.raises(UsageError, match=remedy):
        convert(source, tmp_path / "a.h5")


def test_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = mvsec(tmp_path)
    raw_forms.write_evt3(tmp_path / "own.raw", scene())
    cli.main(
        [str(source), str(tmp_path / "own.raw"), "--out", str(tmp_path / "h5"), "--json", str(tmp_path / "a.json")]
    )
    assert sorted(path.name for path in (tmp_path / "h5").iterdir()) == ["fly.h5", "own.h5"]
    printed = capsys.readouterr().out
    assert "28 events in 0.039 s, 5 images, 24 x 18 (mvsec)" in printed
    assert "no images" in printed
    records = json.loads((tmp_path / "a.json").read_text())
    assert [(record["form"], record["events"], record["width_px"]) for record in records] == [
        ("mvsec", 28, 24),
        ("prophesee", 28, 24),
    ]
    cli.main([str(source), "--out", str(tmp_path / "one.h5")])
    assert (tmp_path / "one.h5").is_file()


def test_the_folder_here_gives_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    raw_forms.write_folder(tmp_path / "slow", raw_forms.ijrr_members(scene()))
    monkeypatch.chdir(tmp_path / "slow")
    assert cli.main([".", "--out", str(tmp_path / "h5")]) == 0
    assert [path.name for path in (tmp_path / "h5").iterdir()] == ["slow.h5"]


@pytest.mark.parametrize("name", ["a.bag", "a.txt"])
def test_a_file_that_cannot_be_read_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    (tmp_path / name).touch()

    def denied(path: Path, *_: object) -> None:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(Path, "open", denied)
    assert cli.main([str(tmp_path / name), "--out", str(tmp_path / "a.h5")]) == 2
    assert capsys.readouterr().err.endswith(f"{name} cannot be read: Permission denied\n")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["absent", "--out", "x"], "no file or folder absent"),
        (["a", "b", "--out", "x.h5"], "--out x.h5 is one file, and there are 2"),
        (["a", "--out", "x", "--size", "24"], "give WIDTHxHEIGHT"),
        (
            ["a/rec.bag", "b/rec.aedat4", "--out", "x", "--overwrite"],
            "a/rec.bag and b/rec.aedat4 would both become x/rec.h5",
        ),
    ],
)
def test_command_line_refuses(arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(arguments) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


@pytest.mark.parametrize("separator", [" ", "\t", ",", ", "])
@pytest.mark.parametrize("end", ["\n", "\r\n"])
@pytest.mark.parametrize("mark", [b"", b"\xef\xbb\xbf"])
def test_text_of_other_programs_is_read(separator: str, end: str, mark: bytes) -> None:
    rows = [
        "#!events.txt",
        "# size",
        "9 8",
        "# t x y p",
        *(separator.join(row) for row in (("0.5", "1", "2", "0"), ("1.5", "3", "4", "1"))),
    ]
    size, *chunks = read_text_events(io.BytesIO(mark + end.join(rows).encode()), "v2e.txt")
    assert size == SensorSize(9, 8)
    events = [each for each in chunks if isinstance(each, EventChunk)]
    assert np.concatenate([each.t_ns for each in events]).tolist() == [500_000_000, 1_500_000_000]
    assert np.concatenate([each.x for each in events]).tolist() == [1, 3]
    assert np.concatenate([each.p for each in events]).tolist() == [False, True]


@pytest.mark.parametrize("bad", ["1,,3,1", "1,2,3,", "0,5 1 2 1"])
def test_a_bad_line_after_comments_keeps_its_number(bad: str) -> None:
    text = f"# one\n# two\n0.5,1,2,1\n{bad}\n"
    with pytest.raises(UsageError, match=r"v2e\.txt, line 4"):
        list(read_text_events(io.BytesIO(text.encode()), "v2e.txt"))
