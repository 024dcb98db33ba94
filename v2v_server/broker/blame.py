"""Decide what the loss of a worker says about the sample in work. Pure.

    crashed, hung                the sample is the cause: its candidate is refused at once and quarantined
    unexplained                  an exception, no memory, a lost connection, storage that does not answer: the sample is
                                 tried again; after two such losses it runs alone on its worker, and a third one
                                 counts like a crash, for its spec only: memory may be what this spec takes
    killed                       from outside (pre-emption, an operator): says nothing about any sample

Only the lease that the worker had begun is judged. The leases queued behind it go back unchanged.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum

from v2v_server.broker.leases import Request

ALONE_AFTER = 2
"""Number of unexplained losses after which a sample runs alone."""


class Cause(StrEnum):
    """Reason why a worker is gone."""

    CRASHED = "crashed"
    HUNG = "hung"
    UNEXPLAINED = "unexplained"
    KILLED = "killed"


@dataclass(frozen=True, slots=True)
class Loss:
    """Loss of a worker.

    Attributes:
        cause: what it says about the sample in work.
        text: what happened, in words: "was ended by SIGSEGV".
        lease: the lease in work by the worker's own record, 0 for no lease; None without a record. Then the last lease
            that the worker announced counts.
        for_all: whether the video is refused under every spec: only if it was being decoded, or nothing is known, and
            the loss is not unexplained. Otherwise the cause may be what its spec asks for.
    """

    cause: Cause
    text: str
    lease: int | None = None
    for_all: bool = True


def runs_alone(request: Request) -> bool:
    """Return whether the request needs a worker without other leases."""
    return request.deaths >= ALONE_AFTER


def judge(request: Request, loss: Loss) -> Request | str:
    """Judge a request that was begun when its worker was lost.

    Returns:
        the request to try again, or the reason why its candidate is refused.
    """
    if loss.cause is Cause.KILLED:
        return request
    if loss.cause is Cause.UNEXPLAINED and not runs_alone(request):
        return replace(request, deaths=request.deaths + 1)
    return f"a worker {loss.text} over it"
