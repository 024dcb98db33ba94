"""Which slots a connection names, and what an arrival says of that of its sample."""

from __future__ import annotations

from v2v_client.memory.slots import Answer, Slots
from v2v_protocol.arena import NO_SLOT, Slot
from v2v_protocol.messages import Want

A, B = "arena a", "arena b"


def offered(*indices: int) -> Slots:
    """With a slot for each."""
    slots = Slots()
    slots.offer({index: Slot(A, index + 1) for index in indices})
    return slots


def test_a_request_names_the_slots_that_were_offered() -> None:
    slots = offered(3, 1)
    slots.offer({2: Slot(B, 7), 9: Slot(B, 8)})
    assert slots.want(4, [3, 2, 1, 5]) == Want(4, (3, 2, 1, 5), (A, B, A, ""), (4, 7, 2, NO_SLOT))


def test_what_is_asked_again_is_asked_without_a_slot() -> None:
    """The first worker may be writing to the one that was named."""
    slots = offered(3, 1, 7)
    slots.want(0, [3, 1])
    assert slots.want(0, [1, 7]) == Want(0, (1, 7), ("", A), (NO_SLOT, 8))
    assert slots.want(0, [1, 7]) == Want(0, (1, 7))


def test_a_sample_in_its_slot_comes_once() -> None:
    slots = offered(5)
    slots.want(0, [5])
    assert slots.record_arrival(5, 6, in_message=False) is Answer.THERE
    assert slots.record_arrival(5, 6, in_message=False) is Answer.NOWHERE


def test_a_worker_that_could_not_reach_the_slot_writes_there_no_more() -> None:
    slots = offered(5)
    slots.want(0, [5])
    assert slots.record_arrival(5, 6, in_message=True) is Answer.MESSAGE


def test_a_sample_made_by_another_worker_leaves_its_slot_to_the_first() -> None:
    slots = offered(5)
    slots.want(0, [5])
    assert slots.record_arrival(5, 7, in_message=False) is Answer.NOWHERE  # in another's slot: nobody may read that
    assert slots.record_arrival(5, NO_SLOT, in_message=True) is Answer.ABANDONED


def test_where_nothing_is_offered_nothing_is_lent() -> None:
    slots = Slots()
    assert slots.want(2, [4, 5]) == Want(2, (4, 5))
    assert slots.record_arrival(4, 1, in_message=False) is Answer.NOWHERE
    assert slots.record_arrival(4, NO_SLOT, in_message=True) is Answer.MESSAGE
