"""More workers where consumers wait, fewer where workers do; no swinging between the two; and what follows deaths."""

from __future__ import annotations

import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from v2v_protocol.errors import WorkerCrashLoop
from v2v_server.broker.leases import Cause, Loss
from v2v_server.supervise.pool import Decision, Restarts, Scaling, crash_budget

SECONDS = 60.0


def run(
    scaling: Scaling, workers: int, demand: float, seconds: float, *, start: float = 0.0, noise: float = 0.0,
    delay: float = 3.0, chance: random.Random | None = None,
) -> tuple[int, list[Decision]]:  # fmt: skip
    """A fleet under a constant demand, in workers; those that are asked for come after ``delay`` seconds."""
    chance = chance or random.Random(0)
    decisions: list[Decision] = []
    target = present = workers
    due = 0.0
    for step in range(int(seconds)):
        now = start + step
        if now >= due:
            present = target
        wanted = demand * (1 + noise * chance.uniform(-1, 1))
        busy = min(1.0, wanted / present) if present else 1.0
        decision = scaling.decide(now, float(wanted >= present and wanted > 0), 1.0 - busy, present)
        if decision is not None:
            decisions.append(decision)
            due = now + delay if decision.workers > target else now
            target = decision.workers
    return target, decisions


@settings(max_examples=60)
@given(
    least=st.integers(0, 20),
    room=st.integers(0, 200),
    demand=st.just(0.0) | st.floats(0.01, 300.0),
    noise=st.sampled_from([0.0, 0.1]),
)
def test_under_a_constant_demand_it_settles_with_enough_workers_and_few_idle(
    least: int, room: int, demand: float, noise: float
) -> None:
    scaling = Scaling(least, least + room, SECONDS)
    workers, decisions = run(scaling, least, demand, 1500.0, noise=noise)
    sizes = [least, *(decision.workers for decision in decisions)]
    assert all(least <= size <= least + room for size in sizes)
    turns = sum((b - a) * (c - b) < 0 for a, b, c in zip(sizes, sizes[1:], sizes[2:], strict=False))
    assert turns <= 1, sizes  # up, and once back what was too much
    assert workers >= min(least + room, demand * (1 - noise) - 1e-9)
    assert workers <= max(least, demand / 0.65 + 1, 1)
    again, decisions = run(scaling, workers, demand, 300.0, start=1500.0, noise=noise, chance=random.Random(1))
    assert (again, decisions) == (workers, [])


def test_two_six_two() -> None:
    scaling = Scaling(2, 6, SECONDS)
    workers, up = run(scaling, 2, 9.0, 300.0)
    assert [decision.workers for decision in up] == [3, 5, 6]
    assert up[0].reason == "100% of consumers waited and 0% of workers were idle in 10 s"
    workers, down = run(scaling, workers, 0.5, 600.0, start=300.0)
    assert [decision.workers for decision in down] == [3, 2]
    assert down[0].reason == "at the busiest 0% of consumers waited and 92% of workers were idle in 10 s"


def test_nobody_is_asked_for_while_those_before_have_not_come() -> None:
    scaling = Scaling(2, 64, SECONDS)
    assert len(run(scaling, 2, 50.0, 100.0, delay=1e9)[1]) == 1


def test_a_pause_shorter_than_the_watch_sends_nobody_away() -> None:
    scaling = Scaling(2, 8, SECONDS)
    workers, _ = run(scaling, 2, 9.0, 300.0)
    assert workers == 8
    assert run(scaling, workers, 0.0, 20.0, start=300.0)[1] == []
    assert run(scaling, workers, 7.5, 100.0, start=320.0)[1] == []


def test_a_long_pause_halves_them_step_by_step_down_to_the_least() -> None:
    scaling = Scaling(1, 8, SECONDS)
    workers, _ = run(scaling, 1, 9.0, 300.0)
    _, down = run(scaling, workers, 0.0, 600.0, start=300.0)
    assert [decision.workers for decision in down] == [4, 2, 1]


def test_from_none_the_first_comes_when_somebody_asks() -> None:
    scaling = Scaling(0, 4, SECONDS)
    assert run(scaling, 0, 0.0, 100.0) == (0, [])
    workers, up = run(scaling, 0, 0.5, 300.0, start=100.0)
    assert (workers, len(up)) == (1, 1)
    assert run(scaling, 1, 0.01, 300.0, start=400.0)[0] == 1
    assert run(scaling, 1, 0.0, 300.0, start=700.0)[0] == 0


# --- how long a dead worker's successor waits, and when there is none -------------------------------------------------


LOSS = Loss(Cause.CRASHED, "was ended by SIGSEGV")


def test_the_wait_doubles_and_any_sample_forgives() -> None:
    restarts = Restarts()
    assert [restarts.delay(2, LOSS) for _ in range(8)] == [0.2, 0.4, 0.8, 1.6, 3.2, 6.4, 10.0, 10.0]
    restarts.progress(0)
    assert restarts.delay(2, LOSS) == 10.0
    restarts.progress(1)
    assert restarts.delay(2, LOSS) == 0.2


def test_the_wait_is_bounded_however_large_the_pool() -> None:
    """A thousand deaths in a row are within the budget of a large pool; two to the thousandth seconds are not."""
    restarts = Restarts()
    assert {restarts.delay(1000, LOSS) for _ in range(crash_budget(1000))} == {0.2, 0.4, 0.8, 1.6, 3.2, 6.4, 10.0}


def test_the_budget_grows_with_the_workers() -> None:
    restarts = Restarts()
    for _ in range(crash_budget(1)):
        restarts.delay(1, LOSS)
    restarts.delay(2, LOSS)
    with pytest.raises(WorkerCrashLoop, match=r"9 server workers died in a row .* \(limit 7\).* was ended by SIGSEGV"):
        restarts.delay(1, LOSS)
