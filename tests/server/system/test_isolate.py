"""Messages of isolated processes: values keep their types, and anything else is refused."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from v2v_protocol.errors import V2VError
from v2v_protocol.persisted import Int64, Persisted, reader
from v2v_server.corpus.scenes.scene import COLUMNS, PIECE, Scene, Sides
from v2v_server.system.isolate import _LIMITS, run_isolated


@dataclass(frozen=True)
class Answer(Persisted):
    """A result with a part of each type."""

    number: Int64
    share: float
    text: str | None
    pairs: tuple[tuple[int, bool], ...]
    sides: Sides
    scene: Scene | None
    source: Path


SCENE = Scene(0, 16, np.array([(16, 0, 0, 0, 0, 0)], PIECE), np.zeros((1, COLUMNS), np.uint16))


def echo(job: Answer) -> Answer:
    return job


def test_jobs_and_results_keep_their_types() -> None:
    job = Answer(-3, 0.25, "ä", ((1, True), (2**63 - 1, False)), Sides(1, 2, 3, 4), SCENE, Path("/a/b\udcff"))
    ((_, result),) = run_isolated(echo, [job], processes=1)
    assert isinstance(result, Answer)
    assert result.scene is not None
    assert result.scene.to_bytes() == SCENE.to_bytes()
    assert replace(result, scene=None) == replace(job, scene=None)


FIELDS = {
    "number": -3, "share": 0.25, "text": None, "pairs": ((1, True),), "sides": (1, 2, 3, 4), "scene": SCENE.to_bytes(),
    "source": b"/a",
}  # fmt: skip


@given(
    st.sampled_from(list(FIELDS)),
    st.none() | st.booleans() | st.integers() | st.text() | st.binary() | st.tuples(st.integers()),
)
def test_a_field_is_of_its_type_or_refused(name: str, value: object) -> None:
    try:
        answer = Answer.from_dict(FIELDS | {name: value})
    except V2VError:
        return
    assert type(answer.number) is int
    assert answer.number < 2**63
    assert type(answer.share) is float
    assert answer.text is None or type(answer.text) is str
    assert all(type(one) is int and type(two) is bool for one, two in answer.pairs)
    assert type(answer.sides) is Sides
    assert answer.scene is None or type(answer.scene) is Scene
    assert isinstance(answer.source, Path)


def half(number: int) -> float | None:
    return None if number % 2 else number // 2  # a whole number where a float is meant


def test_nothing_is_a_result_too_and_a_whole_number_a_float_where_one_is_meant() -> None:
    found = dict(run_isolated(half, range(4), 1, lambda job: 60.0))
    assert found == {0: 0.0, 1: None, 2: 1.0, 3: None}
    assert (type(found[0]), type(found[2])) == (float, float)


@pytest.mark.parametrize(
    "message",
    [
        b"\xdd\xff\xff\xff\xff",
        b"\x91" * 100_000 + b"\xc0",
        b"\xdd\x00\x02\x00\x01" + b"\x90" * 131_073,
        msgpack.packb({"number": 1}),
        msgpack.packb(msgpack.ExtType(5, b"x")),
        msgpack.packb(msgpack.Timestamp(5)),
        b"\xa1\xff",
        b"\xc1",
        *map(msgpack.packb, ("9", True, 9.0, None, [9], 2**63)),
    ],
)
def test_a_message_that_is_no_number_is_refused(message: bytes) -> None:
    unpacker = msgpack.Unpacker(**_LIMITS)
    unpacker.feed(message)
    with pytest.raises((V2VError, ValueError, msgpack.exceptions.UnpackException)) as refused:
        reader(Int64)(unpacker.unpack())
    assert not isinstance(refused.value, msgpack.OutOfData)
