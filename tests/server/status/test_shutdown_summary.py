"""What is said at the end of a server."""

from __future__ import annotations

from dataclasses import replace

from tests.server.peers import peers
from tests.server.status.services import service
from v2v_server.status.shutdown_summary import format_shutdown_summary


def test_a_server_that_did_nothing_says_so() -> None:
    assert format_shutdown_summary(service(peers()).state()) == [
        "in all 0 samples (0.0 batches, 0.00 GiB) in 0.0 s: 0.00 samples/s", "faults 0",
    ]  # fmt: skip


def test_samples_faults_and_rates_are_summed_up() -> None:
    at = peers()
    counters = at.dispatcher.counters
    counters.samples, counters.batches, counters.decodes, counters.bytes = 600, 50.0, 200, 3 << 30
    counters.refused_candidates, counters.workers_lost = 2, 1
    counters.waited_seconds = 90.0
    work = counters.work
    work.decode_seconds, work.simulate_seconds, work.handover_seconds = 200.0, 150.0, 50.0
    state = replace(service(at).state(), uptime_seconds=3 * 3600.0)
    assert format_shutdown_summary(state) == [
        "in all 600 samples (50.0 batches, 3.00 GiB, from 200 decoded clips) in 3 h 0 min: 0.06 samples/s",
        "faults 3: 2 candidates refused, 1 workers lost",
        "workers spent 7 min on them: decoding 50%, simulating 38%, handing over 12%; consumers waited 90.0 s",
    ]
