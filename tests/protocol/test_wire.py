"""The wire: what we say comes back equal; what anybody else says is a message or a ProtocolError, never more."""

from __future__ import annotations

import itertools
import math
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.protocol.persisted_values import MESSAGES, example, messages
from v2v_protocol import PROTOCOL_VERSION
from v2v_protocol.errors import LimitExceeded, ProtocolError, VersionMismatch
from v2v_protocol.messages import (
    ARRAY_DTYPES,
    LARGEST_HEADER_BYTES,
    MOST_CONTAINERS,
    Denied,
    Hello,
    Ping,
    SampleHeader,
    Want,
    decode,
    decode_map,
    decode_sample,
    encode,
    encode_map,
    encode_sample,
)
from v2v_protocol.persisted import LARGEST_LIST
from v2v_protocol.sample import Form

V = b"\x82\xa1v" + bytes([PROTOCOL_VERSION])
"""A message of two fields begins, with its version."""


def plain(message: Any) -> dict[str, Any]:
    fields: dict[str, Any] = msgpack.unpackb(bytes(encode(message)[0]))
    return fields


def refuse(fields: Any, error: type[ProtocolError] = ProtocolError, match: str | None = None) -> None:
    with pytest.raises(error, match=match):
        decode(msgpack.packb(fields))


def message_or_refusal(data: bytes) -> None:
    try:
        message = decode(data)
    except ProtocolError as error:
        assert len(str(error)) < 5000  # noqa: PT017 - the length of what was quoted is the point
    else:
        assert type(message) in MESSAGES


# --- round trips ------------------------------------------------------------------------------------------------------


@given(messages)
@settings(max_examples=60)
def test_any_message_travels_unchanged(message: Any) -> None:
    header = bytes(encode(message)[0])
    for buffer in (header, bytearray(header), memoryview(header)):
        again = decode(buffer)
        assert again == message
        assert type(again) is type(message)


def test_whole_numbers_are_read_as_floats_where_floats_belong() -> None:
    again = decode(msgpack.packb(plain(example(SampleHeader)) | {"cpu_seconds": 3}))
    assert isinstance(again, SampleHeader)
    assert type(again.cpu_seconds) is float


# --- whatever arrives -------------------------------------------------------------------------------------------------


@given(st.binary(max_size=200))
@settings(max_examples=150)
def test_arbitrary_bytes(data: bytes) -> None:
    message_or_refusal(data)


_keys = st.sampled_from(["v", "t", "spec", "lease", "index"]) | st.text(max_size=3) | st.binary(max_size=3)
_values = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text() | st.binary(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(_keys, inner, max_size=3),
    max_leaves=8,
)


@pytest.mark.parametrize("depth", [1, 15, 16, 17, 200, 990, 1020, 1024, 200_000])
def test_nesting(depth: int) -> None:
    """Depths that the decoder takes, but that no repr() survives."""
    for before, opening in itertools.product(
        (V + b"\xa1t", b"\x82\xa1t\xa4ping\xa1v", b"\x83\xa1t\xa4ping" + V[1:] + b"\xa1x", b""),
        (b"\x91", b"\x81\xa1a", b"\x81\x91", b"\x92\x01"),
    ):
        message_or_refusal(before + opening * depth + b"\x90")


def test_a_field_nested_too_deeply_is_refused_before_anybody_looks_at_it() -> None:
    nested: Any = 1
    for _ in range(100):
        nested = {"recipe": nested}
    refuse(
        plain(example(Hello)) | {"spec": nested},
        LimitExceeded,
        "Hello.spec = a dict of 1: expected a map nested at most 16 deep",
    )


@given(st.dictionaries(st.text(max_size=5), _values, max_size=4))
def test_a_map_travels_unchanged(fields: dict[str, Any]) -> None:
    assert repr(decode_map(encode_map(fields))) == repr(fields)  # nan is not equal to itself


@given(st.binary(max_size=100))
def test_what_is_no_map_is_refused(data: bytes) -> None:
    try:
        assert type(decode_map(data)) is dict
    except ProtocolError as error:
        assert len(str(error)) < 200  # noqa: PT017


