"""Files of the store and their planes: what is written comes back, and what is damaged is refused."""

from __future__ import annotations

import contextlib
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from v2v_protocol.errors import ProtocolError, UsageError, VideoChanged, VideoError, VideoUnreadable
from v2v_server.store.format import (
    DENSE,
    FAST,
    GROUP_FRAMES,
    QUICK,
    RAW,
    Head,
    Packing,
    UnpackingError,
    group_frames_for,
    pack_record,
    unpack,
)
from v2v_server.store.planes import PLANES
from v2v_server.store.planes.plane import Plane, read_footer
from v2v_server.store.store_file import StoreFile, StoreWriter, is_store_file

PACKINGS = st.sampled_from([DENSE, FAST, QUICK, RAW])
in_folder = settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


def head_of(luma: npt.NDArray[np.uint8], packing: Packing = QUICK, **more: Any) -> Head:
    count, rows, width = luma.shape
    plain = Head("a.mp4", "f", rows, width, 0, rows, 0, count, count, 25.0, "h264", True, GROUP_FRAMES, packing.method)
    return replace(plain, **more)


def written(path: Path, luma: npt.NDArray[np.uint8], packing: Packing = QUICK, **more: Any) -> Path:
    with StoreWriter(path, head_of(luma, packing, **more), packing) as writer:
        for picture in luma:
            writer.add(picture)
        writer.close()
    assert path.stat().st_size == writer.bytes
    return path


@st.composite
def lumas(draw: st.DrawFn) -> npt.NDArray[np.uint8]:
    """Noise, a still scene, or black; of any size."""
    shape = draw(st.integers(1, 70)), draw(st.integers(1, 70)), draw(st.integers(1, 100))
    kind, random = draw(st.sampled_from(["noise", "still", "black"])), np.random.default_rng(draw(st.integers(0, 99)))
    if kind == "black":
        return np.zeros(shape, np.uint8)
    noise = random.integers(0, 256, shape, np.uint8)
    return noise if kind == "noise" else np.broadcast_to(noise[:1], shape).copy()


@in_folder
@given(lumas(), PACKINGS, st.integers(1, GROUP_FRAMES), st.data())
def test_any_crop_of_any_luma_comes_back(
    tmp_path: Path, luma: npt.NDArray[np.uint8], packing: Packing, group: int, data: st.DataObject
) -> None:
    count, rows, width = luma.shape
    first, top = data.draw(st.integers(0, 500)), data.draw(st.integers(0, 50))
    whole = {"height_px": top + rows + 3, "top": top, "first": first, "frames": first + count + 7, "group": group}
    path = written(tmp_path / "x", luma, packing, **whole)
    assert is_store_file(path)
    with StoreFile(path, "f") as stored:
        assert stored.head == head_of(luma, packing, **whole)
        for _ in range(3):
            t, y, x = (data.draw(st.integers(0, size - 1)) for size in luma.shape)
            stride = data.draw(st.integers(1, 5))
            last, height, wide = data.draw(st.integers(t, count - 1)), rows - y, width - x
            height, wide = data.draw(st.integers(1, height)), data.draw(st.integers(1, wide))
            wanted = luma[t : last + 1 : stride, y : y + height, x : x + wide]
            out = np.full(wanted.shape, 77, np.uint8)
            stored.read(first + t, stride, (top + y, x, height, wide), out)
            np.testing.assert_array_equal(out, wanted)


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, npt.NDArray[np.uint8]]:
    luma = np.random.default_rng(0).integers(0, 256, (40, 40, 70), np.uint8)
    luma[5:] //= 64  # noise that compresses, and such as does not
    return written(tmp_path_factory.mktemp("sound") / "x", luma), luma


def reads_right_or_refuses(path: Path, luma: npt.NDArray[np.uint8]) -> bool:
    """Whether it was read."""
    try:
        with StoreFile(path, "f") as stored:
            out = np.empty_like(luma)
            stored.read(0, 1, (0, 0, *luma.shape[1:]), out)
    except VideoError:
        return False
    np.testing.assert_array_equal(out, luma)
    return True


