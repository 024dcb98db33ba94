"""Test the summary at the end of a server."""

from __future__ import annotations

from tests.server.peers import peers
from tests.server.status.services import published
from v2v_server.status.terminal import format_shutdown_summary


def test_a_server_that_did_nothing_says_so() -> None:
    assert format_shutdown_summary(published(peers()).status()) == [
        "in total 0 samples (0.0 batches, 0.00 GiB) in 0.0 s: 0.00 samples/s", "faults 0",
    ]  # fmt: skip


def test_samples_faults_and_rates_are_summed_up() -> None:
    at = peers()
    counters = at.dispatcher.counters
    counters.samples, counters.batches, counters.decodes, counters.bytes = 600, 50.0, 200, 3 << 30
    counters.refused_candidates, counters.workers_lost, counters.returned_leases = 2, 1, 4
    counters.waited_seconds = 90.0
    counters.decode_seconds, counters.simulate_seconds, counters.handover_seconds = 200.0, 150.0, 50.0
    status = published(at).plain() | {"uptime_seconds": 3 * 3600.0}
    assert format_shutdown_summary(status) == [
        "in total 600 samples (50.0 batches, 3.00 GiB, from 200 decoded clips) in 3 h 0 min: 0.06 samples/s",
        "faults 3; 2 refused candidates, 4 returned leases, 1 workers lost",
        "workers spent 7 min on them: decoding 50%, simulating 38%, delivering 12%; consumers waited 90.0 s",
    ]
