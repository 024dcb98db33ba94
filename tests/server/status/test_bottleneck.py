"""Who waits for whom: each verdict from its shares, and the shares from what was noted."""

from __future__ import annotations

from typing import Any

import pytest

from tests.server.peers import Peers, answer_to
from tests.server.status.services import Published
from v2v_protocol.messages import Goodbye, Result, Want
from v2v_server.broker.leases import Stall
from v2v_server.status.snapshot import Shares, find_bottleneck

FULL = {"seconds": 10.0, "consumers": 0.8, "idle": 0.02, "broker": 0.2}
CASES: list[tuple[dict[str, Any], str, str, str]] = [
    ({"there": {"is_attended": False}}, "no_consumers", "No consumer is connected", ""),
    ({"seconds": 1.0}, "start", "too early", ""),
    ({"there": {"workers": 0, "trouble": "no worker is there", "starting": 0}}, "workers", "no worker is there", ""),
    ({"there": {"workers": 0, "trouble": "no worker is there", "starting": 3}}, "workers", "3 are starting", ""),
    ({"consumers": 0.03, "idle": 0.6}, "consumers", "Workers wait for consumers", "fewer workers would do"),
    ({"consumers": 0.03, "idle": 0.4}, "consumers", "idle 40% of theirs", ""),
    ({"consumers": 0.03, "idle": 0.1}, "even", "Hardly any waiting", ""),
    ({"decode": 0.7, "simulate": 0.2, "handover": 0.05}, "decode", "which decode 70% of theirs", "--cache"),
    ({"decode": 0.2, "simulate": 0.7, "handover": 0.05}, "simulate", "which simulate 70% of theirs", "fewer effects"),
    ({"decode": 0.2, "simulate": 0.2, "handover": 0.5}, "handover", "which deliver samples 50%", "shared memory"),
    ({"broker": 0.95, "idle": 0.5, "decode": 0.4}, "broker", "busy 95% of its time", "two servers"),
    ({"broker": 0.95, "idle": 0.0, "decode": 0.4}, "broker", "busy 95% of its time", "two servers"),
    ({"decode": 0.9, "queued": 0.75, "cores": 0.15}, "cores", "75% of theirs for a core and get 0.15 of a core each",
     "more workers on this host would not help"),
    ({"decode": 0.9, "queued": 0.3, "cores": 0.6}, "decode", "which decode 90% of theirs", "start more workers"),
    ({"idle": 0.5, "decode": 0.4}, "transit", "although workers are idle 50%", "network"),
]  # fmt: skip


@pytest.mark.parametrize(("case", "part", "sentence", "remedy"), CASES)
def test_each_verdict_follows_from_the_shares(case: dict[str, Any], part: str, sentence: str, remedy: str) -> None:
    there = {"is_attended": True, "workers": 4} | case.get("there", {})
    shares = Shares(**{**FULL, **{name: value for name, value in case.items() if name != "there"}})
    said = find_bottleneck(shares, **there)
    assert said.part == part
    assert sentence in said.sentence
    assert remedy in said.remedy
    assert "\n" not in said.sentence


def test_a_cache_that_is_there_is_no_remedy() -> None:
    shares = Shares(**FULL, decode=0.9)
    assert "--cache" in find_bottleneck(shares, is_attended=True, workers=1).remedy
    assert "--cache" not in find_bottleneck(shares, is_attended=True, workers=1, has_cache=True).remedy


def test_the_shares_are_of_the_time_that_was_noted(at: Peers, service: Published) -> None:
    at.join(b"busy")
    at.join(b"idle")
    at.hello(b"waits")
    at.hello(b"does not")
    service.pass_seconds(2.0)
    at.want(0, identity=b"waits")
    for _ in range(8):
        service.pass_seconds(1.0, busy_share=0.5)
        lease = at.leases[b"busy"].popleft()
        result = Result(lease.lease, 0, decode_seconds=0.25, simulate_seconds=0.5, handover_seconds=0.125)
        at.worker_says(b"busy", result, *answer_to(lease))
        at.dispatcher.worker_stalled(b"busy", Stall(queued_seconds=0.5))
        waited = at.dispatcher.sessions.get(b"waits").waited_seconds + 0.5  # type: ignore[union-attr]
        at.consumer_says(b"waits", Want(0, (lease.indices[0] + 1,), waited_seconds=waited))
    shares = service.view().waiting.shares
    assert shares.seconds == pytest.approx(10.0)
    assert shares.consumers == pytest.approx(4.0 / 20.0)
    assert shares.broker == pytest.approx(0.4, abs=0.01)
    assert (shares.decode, shares.simulate, shares.handover) == pytest.approx((0.1, 0.2, 0.05))
    assert shares.idle == pytest.approx((20.0 - 8.0) / 20.0)
    assert (shares.queued, shares.cores) == pytest.approx((0.2, 0.04))


def test_what_was_long_ago_counts_no_more(at: Peers, service: Published) -> None:
    at.join()
    at.hello()
    at.consumer_says(b"c", Want(0, (), waited_seconds=50.0))
    service.pass_seconds(1.0, busy_share=1.0)
    service.pass_seconds(30.0)
    shares = service.view().waiting.shares
    assert (shares.consumers, shares.broker) == (0.0, pytest.approx(0.0))
    assert shares.seconds == pytest.approx(10.0, abs=1.1)


def test_the_time_before_the_first_consumer_does_not_count(at: Peers, service: Published) -> None:
    at.join()
    service.pass_seconds(9.0)
    at.hello()
    at.want(0, 1)
    service.pass_seconds(1.0, busy_share=0.5)
    assert service.view().waiting.part == "start"
    service.pass_seconds(2.0, busy_share=0.5)
    shares = service.view().waiting.shares
    assert shares.seconds == pytest.approx(3.0, abs=0.2)
    assert (shares.idle, shares.broker) == pytest.approx((0.0, 0.5), abs=0.05)


def test_a_consumer_that_comes_again_for_the_next_epoch_was_not_away(at: Peers, service: Published) -> None:
    at.join()
    at.hello(b"c1")
    service.pass_seconds(5.0)
    at.consumer_says(b"c1", Goodbye())
    service.pass_seconds(1.0)
    assert service.view().waiting.part != "no_consumers"
    service.pass_seconds(1.5)
    assert service.view().waiting.part == "no_consumers"