@pytest.mark.parametrize("opening", [b"\x91", b"\x81\xa1a"])
@pytest.mark.parametrize("depth", [17, 200, 990, 1024, 200_000])
def test_a_map_nested_too_deeply_is_refused(opening: bytes, depth: int) -> None:
    with pytest.raises(ProtocolError):
        decode_map(b"\x81\xa1a" + opening * depth + b"\x90")


# --- form -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "version", [0, 1, PROTOCOL_VERSION + 1, -1, 2**64 - 1, float(PROTOCOL_VERSION), True, "2", None, [2], {"v": 2}]
)
def test_other_versions_are_refused_with_both_numbers(version: Any) -> None:
    for cls in MESSAGES:
        refuse(plain(example(cls)) | {"v": version}, VersionMismatch, f"this side version {PROTOCOL_VERSION}")


@pytest.mark.parametrize("name", ["Ping", "", "sample-header", None, 1, ["ping"], {"t": "ping"}, b"ping"])
def test_other_types_are_refused(name: Any) -> None:
    refuse({"v": PROTOCOL_VERSION, "t": name}, match="unknown message type")


@pytest.mark.parametrize("fields", [None, 1, "ping", [], {}, {"v": 1}, {"t": "ping"}, {b"v": 1, b"t": "ping"}])
def test_what_is_no_map_with_version_and_type(fields: Any) -> None:
    refuse(fields, match="no version or type")


def test_nothing_may_follow_a_message() -> None:
    with pytest.raises(ProtocolError, match="ExtraData"):
        decode(bytes(encode(Ping())[0]) + b"\0")
    with pytest.raises(ProtocolError, match="not a message"):
        decode(b"")


def test_extension_types_and_bad_text_are_refused() -> None:
    for value in (msgpack.Timestamp(1, 2), msgpack.ExtType(5, b"x")):
        refuse({"v": PROTOCOL_VERSION, "t": "denied", "code": value, "text": ""}, match="code = a .*: expected str")
        refuse({"v": value, "t": "ping"}, VersionMismatch)
    with pytest.raises(ProtocolError, match="UnicodeDecodeError"):
        decode(V + b"\xa1t\xa2\xff\xfe")


# --- limits -----------------------------------------------------------------------------------------------------------


def test_an_oversize_header_is_refused_unread() -> None:
    with pytest.raises(LimitExceeded, match=f"{LARGEST_HEADER_BYTES + 1} bytes; the limit is {LARGEST_HEADER_BYTES}"):
        decode(bytes(LARGEST_HEADER_BYTES + 1))
    with pytest.raises(LimitExceeded, match=r"a denied header of .* the limit is"):
        encode(Denied("malformed", "x" * LARGEST_HEADER_BYTES))


def test_a_header_of_many_containers_is_refused_before_they_are_made() -> None:
    """A byte of an empty list becomes a hundred times that: a megabyte of them took half a second."""
    many = msgpack.packb({"v": PROTOCOL_VERSION, "t": "ping", "x": [[] for _ in range(MOST_CONTAINERS)]})
    with pytest.raises(LimitExceeded, match=f"more than {MOST_CONTAINERS} lists and maps"):
        decode(many)
    with pytest.raises(LimitExceeded):
        decode_map(msgpack.packb({"x": [{} for _ in range(MOST_CONTAINERS)]}))


def test_a_limit_for_a_header_is_its_readers() -> None:
    ping = bytes(encode(Ping())[0])
    assert decode(ping, len(ping)) == Ping()
    with pytest.raises(LimitExceeded, match=f"the limit is {len(ping) - 1}"):
        decode(ping, len(ping) - 1)


def test_the_largest_header_passes() -> None:
    room = LARGEST_HEADER_BYTES - len(encode(Denied("", "x" * 100_000))[0]) + 100_000
    message = Denied("", "x" * room)
    assert len(encode(message)[0]) == LARGEST_HEADER_BYTES
    assert decode(encode(message)[0]) == message