@settings(in_folder, max_examples=200)
@given(st.sampled_from(["a bit", "the end", "a stretch"]), st.data())
def test_any_damage_is_found(
    tmp_path: Path, sound: tuple[Path, npt.NDArray[np.uint8]], damaged: str, data: st.DataObject
) -> None:
    """A flipped bit, a lost end, or a stretch written over another one, as a file system may leave it."""
    path, luma = sound
    whole = path.read_bytes()
    content, last = bytearray(whole), len(whole) - 1
    if damaged == "a bit":
        content[data.draw(st.integers(0, 400) | st.integers(0, last))] ^= 1 << data.draw(st.integers(0, 7))
    elif damaged == "the end":
        del content[data.draw(st.integers(0, last)) :]
    else:
        size = data.draw(st.integers(1, 600))
        source, target = (data.draw(st.integers(0, len(whole) - size)) for _ in range(2))
        content[target : target + size] = content[source : source + size]
    (tmp_path / "x").write_bytes(content)
    assert reads_right_or_refuses(tmp_path / "x", luma) == (content == whole)


def test_a_file_that_shrinks_while_it_is_read(sound: tuple[Path, npt.NDArray[np.uint8]], tmp_path: Path) -> None:
    (tmp_path / "x").write_bytes(sound[0].read_bytes())
    with StoreFile(tmp_path / "x") as stored:
        os.truncate(tmp_path / "x", 3000)
        with pytest.raises(VideoError, match=r"frame (0|32): the store file is corrupt .* v2v-prepare"):
            stored.read(0, 1, (0, 0, 40, 70), np.empty((40, 40, 70), np.uint8))


def test_only_the_blocks_of_a_crop_are_read(tmp_path: Path) -> None:
    """All others may be damaged."""
    luma = np.random.default_rng(1).integers(0, 256, (64, 96, 96), np.uint8)
    path = written(tmp_path / "x", luma)
    with StoreFile(path) as stored:
        record = stored._record(1)
    content = bytearray(path.read_bytes())
    begin, end = record.starts[4], record.starts[5]  # of the middle block of nine
    kept = content[begin:end]
    table_end = len(head_of(luma).to_bytes()) + 2 * head_of(luma).record_bytes
    content[table_end:] = bytes(len(content) - table_end)
    content[begin:end] = kept
    path.write_bytes(content)
    out = np.empty((32, 32, 32), np.uint8)
    with StoreFile(path) as stored:
        stored.read(32, 1, (32, 32, 32, 32), out)
        np.testing.assert_array_equal(out, luma[32:, 32:64, 32:64])
        with pytest.raises(VideoError, match=r"frame 32: the store file is corrupt \(block 3 is damaged"):
            stored.read(32, 1, (32, 31, 32, 32), out)
        with pytest.raises(VideoError, match=r"frame 0: the store file is corrupt \(block 4 is damaged"):
            stored.read(31, 1, (32, 32, 32, 32), out)


def test_what_is_not_kept_is_refused(sound: tuple[Path, npt.NDArray[np.uint8]]) -> None:
    with StoreFile(sound[0]) as stored:
        for start, stride, window, shape in (
            (39, 1, (0, 0, 4, 4), (2, 4, 4)), (0, 40, (0, 0, 4, 4), (2, 4, 4)), (0, 0, (0, 0, 4, 4), (2, 4, 4)),
            (-1, 1, (0, 0, 4, 4), (2, 4, 4)), (0, 1, (37, 0, 4, 4), (2, 4, 4)), (0, 1, (0, 67, 4, 4), (2, 4, 4)),
            (0, 1, (0, 0, 4, 4), (2, 4, 5)), (0, 1, (0, 0, 4, 4), (0, 4, 4)), (0, 1, (0, -1, 4, 4), (2, 4, 4)),
        ):  # fmt: skip
            with pytest.raises(UsageError, match="not in this file"):
                stored.read(start, stride, window, np.empty(shape, np.uint8))


def test_a_file_of_another_source_is_refused(sound: tuple[Path, npt.NDArray[np.uint8]], tmp_path: Path) -> None:
    with pytest.raises(VideoChanged, match="was made from another file: f instead of g"):
        StoreFile(sound[0], "g")
    with pytest.raises(VideoUnreadable, match="No such file"):
        StoreFile(tmp_path / "none", "f")
    (tmp_path / "video").write_bytes(b"\0\0\0\x1cftypisom" * 5)
    assert not is_store_file(tmp_path / "video")
    assert not is_store_file(tmp_path / "none")
    with pytest.raises(VideoError, match="not a store file"):
        StoreFile(tmp_path / "video")


