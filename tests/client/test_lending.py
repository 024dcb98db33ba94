"""Which slots a connection names, and what it takes for a sample."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest
import zmq

from tests.client.test_arena import LAYOUT, rows, sample
from v2v_client.arena import Arena
from v2v_client.lending import Lending
from v2v_protocol.arena import NO_SLOT
from v2v_protocol.messages import SampleHeader, Want
from v2v_server.handover import put

pytestmark = pytest.mark.skipif(not hasattr(os, "memfd_create"), reason="this system has no memfd_create")


@pytest.fixture
def lending() -> Iterator[Lending]:
    opened = Lending(Arena(LAYOUT))
    yield opened
    opened.close()


def slots(requests: list[Want]) -> dict[int, int]:
    return {
        index: slot
        for request in requests
        for index, slot in zip(request.indices, request.slots or (NO_SLOT,) * len(request.indices), strict=True)
    }


def answer(index: int, slot: int = NO_SLOT) -> SampleHeader:
    shapes = tuple(number for _, shape in LAYOUT.values() for number in (len(shape), *shape))
    dtypes = tuple(dtype for dtype, _ in LAYOUT.values())
    return SampleHeader(0, index, tuple(LAYOUT), dtypes, shapes, {}, "worker", 0.1, slot=slot)


def test_every_request_has_a_slot_of_its_own(lending: Lending) -> None:
    first, second = slots(lending.wants(0, [3, 1])), slots(lending.wants(0, [2]))
    assert NO_SLOT not in {*first.values(), *second.values()}
    assert len({*first.values(), *second.values()}) == 3


def test_what_is_asked_again_is_asked_without_a_slot(lending: Lending) -> None:
    """The first worker may be writing to the one that was named."""
    slots(lending.wants(0, [3, 1]))
    again = slots(lending.wants(0, [1, 7]))
    assert again[1] == NO_SLOT
    assert again[7] != NO_SLOT


def test_a_slot_is_lent_again_once_its_sample_was_read(lending: Lending) -> None:
    (request,) = lending.wants(0, [5])
    assert put(request.arena, request.slots[0], sample(5))
    payload = lending.payload(answer(5, request.slots[0]), [])
    assert payload is not None
    assert slots(lending.wants(0, [6]))[6] != request.slots[0]  # not yet read
    into = rows()
    payload.copy_to(into)
    assert all((into[name] == array).all() for name, array in sample(5).items())
    assert slots(lending.wants(0, [8]))[8] == request.slots[0]


def test_a_slot_whose_sample_lies_elsewhere_is_never_lent_again(lending: Lending) -> None:
    (request,) = lending.wants(0, [5])
    assert lending.payload(answer(5, request.slots[0] + 1), []) is None  # in another's slot: nobody may read that
    frames = [zmq.Frame(array.tobytes()) for array in sample(5).values()]
    assert lending.payload(answer(5), frames) is not None  # made without a slot, for instance by a second worker
    assert request.slots[0] not in slots(lending.wants(0, [6, 7, 8])).values()


def test_without_an_arena_nothing_is_lent() -> None:
    lending = Lending(None)
    assert lending.wants(2, [4, 5]) == [Want(2, (4, 5))]
    assert lending.payload(answer(4, 1), []) is None
    lending.close()
