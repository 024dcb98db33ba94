"""FrameIndex: slices, times, and bytes that come from strangers."""

from __future__ import annotations

import dataclasses
import zlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from v2v_protocol.errors import ProtocolError, UsageError
from v2v_server.video.frame_index import NO_TIMESTAMP, FrameIndex, unseekable
from v2v_server.video.picture import Orientation

steps = st.lists(st.integers(1, 2**40), min_size=1, max_size=25)


@st.composite
def indices(draw: st.DrawFn) -> FrameIndex:
    pts = np.cumsum(np.array(draw(steps), np.int64)) - draw(st.integers(0, 2**41))
    first = draw(st.integers(0, 1000))
    keys = np.array(sorted(draw(st.sets(st.integers(first, first + len(pts) - 1)))), np.int64)
    dts = np.array([draw(st.sampled_from([NO_TIMESTAMP, -5, 0, 2**50])) for _ in keys], np.int64)
    base = (draw(st.integers(1, 2**32 - 1)), draw(st.integers(1, 2**32 - 1)))
    lies = Orientation(draw(st.booleans()), draw(st.booleans()), draw(st.booleans()))
    return FrameIndex(first, pts, keys, dts, base, 336, 596, True, lies)


def assert_equal(one: FrameIndex, other: FrameIndex) -> None:
    for name in ("first", "time_base", "height_px", "width_px", "seekable", "orientation", "bits"):
        assert getattr(one, name) == getattr(other, name)
    for name in ("pts", "keyframes", "keyframe_dts"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


@given(indices(), st.sampled_from((0, *range(8, 16))))
def test_bytes_round_trip(index: FrameIndex, bits: int) -> None:
    index = dataclasses.replace(index, bits=bits)
    assert_equal(FrameIndex.from_bytes(index.to_bytes()), index)
    assert FrameIndex.from_bytes(index.slice(index.first, 1).to_bytes()).bits == bits


def test_unseekable_round_trip() -> None:
    index = unseekable(10_000, (1, 25), 48, 64, bits=12)
    assert len(index.to_bytes()) < 64
    assert_equal(FrameIndex.from_bytes(index.to_bytes()), index)


def test_an_upright_index_keeps_its_bytes() -> None:
    upright = unseekable(5, (1, 25), 48, 64)
    turned = unseekable(5, (1, 25), 48, 64, Orientation(transpose=True, flip_x=True))
    assert (upright.to_bytes()[-1], turned.to_bytes()[-1]) == (0, 10)
    with pytest.raises(ProtocolError, match="flags 16"):
        FrameIndex.from_bytes(upright.to_bytes()[:-1] + b"\x10")


@given(indices(), st.data())
def test_a_part_of_the_frames(index: FrameIndex, data: st.DataObject) -> None:
    kept = np.array(data.draw(st.lists(st.booleans(), min_size=len(index), max_size=len(index))), bool)
    part = index.only(kept)
    np.testing.assert_array_equal(part.pts, index.pts[kept])
    keys = [at for at, key in enumerate(index.keyframes) if kept[key - index.first]]
    np.testing.assert_array_equal(part.pts[part.keyframes - part.first], index.pts[index.keyframes - index.first][keys])
    np.testing.assert_array_equal(part.keyframe_dts, index.keyframe_dts[keys])


def test_a_constant_rate_costs_next_to_nothing() -> None:
    index = FrameIndex(0, np.arange(200) * 1001, np.array([0]), np.array([-2002]), (1, 30000), 336, 596, seekable=True)
    assert len(index.to_bytes()) < 100


@given(indices(), st.data())
def test_slice_keeps_the_range_and_its_keyframe(index: FrameIndex, data: st.DataObject) -> None:
    start = data.draw(st.integers(index.first, index.end - 1))
    count = data.draw(st.integers(1, index.end - start))
    part = index.slice(start, count)
    before = [key for key in index.keyframes if key <= start]
    assert part.first == (before[-1] if before else index.first)
    assert part.end == start + count
    np.testing.assert_array_equal(part.seconds(start, count), index.seconds(start, count))
    np.testing.assert_array_equal(part.keyframes, [key for key in index.keyframes if part.first <= key < start + count])
    assert_equal(part.slice(start, count), part)


@given(indices())
def test_seconds(index: FrameIndex) -> None:
    numerator, denominator = index.time_base
    wanted = [int(pts) * numerator / denominator for pts in index.pts]
    np.testing.assert_allclose(index.seconds(index.first, len(index)), wanted, rtol=1e-14)


@pytest.mark.parametrize(("start", "count"), [(0, 1), (3, 8), (3, 0), (10, 1)])
def test_ranges_outside(start: int, count: int) -> None:
    index = FrameIndex(3, np.arange(7), np.array([3]), np.array([0]), (1, 25), 48, 64, seekable=True)
    with pytest.raises(UsageError, match=r"holds 3 \.\. 9"):
        index.slice(start, count)


@given(st.binary(max_size=200))
def test_garbage_is_refused(data: bytes) -> None:
    with pytest.raises(ProtocolError):
        FrameIndex.from_bytes(data)


@given(indices(), st.data())
def test_tampered_bytes_are_refused_or_valid(index: FrameIndex, data: st.DataObject) -> None:
    encoded = bytearray(index.to_bytes())
    at = data.draw(st.integers(0, len(encoded) - 1))
    encoded[at] ^= data.draw(st.integers(1, 255))
    try:
        got = FrameIndex.from_bytes(bytes(encoded))
    except ProtocolError:
        return
    assert got.seekable is False or bool(np.all(np.diff(got.pts) > 0))


def test_a_compression_bomb_is_refused() -> None:
    head = FrameIndex(0, np.arange(7), np.array([0]), np.array([0]), (1, 25), 48, 64, seekable=True).to_bytes()[:33]
    with pytest.raises(ProtocolError, match="its header promises 72"):
        FrameIndex.from_bytes(head + zlib.compress(bytes(10_000_000)))


@pytest.mark.parametrize("parts", [(0, 25, 48, 64), (1, 0, 48, 64), (1, 25, 0, 64), (1, 25, 48, 0)])
def test_no_time_base_or_size_is_refused(parts: tuple[int, int, int, int]) -> None:
    with pytest.raises(ProtocolError, match=f"time base {parts[0]}/{parts[1]}, {parts[3]}x{parts[2]} px"):
        FrameIndex.from_bytes(unseekable(5, parts[:2], *parts[2:]).to_bytes())


def test_too_many_frames_are_refused() -> None:
    with pytest.raises(ProtocolError, match="limit 100"):
        FrameIndex.from_bytes(unseekable(101, (1, 25), 48, 64).to_bytes(), most_frames=100)


@pytest.mark.parametrize("second", [1, 2])
def test_disorder_is_refused(second: int) -> None:
    index = FrameIndex(0, np.array([0, 2, second]), np.array([0]), np.array([0]), (1, 25), 48, 64, seekable=True)
    with pytest.raises(ProtocolError, match="do not increase"):
        FrameIndex.from_bytes(index.to_bytes())