def test_lists_are_limited() -> None:
    assert decode(encode(Want(0, tuple(range(LARGEST_LIST))))[0]) == Want(0, tuple(range(LARGEST_LIST)))
    refuse(plain(Want(0, (0,) * (LARGEST_LIST + 1))), LimitExceeded, f"a list of at most {LARGEST_LIST}")


def test_a_list_that_only_claims_to_be_huge_is_refused() -> None:
    for claim in (b"\xdd\xff\xff\xff\xff", b"\xdf\xff\xff\xff\xff", b"\xc6\xff\xff\xff\xff", b"\xdb\xff\xff\xff\xff"):
        with pytest.raises(ProtocolError, match="not a message"):
            decode(b"\x84" + V[1:] + b"\xa1t\xa4want\xa5epoch\x00\xa7indices" + claim)


# --- samples ----------------------------------------------------------------------------------------------------------


_arrays = st.dictionaries(
    st.text(max_size=5),
    st.tuples(st.sampled_from(ARRAY_DTYPES), st.lists(st.integers(1, 4), min_size=1, max_size=8)),
    max_size=8,
)


@given(_arrays, st.integers(0, 2**32 - 1))
def test_arrays_travel_unchanged(layout: dict[str, tuple[str, list[int]]], seed: int) -> None:
    rng = np.random.default_rng(seed)
    arrays = {
        name: np.frombuffer(rng.bytes(math.prod(shape) * np.dtype(dtype).itemsize), dtype).reshape(shape)
        for name, (dtype, shape) in layout.items()
    }
    frames = encode_sample(
        epoch=3, index=2**48 - 1, arrays=arrays, provenance={"video": "a"}, worker="w", cpu_seconds=0.25
    )
    message = decode(frames[0])
    assert isinstance(message, SampleHeader)
    assert (message.epoch, message.index, message.worker, message.cpu_seconds) == (3, 2**48 - 1, "w", 0.25)
    assert decode_map(message.provenance) == {"video": "a"}
    stated = {name: (dtype, tuple(shape)) for name, (dtype, shape) in layout.items()}
    assert Form.of(stated) == Form(message.names, message.dtypes, message.shapes, tuple(map(len, frames[1:])))
    again = decode_sample(stated, [bytes(frame) for frame in frames[1:]])
    assert list(again) == list(arrays)
    for name, array in arrays.items():
        assert again[name].dtype == array.dtype
        assert again[name].shape == array.shape
        assert again[name].tobytes() == array.tobytes()


def test_nothing_is_copied_and_nothing_can_be_written() -> None:
    voxels = np.arange(24, dtype=np.int16).reshape(2, 3, 4)
    frames = encode_sample(epoch=0, index=0, arrays={"v": voxels}, provenance={}, worker="", cpu_seconds=0.0)
    assert np.shares_memory(np.frombuffer(frames[1], np.uint8), voxels)
    buffer = bytearray(frames[1])
    read = decode_sample({"v": ("int16", (2, 3, 4))}, [buffer])["v"]
    assert np.shares_memory(read, np.frombuffer(buffer, np.uint8))
    with pytest.raises(ValueError, match="read-only"):
        read[0] = 0


def test_only_listed_dtypes_and_contiguous_arrays_are_sent() -> None:
    good = np.zeros((4, 4), np.int16)
    for bad in (good.astype(np.float64), good.astype(bool), good[:, ::2], good.T[1:], good.astype(object)):
        with pytest.raises(LimitExceeded, match="array v has dtype"):
            encode_sample(epoch=0, index=0, arrays={"v": bad}, provenance={}, worker="", cpu_seconds=0.0)


@pytest.mark.parametrize("payload", [[], [b"abcdef"], [b"abcdef", b"ab", b""], [b"abcde", b"ab"], [b"abcdef", b"abc"]])
def test_frames_that_do_not_fit_the_layout_are_the_peers_fault(payload: list[bytes]) -> None:
    layout = {"a": ("int16", (3, 1)), "b": ("int8", (2,))}
    assert decode_sample(layout, [b"abcdef", b"ab"])["a"].shape == (3, 1)
    with pytest.raises(ProtocolError, match=r"^sample: "):
        decode_sample(layout, payload)
