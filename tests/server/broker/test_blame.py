"""Blame: every cause, with every number of deaths before it."""

from __future__ import annotations

from dataclasses import replace

import pytest

from v2v_server.broker.leases import ALONE_AFTER, Cause, Loss, Request, judge, runs_alone

REQUEST = Request(b"consumer", 3, 7, candidate=2)


def after(deaths: int) -> Request:
    return replace(REQUEST, deaths=deaths)


REFUSED = "a worker did something over it"


@pytest.mark.parametrize(
    ("cause", "deaths", "verdict"),
    [
        (Cause.CRASHED, 0, REFUSED),
        (Cause.CRASHED, 1, REFUSED),
        (Cause.CRASHED, 2, REFUSED),
        (Cause.HUNG, 0, REFUSED),
        (Cause.HUNG, 1, REFUSED),
        (Cause.HUNG, 2, REFUSED),
        (Cause.UNEXPLAINED, 0, after(1)),
        (Cause.UNEXPLAINED, 1, after(2)),
        (Cause.UNEXPLAINED, 2, REFUSED),
        (Cause.KILLED, 0, after(0)),
        (Cause.KILLED, 1, after(1)),
        (Cause.KILLED, 2, after(2)),
    ],
)
def test_verdicts(cause: Cause, deaths: int, verdict: Request | str) -> None:
    assert judge(after(deaths), Loss(cause, "did something")) == verdict


def test_every_cause_is_in_the_table() -> None:
    (mark,) = test_verdicts.pytestmark  # type: ignore[attr-defined]
    judged_here = {(cause, deaths) for cause, deaths, _ in mark.args[1]}
    assert judged_here == {(cause, deaths) for cause in Cause for deaths in range(ALONE_AFTER + 1)}


def test_a_task_runs_alone_after_two_unexplained_deaths_until_its_candidate_changes() -> None:
    assert [runs_alone(after(deaths)) for deaths in range(4)] == [False, False, True, True]
