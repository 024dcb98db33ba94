"""Which slots a connection names, and what it takes for a sample."""

from __future__ import annotations

import zmq

from tests.client.memory.test_arena import LAYOUT, sample
from v2v_client.memory.lending import Lending
from v2v_client.session.arrival import Payload
from v2v_protocol.arena import NO_SLOT, Slot
from v2v_protocol.messages import SampleHeader, Want

A, B = "arena a", "arena b"


def lending(*indices: int) -> Lending:
    """With a slot on offer for each."""
    opened = Lending()
    opened.offer({index: Slot(A, index + 1) for index in indices})
    return opened


def answer(index: int, slot: int = NO_SLOT) -> SampleHeader:
    shapes = tuple(number for _, shape in LAYOUT.values() for number in (len(shape), *shape))
    dtypes = tuple(dtype for dtype, _ in LAYOUT.values())
    return SampleHeader(0, index, tuple(LAYOUT), dtypes, shapes, {}, "worker", 0.1, slot=slot)


def frames() -> list[zmq.Frame]:
    return [zmq.Frame(array.tobytes()) for array in sample(5).values()]


def test_a_request_names_the_slots_that_were_offered() -> None:
    lent = lending(3, 1)
    lent.offer({2: Slot(B, 7), 9: Slot(B, 8)})
    assert lent.want(4, [3, 2, 1, 5]) == Want(4, (3, 2, 1, 5), (A, B, A, ""), (4, 7, 2, NO_SLOT))


def test_what_is_asked_again_is_asked_without_a_slot() -> None:
    """The first worker may be writing to the one that was named."""
    lent = lending(3, 1, 7)
    lent.want(0, [3, 1])
    assert lent.want(0, [1, 7]) == Want(0, (1, 7), ("", A), (NO_SLOT, 8))
    assert lent.want(0, [1, 7]) == Want(0, (1, 7))


def test_a_sample_in_its_slot() -> None:
    lent = lending(5)
    lent.want(0, [5])
    assert lent.payload(answer(5, 6), []) == Payload(None, row_is_ours=True)
    assert lent.payload(answer(5, 6), []) is None  # once


def test_a_worker_that_could_not_reach_the_slot_writes_there_no_more() -> None:
    lent = lending(5)
    lent.want(0, [5])
    payload = lent.payload(answer(5, 6), frames())
    assert payload is not None
    assert payload.row_is_ours
    assert payload.arrays is not None
    assert all((payload.arrays[name] == array).all() for name, array in sample(5).items())


def test_a_sample_made_by_another_worker_leaves_its_row_to_the_first() -> None:
    lent = lending(5)
    lent.want(0, [5])
    assert lent.payload(answer(5, 7), []) is None  # in another's slot: nobody may read that
    payload = lent.payload(answer(5), frames())
    assert payload is not None
    assert not payload.row_is_ours


def test_where_nothing_is_offered_nothing_is_lent() -> None:
    lent = Lending()
    assert lent.want(2, [4, 5]) == Want(2, (4, 5))
    assert lent.payload(answer(4, 1), []) is None
    payload = lent.payload(answer(4), frames())
    assert payload is not None
    assert payload.row_is_ours
