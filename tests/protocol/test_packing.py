"""Compressed samples hold the same bytes, and nothing else passes for one."""

from __future__ import annotations

import numpy as np
import pytest
import zstandard
from hypothesis import given
from hypothesis import strategies as st

from v2v_client.conversation import unpack
from v2v_protocol.errors import ProtocolError
from v2v_protocol.keys import leaves_host
from v2v_protocol.messages import SampleHeader, decode, decode_sample, encode_sample


def pack(raw: object) -> bytes:
    return zstandard.ZstdCompressor(level=1).compress(raw)  # type: ignore[arg-type]


def message(array: np.ndarray, *, in_slot: bool = False) -> tuple[SampleHeader, list[bytes]]:
    header, *frames = encode_sample(
        epoch=0,
        index=0,
        arrays={"voxels": array},
        provenance={},
        worker="w",
        cpu_seconds=0.0,
        in_slot=in_slot,
        pack=pack,
    )
    said = decode(header)
    assert isinstance(said, SampleHeader)
    return said, [bytes(frame) for frame in frames]


@given(st.binary(min_size=1, max_size=2000))
def test_a_packed_array_comes_out_as_it_went_in(content: bytes) -> None:
    array = np.frombuffer(content, np.int8)
    header, frames = message(array)
    assert header.packed
    np.testing.assert_array_equal(decode_sample({"voxels": ("int8", array.shape)}, frames, unpack)["voxels"], array)


def test_what_lies_in_a_slot_is_not_packed() -> None:
    header, frames = message(np.zeros(8, np.int8), in_slot=True)
    assert not header.packed
    assert not frames


@pytest.mark.parametrize(
    "frame",
    [b"", b"no zstd at all", pack(bytes(9)), pack(bytes(8))[:-2], pack(bytes(1 << 30)), zstandard.ZstdCompressor(
        write_content_size=False).compress(bytes(8))],
    ids=["nothing", "another format", "one byte more", "cut short", "a bomb", "no size"],
)  # fmt: skip
def test_what_is_not_the_array_is_refused(frame: bytes) -> None:
    with pytest.raises(ProtocolError, match="compressed array"):
        unpack(frame, 8)


@pytest.mark.parametrize(
    ("address", "leaves"),
    [
        ("ipc:///tmp/s", False), ("tcp://127.0.0.1:1", False), ("tcp://localhost:1", False), ("tcp://[::1]:1", False),
        ("tcp://127.9.9.9:1", False), ("tcp://10.0.0.7:1", True), ("tcp://gpu-1:1", True), ("tcp://[fe80::1]:1", True),
    ],
)  # fmt: skip
def test_which_addresses_leave_the_host(address: str, leaves: bool) -> None:
    assert leaves_host(address) is leaves
