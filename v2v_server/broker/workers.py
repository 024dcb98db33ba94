"""What workers say and what becomes of it: they come and go, their leases end with a sample, a failure or their loss.

The result of a lease is checked before it is passed on: a consumer trusts its server, but the server does not trust a
worker, which may run another version, be broken or be hostile. Only the small header is read. The arrays are measured,
unless they lie in a slot.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from v2v_protocol import NUMERICS_VERSION
from v2v_protocol.arena import NO_SLOT
from v2v_protocol.errors import LimitExceeded, ProtocolError
from v2v_protocol.messages import (
    Denied,
    ErrorCode,
    LeaseFailed,
    Notes,
    Pong,
    Result,
    SampleHeader,
    WorkerHello,
    decode,
    encode,
    largest_packed_bytes,
)
from v2v_protocol.sample import Form
from v2v_server.broker.admission import owner_digest
from v2v_server.broker.assignment import mark_outgrown
from v2v_server.broker.candidates import quarantine_candidate
from v2v_server.broker.leases import MOST_WORKERS, Cause, Loss, Request, clean_name, judge, runs_alone
from v2v_server.broker.shared import as_leased, deliver
from v2v_server.broker.state import Action, Broker, CheckVideo, ToWorker, denial, malformed

_LONGEST_NAME_BYTES = 255


def register(broker: Broker, identity: bytes, hello: WorkerHello, now: float, user: str) -> list[Action]:
    """Add a worker that says hello, in place of the connection that it had before."""
    try:
        owner = owner_digest(user, hello.secret)
        before = _replaced_by(broker, identity, hello.name, owner, user)
    except LimitExceeded as error:
        return [ToWorker(identity, malformed(broker, error))]
    actions = [action for each in before for action in remove(broker, each, Loss(Cause.KILLED, "started again"))]
    if hello.numerics_version != NUMERICS_VERSION:
        text = f"worker numerics version {hello.numerics_version}, the server's is {NUMERICS_VERSION}"
        return [ToWorker(identity, encode(Denied(ErrorCode.VERSION, text))), *actions]
    if len(broker.registry.members) >= MOST_WORKERS:
        text = f"this server has {MOST_WORKERS} workers, its limit"
        return [ToWorker(identity, denial(ErrorCode.BUSY, text)), *actions]
    broker.registry.add(identity, hello, now, user, owner)
    return actions


def _replaced_by(broker: Broker, identity: bytes, name: str, owner: bytes, user: str) -> list[bytes]:
    """Return the connections that a worker's hello replaces: its own ones.

    Raises:
        LimitExceeded: one of them is another worker's, or the name is too long.
    """
    if len(name.encode()) > _LONGEST_NAME_BYTES:
        raise LimitExceeded(f"the name has {len(name.encode())} bytes; the limit is {_LONGEST_NAME_BYTES}")
    members = broker.registry.members
    before = [each for each in {identity, broker.registry.named(name)} if each is not None and each in members]
    for each in before:
        is_own = members[each].owner == owner and (bool(owner) or each == identity)
        # A worker of this host needs no key. Its supervisor knows it by its name, so no key can hold that.
        if not is_own and (user or not members[each].user):
            raise LimitExceeded(
                f"a worker with the name or routing id of {clean_name(name)!r} is connected; both must be unique: "
                "start this one with another --name"
            )
    return before


def pong(broker: Broker, identity: bytes) -> Pong:
    """Answer a worker's Ping, with what this broker serves: a worker of several compares them."""
    if not broker.registry.members[identity].takes_notes:
        return Pong()
    spec = broker.default_spec
    return Pong(notes=Notes(catalogue=broker.facts.digest_under(spec.scene), spec=spec.digest))


def accept_result(broker: Broker, identity: bytes, result: Result, payload: Sequence[Any], now: float) -> list[Action]:
    """Close the lease of a result, and pass its sample on; drop a worker whose result is malformed.

    Args:
        identity: routing id of the worker.
        result: its message.
        payload: the frames behind it.
        now: monotonic time, seconds.
    """
    request = broker.leases.request(result.lease, identity)
    session = None if request is None else broker.sessions.get(request.session)
    actions: list[Action] = []
    decoded = True
    if request is None or session is None:
        broker.counters.late_results += 1
        _charge(broker, result.lease, identity, now)
    else:
        try:
            header = check_result(payload, as_leased(broker, request, result.lease), session.form)
        except ProtocolError as error:
            # Our workers never send such a result; a worker that sends one would send more.
            refused = ToWorker(identity, malformed(broker, ProtocolError(f"malformed result: {error}")))
            return [refused, *lose(broker, identity, Loss(Cause.KILLED, "sent a malformed result"))]
        decoded = header.decoded
        actions += deliver(broker, session, request, result.lease, header, payload)
        if actions:
            broker.counters.add(result, header.cpu_seconds)
            broker.registry.worked(identity, result, header.cpu_seconds)
    broker.registry.can_work(identity)
    broker.leases.finished(result.lease, identity, now, decoded=decoded)
    broker.leases.mark_begun(result.begins, identity, now)
    return actions


