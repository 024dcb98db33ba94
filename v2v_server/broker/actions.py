"""What the dispatcher wants done. The loop (:mod:`v2v_server.serve`) has the sockets, the processes and the disk, and
carries it out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

from v2v_protocol.messages import Denied, ErrorCode
from v2v_protocol.refusal import Refusal
from v2v_protocol.wire import Frames, encode
from v2v_server.broker.leases import Request
from v2v_server.broker.quarantine import QuarantineEntry

_LONGEST_TEXT = 2000
"""Characters of a denial: it quotes what the peer sent, which may be long, and must itself fit a header."""


@dataclass(frozen=True, slots=True)
class ToConsumer:
    """Send these frames to a consumer."""

    identity: bytes
    frames: Sequence[Any]


@dataclass(frozen=True, slots=True)
class ToWorker:
    """Send these frames to a worker."""

    identity: bytes
    frames: Frames


@dataclass(frozen=True, slots=True)
class CutOff:
    """This consumer sends nothing but nonsense: end its connection."""

    identity: bytes


@dataclass(frozen=True, slots=True)
class GiveUp:
    """This worker hangs: end its process where that is in our power, and report its loss."""

    identity: bytes
    reason: str


@dataclass(frozen=True, slots=True)
class AddToQuarantine:
    """Write this verdict down before anything that follows is sent, and report what came of it.

    Attributes:
        verdict: not numbered yet.
        request: whose candidate it refuses.
    """

    entry: QuarantineEntry
    request: Request


@dataclass(frozen=True, slots=True)
class CheckVideo:
    """A worker cannot have a video on its host: see whether it is on this one as it was catalogued, and report.

    Attributes:
        video, fingerprint: of the file.
        identity: the worker.
        frame, reason: what the worker said.
        request: what it was to make of it.
    """

    video: str
    fingerprint: str
    identity: bytes
    frame: int | None
    reason: str
    request: Request


@dataclass(frozen=True, slots=True)
class ReportRefusal:
    """Tell the operator that a video was passed over.

    Attributes:
        refusal: which, and why.
        request: that it was passed over for.
    """

    refusal: Refusal
    request: Request | None = None


@dataclass(frozen=True, slots=True)
class Show:
    """This peer looks at the service: send it the next state that is made.

    Attributes:
        identity: of the peer.
        is_worker_side: it is connected where workers are.
    """

    identity: bytes
    is_worker_side: bool = False


Action: TypeAlias = ToConsumer | ToWorker | CutOff | GiveUp | AddToQuarantine | CheckVideo | ReportRefusal | Show


def denial(code: ErrorCode, text: str) -> Frames:
    """A Denied message that is short enough whatever the text quotes."""
    return encode(Denied(code, text if len(text) <= _LONGEST_TEXT else text[:_LONGEST_TEXT] + " ..."))
