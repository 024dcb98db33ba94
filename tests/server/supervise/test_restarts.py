"""How long a dead worker's successor waits, and when there is none."""

from __future__ import annotations

import pytest

from v2v_protocol.errors import WorkerCrashLoop
from v2v_server.broker.leases import Cause, Loss
from v2v_server.supervise.pool import Restarts, crash_budget

LOSS = Loss(Cause.CRASHED, "was ended by SIGSEGV")


def test_the_wait_doubles_and_any_sample_forgives() -> None:
    restarts = Restarts()
    assert [restarts.delay(2, LOSS) for _ in range(8)] == [0.2, 0.4, 0.8, 1.6, 3.2, 6.4, 10.0, 10.0]
    restarts.progress(0)
    assert restarts.delay(2, LOSS) == 10.0
    restarts.progress(1)
    assert restarts.delay(2, LOSS) == 0.2


def test_the_budget_grows_with_the_workers() -> None:
    restarts = Restarts()
    for _ in range(crash_budget(1)):
        restarts.delay(1, LOSS)
    restarts.delay(2, LOSS)
    with pytest.raises(WorkerCrashLoop, match=r"9 server workers died in a row .* was ended by SIGSEGV"):
        restarts.delay(1, LOSS)
