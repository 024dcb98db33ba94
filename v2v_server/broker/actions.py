"""Actions that the dispatcher wants done. The loop (:mod:`v2v_server.serve`) has the sockets, the processes and the
disk, and carries them out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

from v2v_protocol.errors import ProtocolError, VersionMismatch
from v2v_protocol.messages import Denied, ErrorCode, Frames, encode
from v2v_protocol.sample import Refusal
from v2v_server.broker.leases import Request
from v2v_server.quarantine import QuarantineEntry

_LONGEST_TEXT = 2000
"""Characters of a denial. It quotes what the peer sent, which may be long, and must fit a header."""


@dataclass(frozen=True, slots=True)
class ToConsumer:
    """Send these frames to a consumer."""

    identity: bytes
    frames: Sequence[Any]


@dataclass(frozen=True, slots=True)
class ToWorker:
    """Send these frames to a worker.

    Attributes:
        identity: routing id.
        frames: the message.
        arena: arena of the lease that it is, which is passed to the worker before.
    """

    identity: bytes
    frames: Frames
    arena: str = ""


@dataclass(frozen=True, slots=True)
class Disconnect:
    """Disconnect a consumer that keeps sending malformed messages."""

    identity: bytes


@dataclass(frozen=True, slots=True)
class GiveUp:
    """End a hung worker's process, if it is one of ours, and report its loss."""

    identity: bytes
    reason: str


@dataclass(frozen=True, slots=True)
class AddToQuarantine:
    """Write this entry before any later action is carried out, and report the result.

    Attributes:
        entry: not numbered yet.
        request: the request whose candidate it refuses.
    """

    entry: QuarantineEntry
    request: Request


@dataclass(frozen=True, slots=True)
class CheckVideo:
    """Check whether this host has a video (or its sidecar) as catalogued, because a worker cannot read it on its host.

    Attributes:
        video, fingerprint: of the file.
        identity: routing id of the worker.
        frame, reason: what the worker reported.
        request: the request that it could not make.
        sidecar: ending of the video's sidecar that is meant, with its fingerprint; "": the video itself.
    """

    video: str
    fingerprint: str
    identity: bytes
    frame: int | None
    reason: str
    request: Request
    sidecar: str = ""


@dataclass(frozen=True, slots=True)
class ReportRefusal:
    """Tell the operator that a video was passed over.

    Attributes:
        refusal: which video, and why.
        request: the request that it was passed over for.
    """

    refusal: Refusal
    request: Request | None = None


@dataclass(frozen=True, slots=True)
class SendStatus:
    """Send the next state of the service to this peer.

    Attributes:
        identity: routing id of the peer.
        is_worker_side: whether it is connected to the workers' port.
    """

    identity: bytes
    is_worker_side: bool = False


Action: TypeAlias = (
    ToConsumer | ToWorker | Disconnect | GiveUp | AddToQuarantine | CheckVideo | ReportRefusal | SendStatus
)


def denial(code: ErrorCode, text: str) -> Frames:
    """Build a Denied message, shortened to fit a header."""
    return encode(Denied(code, text if len(text) <= _LONGEST_TEXT else text[:_LONGEST_TEXT] + " ..."))


def malformed(error: ProtocolError) -> Frames:
    """Build the reply to a message that cannot be used."""
    return denial(ErrorCode.VERSION if isinstance(error, VersionMismatch) else ErrorCode.MALFORMED, str(error))
