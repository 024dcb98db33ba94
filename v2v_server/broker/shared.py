"""Make equal samples once, if there is a ring.

A request for a sample that is being made follows its *maker*, the request that has the lease; one for a sample in the
ring is answered at once. If the maker's lease ends without a sample, its followers wait again.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import replace
from typing import Any

from v2v_protocol.messages import SampleHeader
from v2v_server.broker.leases import Request, bounded_seconds
from v2v_server.broker.session import Session
from v2v_server.broker.state import Action, Broker, ToConsumer
from v2v_server.sharing import SharedSample


def lend_memory(broker: Broker, session: Session, request: Request, lease: int) -> Request:
    """Let equal requests follow this one, which gets a lease, and return it with the slot that its lease names."""
    if broker.ring is not None:
        broker.makers[sharing_key(session, request)] = request.sample
        # A consumer without a slot is on another host, as far as is known, and gets a message.
        if request.slot is not None and not session.packed:
            broker.ring.lend(lease, session.form.sizes)
    return as_leased(broker, request, lease)


def as_leased(broker: Broker, request: Request, lease: int) -> Request:
    """Return a request with the slot that its lease names.

    Without a ring that is its own. With one it is the memory lent for this lease, or none: the ring needs the
    arrays.
    """
    return request if broker.ring is None else replace(request, slot=broker.ring.lent(lease))


def answer_shared(broker: Broker, session: Session) -> list[Action]:
    """Answer waiting requests whose samples are in the ring, and let those that are being made follow."""
    if broker.ring is None:
        return []
    actions: list[Action] = []
    taken, room = set[Request](), broker.sessions.room(session)
    for request in list(session.waiting):
        if len(taken) < room and (answer := share(broker, session, session.current(request))) is not None:
            actions += answer
            taken.add(request)
    broker.sessions.take_waiting(session, taken)
    return actions


def deliver(
    broker: Broker, session: Session, request: Request, lease: int, header: SampleHeader, payload: Sequence[Any]
) -> list[Action]:
    """Send a finished sample to its consumer, and to those that wait for an equal one.

    Args:
        session, request: the consumer and the request that it was made for.
        lease: number of the lease.
        header: of the sample.
        payload: the frames of its message, with the header's.

    Returns:
        nothing if the sample is not wanted any more.
    """
    if not broker.sessions.mark_answered(request, bounded_seconds(header.cpu_seconds)):
        broker.counters.late_results += 1
        return []
    broker.counters.decodes += header.decoded
    broker.counters.count_cache(header.cache)
    broker.counters.count_sent(session.batch_size, session.form.sizes, in_slot=len(payload) == 1)
    if broker.ring is None:
        return [ToConsumer(request.session, payload)]
    key = sharing_key(session, request)
    sample = broker.ring.add(key, lease, header, payload[1:])
    broker.makers.pop(key, None)
    actions: list[Action] = [ToConsumer(request.session, sample.message(request.slot, is_first=True))]
    for follower in broker.followers.pop(key, ()):
        actions += _send_shared(broker, follower, sample)
    return actions


def share(broker: Broker, session: Session, request: Request) -> list[Action] | None:
    """Answer a request from the ring, or let it wait for the lease that makes its sample; else return None."""
    if broker.ring is None:
        return None
    key = sharing_key(session, request)
    sample = broker.ring.get(key)
    if sample is not None:
        return _send_shared(broker, request, sample)
    maker = broker.makers.get(key)
    if maker not in broker.leases.out:
        return None
    broker.followers.setdefault(key, []).append(request)
    return []


def _send_shared(broker: Broker, request: Request, sample: SharedSample) -> list[Action]:
    session = broker.sessions.get(request.session)
    if session is None or not broker.sessions.mark_answered(request, 0.0):
        return []
    in_slot = sample.memory is not None and request.slot is not None
    broker.counters.count_sent(session.batch_size, session.form.sizes, in_slot=in_slot)
    broker.counters.samples += 1
    broker.counters.shared += 1
    return [ToConsumer(request.session, sample.message(request.slot, is_first=False))]


def release_followers(broker: Broker) -> None:
    """Queue the followers of makers without a lease again, and free the memory of leases that have ended."""
    if broker.ring is None:
        return
    broker.ring.release(broker.leases)
    ended = [key for key, maker in broker.makers.items() if maker not in broker.leases.out]
    for key in reversed(ended):  # a consumer's followers keep their order
        del broker.makers[key]
        for request in reversed(broker.followers.pop(key, [])):
            broker.sessions.put_back(request)


def sharing_key(session: Session, request: Request) -> Hashable:
    """Return a key that is equal for requests whose samples, provenance included, are equal byte for byte and whose
    consumers have the same key.
    """
    return (
        session.user, session.spec.digest, session.seed, session.arrays, session.packed,
        request.epoch, request.index, request.candidate, request.refusals, request.snapshot,
    )  # fmt: skip
