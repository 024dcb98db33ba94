"""Blame: what the death of a worker says about the sample it was at. Pure.

    crashed, hung                the sample did it: its candidate is refused at once, and the verdict is written down
    unexplained                  an exception, no memory, a lost connection, storage that does not answer: the sample is
                                 tried again; after two such deaths it runs alone on its worker, and a third death
                                 counts like a crash
    killed                       from outside (pre-emption, an impatient operator): says nothing about any sample

Only the lease that the worker had begun is judged; those queued behind it go back as they were.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum

from v2v_server.broker.leases import Request

ALONE_AFTER = 2
"""Unexplained deaths after which a sample runs alone."""


class Cause(StrEnum):
    """Why a worker is gone."""

    CRASHED = "crashed"
    HUNG = "hung"
    UNEXPLAINED = "unexplained"
    KILLED = "killed"


@dataclass(frozen=True, slots=True)
class Loss:
    """A worker that is gone.

    Attributes:
        cause: what it says about the sample in work.
        text: what happened, in words: "was ended by SIGSEGV".
        lease: the lease it was at by its own record, 0 for none; None where there is no record and what it announced
            has to do.
        for_all: whether it speaks against the video for everybody. That a sample took too long does only where the
            video was being decoded; else it was what its spec asks for.
    """

    cause: Cause
    text: str
    lease: int | None = None
    for_all: bool = True


def runs_alone(request: Request) -> bool:
    """Whether the request must have its worker to itself."""
    return request.deaths >= ALONE_AFTER


def judge(request: Request, loss: Loss) -> Request | str:
    """The verdict on a request that was begun when its worker was lost.

    Returns:
        the request to try again, or the reason why its candidate is refused.
    """
    if loss.cause is Cause.KILLED:
        return request
    if loss.cause is Cause.UNEXPLAINED and not runs_alone(request):
        return replace(request, deaths=request.deaths + 1)
    return f"a worker {loss.text} over it"
