"""Test which slots a connection's requests name, and what an arrival means for the slot of its sample."""

from __future__ import annotations

import pytest

from v2v_client.memory import Slots
from v2v_protocol.arena import NO_SLOT, Slot
from v2v_protocol.messages import Want

A, B = "arena a", "arena b"


def offered(*indices: int) -> Slots:
    """Return slots with one offered for each index."""
    slots = Slots()
    slots.offer({index: Slot(A, index + 1) for index in indices})
    return slots


def test_a_request_names_the_slots_that_were_offered() -> None:
    slots = offered(3, 1)
    slots.offer({2: Slot(B, 7), 9: Slot(B, 8)})
    assert slots.want(4, [3, 2, 1, 5]) == Want(4, (3, 2, 1, 5), (A, B, A, ""), (4, 7, 2, NO_SLOT))


def test_a_repeated_request_names_no_slot() -> None:
    """The first worker may still be writing to the slot that was named."""
    slots = offered(3, 1, 7)
    slots.want(0, [3, 1])
    assert slots.want(0, [1, 7]) == Want(0, (1, 7), ("", A), (NO_SLOT, 8))
    assert slots.want(0, [1, 7]) == Want(0, (1, 7))


@pytest.mark.parametrize("in_message", [False, True])
def test_a_sample_of_its_slot_frees_the_slot_and_is_read_from_it_once(in_message: bool) -> None:
    slots = offered(5)
    slots.want(0, [5])
    assert slots.record_arrival(5, 6, in_message=in_message) is True
    assert slots.record_arrival(5, 6, in_message=False) is None


def test_a_sample_from_another_worker_abandons_the_slot() -> None:
    slots = offered(5)
    slots.want(0, [5])
    assert slots.record_arrival(5, 7, in_message=False) is None  # in another sample's slot, which must not be read
    assert slots.record_arrival(5, NO_SLOT, in_message=True) is False


def test_without_offers_requests_name_no_slots() -> None:
    slots = Slots()
    assert slots.want(2, [4, 5]) == Want(2, (4, 5))
    assert slots.record_arrival(4, 1, in_message=False) is None
    assert slots.record_arrival(4, NO_SLOT, in_message=True) is True
