"""Planes of store files: what is written comes back, and the luma does not notice."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.server.store.test_store_file import PACKINGS, head_of, in_folder, written
from v2v_protocol.errors import UsageError, VideoError
from v2v_server.store.format import QUICK, Packing
from v2v_server.store.planes import PLANES, Plane, read_footer
from v2v_server.store.store_file import StoreFile, StoreWriter

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
