"""Time the broker's choice of the next request, by the number of waiting consumers.

Every consumer always has requests waiting. One turn takes the next request and answers it with a cost of its own, so
that consumers run into debt and earn quanta. The bar is the processor time of one choice, averaged over many turns.
"""

from __future__ import annotations

import argparse
import time
from typing import Any, cast

from bench.frame import Report
from v2v_protocol.liveness import Liveness
from v2v_protocol.spec import StreamSpec
from v2v_server.broker.leases import LeaseBook
from v2v_server.broker.session import Session, Sessions
from v2v_server.schedule.epoch import Schedule

_CONSUMERS = (8, 64, 1000, 4096)
_BAR_CONSUMERS, _BAR_SECONDS = 1000, 10e-6
_WAITING = 4


class _OneSequence:
    """A schedule with one index for each epoch; it only counts how much is asked for."""

    count = 1

    def place(self, index: int) -> int:
        """Return the place of an index."""
        return index


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of this bench."""
    parser.add_argument(
        "--turns", type=int, default=20_000, help="requests to take for each number of consumers (default: %(default)s)"
    )


def measure(asked: argparse.Namespace) -> Report:
    """Measure each number of consumers."""
    records = [_measure(consumers, asked.turns) for consumers in _CONSUMERS]
    columns = (
        ("consumers", "consumers", "{}", 1),
        ("choice_seconds", "next request, us", "{:.2f}", 1e6),
        ("turn_seconds", "with its answer, us", "{:.2f}", 1e6),
    )
    missed = [
        f"{record['choice_seconds'] * 1e6:.1f} us a lease at {_BAR_CONSUMERS} consumers; the bar is 10 us"
        for record in records
        if record["consumers"] == _BAR_CONSUMERS and record["choice_seconds"] > _BAR_SECONDS
    ]
    return Report(records, [(records, columns)], missed=missed)


def _measure(consumers: int, turns: int) -> dict[str, Any]:
    spec, schedule = StreamSpec(), cast(Schedule, _OneSequence())
    sessions, opened = Sessions(LeaseBook(60.0)), {}
    for number in range(consumers):
        identity = number.to_bytes(4, "little")
        session = Session(identity, spec, 0, ("voxels",), 4, schedule, _WAITING, Liveness(0.0, gone_seconds=60.0))
        opened[identity] = session
        sessions.open(session)
        for epoch in range(_WAITING):
            sessions.want(session, epoch, [0])
    choosing = 0.0
    start = time.process_time()
    for _ in range(turns):
        begin = time.process_time()
        request = sessions.next_request()
        choosing += time.process_time() - begin
        if request is None:
            raise AssertionError("no consumer waits")
        sessions.mark_answered(request, 0.01 + request.session[0] / 1000)
        sessions.want(opened[request.session], request.epoch + _WAITING, [0])
    return {
        "consumers": consumers,
        "choice_seconds": choosing / turns,
        "turn_seconds": (time.process_time() - start) / turns,
    }