def check_result(payload: Sequence[Any], request: Request, form: Form) -> SampleHeader:
    """Return the header of a result, after checking that its consumer will be able to read the sample.

    Args:
        payload: the frames behind the worker's Result: a whole SampleHeader message.
        request: what was asked.
        form: the expected form of the sample.

    Raises:
        ProtocolError: the result must not be passed on.
    """
    if not payload:
        raise ProtocolError("nothing follows it")
    header = decode(bytes(payload[0]))
    if not isinstance(header, SampleHeader) or (header.epoch, header.index) != (request.epoch, request.index):
        raise ProtocolError("its header names another sample than the lease")
    if (header.names, header.dtypes) != (form.names, form.dtypes):
        raise ProtocolError(f"it has {list(header.names)!r:.100} of {list(header.dtypes)!r:.100}")
    if header.quarantine != request.snapshot:
        raise ProtocolError(f"it was made under quarantine snapshot {header.quarantine}, not {request.snapshot}")
    slot = NO_SLOT if request.slot is None else request.slot.number
    if header.slot != slot:
        raise ProtocolError(f"it names slot {header.slot}, slot {slot} was lent")
    in_slot = slot != NO_SLOT and len(payload) == 1
    if header.shapes != form.shapes or not (in_slot or _fits(payload[1:], form.sizes, header.packed)):
        raise ProtocolError("its arrays have other shapes or sizes than the lease asks for")
    return header


def _fits(frames: Sequence[Any], sizes: tuple[int, ...], packed: bool) -> bool:
    """Return whether the frames may hold arrays of these sizes, bytes."""
    lengths = tuple(map(len, frames))
    if not packed or len(lengths) != len(sizes):
        return lengths == sizes
    return all(0 < length <= largest_packed_bytes(size) for length, size in zip(lengths, sizes, strict=True))


def close_failed(broker: Broker, identity: bytes, failed: LeaseFailed, now: float) -> CheckVideo | None:
    """Close a lease whose sample a worker could not make, and return what failed; None if the sample is not wanted."""
    _charge(broker, failed.lease, identity, now)
    request = broker.leases.finished(failed.lease, identity, now)
    session = None if request is None else broker.sessions.get(request.session)
    if request is None or session is None:
        return None
    video, sidecar = session.sequence(request).video, failed.sidecar
    fingerprint = broker.facts.sidecars_of(video.id, session.arrays).get(sidecar) if sidecar else video.fingerprint
    if not failed.here:
        broker.registry.can_work(identity)
    return CheckVideo(
        video.id, fingerprint or "", identity, failed.frame, failed.reason, request, sidecar if fingerprint else ""
    )


def _charge(broker: Broker, lease: int, worker: bytes, now: float) -> None:
    """Charge a consumer for a sample that it asked for and then abandoned."""
    debt = broker.leases.debt(lease, worker, now)
    if debt is not None:
        broker.sessions.queue.charge(*debt)


def lose(broker: Broker, identity: bytes, loss: Loss) -> list[Action]:
    """Count and remove a worker that died, was given up, or is unreachable."""
    broker.counters.workers_lost += 1
    return remove(broker, identity, loss)


def remove(broker: Broker, identity: bytes, loss: Loss) -> list[Action]:
    """Remove a worker, and queue the requests of its leases again; those that it broke down over are judged."""
    limit_bytes = broker.registry.members[identity].limit_bytes if identity in broker.registry.members else 0
    broker.registry.remove(identity)
    actions: list[Action] = []
    returned = broker.leases.lost(identity, loss.lease)
    broker.counters.returned_leases += len(returned)
    for request, begun in reversed(returned):
        if begun and loss.cause is Cause.MEMORY and runs_alone(request):
            mark_outgrown(broker, request, limit_bytes)
        verdict = judge(request, loss) if begun else request
        if isinstance(verdict, Request):
            broker.sessions.put_back(verdict)
        else:
            actions += quarantine_candidate(
                broker, request, verdict, for_all=loss.for_all and loss.cause is not Cause.UNEXPLAINED
            )
    return actions