def test_an_unclosed_file_is_not_a_store_file(tmp_path: Path) -> None:
    luma = np.zeros((64, 8, 8), np.uint8)
    with StoreWriter(tmp_path / "x", head_of(luma), QUICK) as writer:
        for picture in luma[:40]:
            writer.add(picture)
        with pytest.raises(UsageError, match="40 of 64 frames were written"):
            writer.close()
    assert not is_store_file(tmp_path / "x")
    with StoreWriter(tmp_path / "x", head_of(luma), QUICK) as writer:
        with pytest.raises(UsageError, match="frame 0 of 64"):
            writer.add(np.zeros((8, 9), np.uint8))
        for picture in luma:
            writer.add(picture)
        with pytest.raises(UsageError, match="frame 64 of 64"):
            writer.add(luma[0])


def test_large_pictures_come_in_small_groups() -> None:
    assert group_frames_for(181, 596) == GROUP_FRAMES
    assert group_frames_for(4320, 8192) == 1
    assert 1 < group_frames_for(2160, 3840) < 16


@pytest.mark.parametrize(
    "wrong", [{"count": 0}, {"rows": 9}, {"first": 1}, {"group": 0}, {"group": 33}, {"packing": "gzip"}, {"video": 3}]
)
def test_heads_that_cannot_be_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ProtocolError):
        Head.from_dict(head_of(np.zeros((4, 8, 8), np.uint8)).to_dict() | wrong)


@pytest.mark.parametrize("method", ["zstd", "lz4", "raw"])
def test_a_block_is_unpacked_into_the_bytes_that_it_should_have_and_no_more(method: str) -> None:
    packing = {"zstd": DENSE, "lz4": FAST, "raw": RAW}[method]
    packed = packing.packer()(bytes(1000))
    assert unpack(method, packed, 1000) == bytes(1000)
    for size in (10, 999, 1001):
        with pytest.raises(UnpackingError):
            unpack(method, packed, size)
    with pytest.raises(UnpackingError):
        unpack(method, b"nonsense", 1000)


@pytest.mark.parametrize("sizes", [[(1 << 32) - 1] * 4])
def test_blocks_that_claim_gigabytes_are_refused_before_they_are_read(
    sound: tuple[Path, npt.NDArray[np.uint8]], tmp_path: Path, sizes: list[int]
) -> None:
    path = tmp_path / "x"
    content = bytearray(sound[0].read_bytes())
    with StoreFile(sound[0]) as stored:
        head, table = stored.head, stored._table
    blocks = head.down * head.across
    content[table : table + head.record_bytes] = pack_record(head, 0, 0, (sizes * blocks)[:blocks], [0] * blocks)
    path.write_bytes(content)
    with StoreFile(path) as stored, pytest.raises(VideoError, match=r"corrupt .*the limit is"):
        stored.read(head.first, 1, (head.top, 0, 1, 1), np.empty((1, 1, 1), np.uint8))


def test_a_frame_that_claims_gigabytes_is_not_unpacked() -> None:
    claiming = b"\x28\xb5\x2f\xfd\xa0" + (4_000_000_000).to_bytes(4, "little") + b"\x01\x00\x00"
    with pytest.raises(UnpackingError, match="claims 4000000000 bytes instead of 32"):
        unpack("zstd", claiming, 32)


# --- planes -----------------------------------------------------------------------------------------------------------

KINDS = {
    "motion": PLANES["motion"],
    "chroma": Plane(version=1, dtype="|u1", values=2, cell_px=2),
    "luma10": Plane(version=1, dtype="<u2", values=1, cell_px=1),
    "odd": Plane(version=1, dtype="<i4", values=3, cell_px=5),
}


