"""What consumers say and what becomes of it: sessions that are opened and forgotten, requests, faults."""

from __future__ import annotations

from v2v_protocol import NUMERICS_VERSION
from v2v_protocol.arena import NO_SLOT, ArenaName, Slot
from v2v_protocol.errors import CorpusError, LimitExceeded, ProtocolError, UsageError
from v2v_protocol.messages import ErrorCode, Frames, Hello, Want, encode
from v2v_protocol.sample import SampleId
from v2v_server.broker.admission import admit, owner_digest
from v2v_server.broker.session import Session
from v2v_server.broker.shared import answer_shared
from v2v_server.broker.state import Action, Broker, Disconnect, ToConsumer, denial, malformed

MOST_SESSIONS = 4096
MOST_FAULTS = 16
"""Malformed messages and refused specs after which a consumer is disconnected: an answer costs as much as a sample."""


def open_session(broker: Broker, identity: bytes, hello: Hello, now: float, user: str) -> Action:
    """Answer a Hello. It replaces the sessions of the same consumer, whose requests are dropped."""
    try:
        owner = owner_digest(user, hello.secret)
    except LimitExceeded as error:
        return ToConsumer(identity, denial(ErrorCode.MALFORMED, str(error)))
    present = broker.sessions.get(identity)
    if present is not None and (present.owner, present.user) != (owner, user):
        text = "this routing id belongs to the session of another consumer: connect with a random one"
        return ToConsumer(identity, denial(ErrorCode.MALFORMED, text))
    if present is None and len(broker.sessions) >= MOST_SESSIONS:
        for silent in broker.sessions.dispensable(now):
            forget(broker, silent)
    if present is None and len(broker.sessions) >= MOST_SESSIONS:
        return ToConsumer(identity, denial(ErrorCode.BUSY, f"this server has {MOST_SESSIONS} consumers, its limit"))
    try:
        session, welcome = admit(broker, identity, hello, now)
        session.user, session.owner = user, owner
    except (UsageError, CorpusError) as error:
        return answer_fault(broker, identity, denial(ErrorCode.SPEC, str(error)))
    for before in {identity, *broker.sessions.owned_by(owner)}:
        _forget_session(broker, before)
    broker.sessions.open(session)
    return ToConsumer(identity, encode(welcome))


def queue_requests(broker: Broker, session: Session, want: Want) -> list[Action]:
    """Queue the requests of a Want, and answer those whose samples are there, or deny all of them."""
    try:
        slots = _slots(want)
        for index in want.indices[:1]:
            SampleId(session.spec.digest, broker.facts.digest, NUMERICS_VERSION, session.seed, want.epoch, index)
        broker.sessions.want(session, want.epoch, want.indices, slots)
    except LimitExceeded as error:
        return [ToConsumer(session.identity, denial(ErrorCode.CREDIT, str(error)))]
    except ProtocolError as error:
        return [answer_fault(broker, session.identity, malformed(broker, error))]
    except (IndexError, UsageError) as error:
        return [ToConsumer(session.identity, denial(ErrorCode.RANGE, str(error)))]
    return answer_shared(broker, session)


def _slots(want: Want) -> list[Slot | None]:
    """Return where the samples may be put.

    Raises:
        ProtocolError: a slot does not exist, or the numbers of slots and indices differ.
    """
    if not len(want.arenas) == len(want.slots) in (0, len(want.indices)):
        raise ProtocolError(f"want: {len(want.arenas)} arenas, {len(want.slots)} slots for {len(want.indices)} indices")
    numbers = {arena: (1, ArenaName.parse(arena).slots) for arena in set(want.arenas) - {""}}
    numbers[""] = NO_SLOT, NO_SLOT
    for arena, number in zip(want.arenas, want.slots, strict=True):
        least, most = numbers[arena]
        if not least <= number <= most:
            raise ProtocolError(f"want.slots: {number} of arena {arena!r:.80}; it has {least} to {most}")
    return [Slot(arena, number) if arena else None for arena, number in zip(want.arenas, want.slots, strict=True)]


def trouble_of(broker: Broker, identity: bytes) -> str:
    """Return why a consumer waits in vain for its samples; empty if it does not, as far as is known."""
    trouble = broker.blocked_reason or broker.registry.trouble(broker.expected_workers)
    of_clips = (clip.trouble for clip in broker.parked if clip.trouble and clip.requests[0].session == identity)
    return trouble or next(of_clips, "")


def forget(broker: Broker, identity: bytes) -> None:
    """Forget a consumer that left or cannot be reached any more."""
    broker.sessions.forget(identity)
    _forget_session(broker, identity)


def _forget_session(broker: Broker, session: bytes) -> None:
    """Drop the requests of a consumer that is gone, and abandon its leases."""
    broker.leases.forget_session(session)
    broker.parked = [clip for clip in broker.parked if clip.requests[0].session != session]
    for key, followers in broker.followers.items():
        broker.followers[key] = [request for request in followers if request.session != session]


def answer_fault(broker: Broker, identity: bytes, answer: Frames) -> Action:
    """Answer a malformed message or a refused spec of a consumer; disconnect it after too many."""
    faults = broker.faults[identity] = broker.faults.pop(identity, 0) + 1
    if len(broker.faults) > MOST_SESSIONS:
        del broker.faults[next(iter(broker.faults))]
    return ToConsumer(identity, answer) if faults <= MOST_FAULTS else Disconnect(identity)