@pytest.fixture(autouse=True)
def kinds(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("v2v_server.store.store_file.PLANES", KINDS)


def arrays_of(kind: Plane, count: int, rows: int, width: int, seed: int) -> npt.NDArray[Any]:
    """Return values of which most are zero."""
    generator = np.random.default_rng(seed)
    shape = (count, *kind.shape(rows, width))
    values = np.frombuffer(generator.bytes(int(np.prod(shape)) * np.dtype(kind.dtype).itemsize), kind.dtype)
    return values.reshape(shape) * (generator.random(shape[-2:]) < 0.3) * (generator.random((count, 1, 1, 1)) < 0.5)


def written_with(
    path: Path, luma: npt.NDArray[np.uint8], arrays: dict[str, npt.NDArray[Any]], packing: Packing = QUICK, **more: Any
) -> Path:
    with StoreWriter(path, head_of(luma, packing, **more), packing, arrays) as writer:
        for number, picture in enumerate(luma):
            writer.add(picture, {name: array[number] for name, array in arrays.items()})
        writer.close()
    return path


@settings(in_folder, max_examples=12)
@given(st.data(), PACKINGS, st.sets(st.sampled_from(sorted(KINDS)), min_size=1))
def test_any_part_of_any_plane_comes_back_beside_the_same_luma(
    tmp_path: Path, data: st.DataObject, packing: Packing, names: set[str]
) -> None:
    count, rows, width = (data.draw(st.integers(1, most)) for most in (40, 70, 100))
    luma = np.random.default_rng(0).integers(0, 256, (count, rows, width), np.uint8)
    arrays = {name: arrays_of(KINDS[name], count, rows, width, data.draw(st.integers(0, 99))) for name in names}
    path, plain = written_with(tmp_path / "x", luma, arrays, packing), written(tmp_path / "y", luma, packing)
    assert path.read_bytes().startswith(plain.read_bytes())
    with StoreFile(path, "f") as stored, StoreFile(plain) as without:
        assert stored.planes == names
        assert without.planes == frozenset()
        for name, array in arrays.items():
            start, top, left = (data.draw(st.integers(0, array.shape[axis] - 1)) for axis in (0, 2, 3))
            end, bottom, right = (
                data.draw(st.integers(low + 1, array.shape[axis])) for axis, low in ((0, start), (2, top), (3, left))
            )
            found = stored.plane(name, start, end - start, (top, left, bottom - top, right - left))
            np.testing.assert_array_equal(found, array[start:end, :, top:bottom, left:right])
            assert found.dtype == array.dtype


@pytest.fixture
def moving(tmp_path: Path) -> tuple[Path, npt.NDArray[Any]]:
    luma = np.zeros((40, 40, 70), np.uint8)
    motion = arrays_of(KINDS["motion"], *luma.shape, seed=3)
    return written_with(tmp_path / "x", luma, {"motion": motion}), motion


def test_a_plane_of_another_version_is_missing(
    moving: tuple[Path, npt.NDArray[Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(KINDS, "motion", Plane(version=2, dtype="<i2", values=2, cell_px=4))
    with StoreFile(moving[0]) as stored:
        assert stored.planes == frozenset()
    monkeypatch.delitem(KINDS, "motion")
    with StoreFile(moving[0]) as stored:
        assert stored.planes == frozenset()


@settings(in_folder, max_examples=60)
@given(st.data())
def test_a_damaged_plane_is_found_and_harms_no_luma(moving: tuple[Path, npt.NDArray[Any]], data: st.DataObject) -> None:
    path, motion = moving
    content = bytearray(path.read_bytes())
    with StoreFile(path) as stored:
        place = read_footer(str(path), stored._file)["motion"]
    at = data.draw(st.integers(place.offset, len(content) - 1))
    content[at] ^= 1 << data.draw(st.integers(0, 7))
    other = path.with_name("y")
    other.write_bytes(content)
    with StoreFile(other, "f") as stored:
        luma = np.empty((40, 40, 70), np.uint8)
        stored.read(0, 1, (0, 0, 40, 70), luma)
        assert not luma.any()
        with contextlib.suppress(VideoError):
            assert not stored.planes or not stored.plane("motion", 0, 40, (0, 0, *motion.shape[2:])).size


def test_what_does_not_fit_is_refused(tmp_path: Path, moving: tuple[Path, npt.NDArray[Any]]) -> None:
    luma = np.zeros((1, 8, 8), np.uint8)
    missing = pytest.raises(UsageError, match=r"planes \[\]: give \['motion'\]")
    with StoreWriter(tmp_path / "z", head_of(luma), QUICK, ["motion"]) as writer, missing:
        writer.add(luma[0])
    for wrong in (np.zeros((1, 2, 2), "<i2"), np.zeros((2, 2, 2), "<i4")):
        with pytest.raises(UsageError, match="give 2 values of <i2"):
            KINDS["motion"].to_picture(wrong)
    with StoreFile(moving[0]) as stored, pytest.raises(UsageError, match="are not in this file"):
        stored.plane("motion", 0, 41, (0, 0, 2, 2))
