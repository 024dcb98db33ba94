"""Liveness: silence is counted from what was heard, pings are spaced as asked, and time away does not count."""

from __future__ import annotations

import math

from v2v_protocol.liveness import Liveness


def test_a_peer_is_asked_again_and_again_and_then_gone() -> None:
    peer = Liveness(100.0, gone_seconds=10.0, ping_seconds=2.0)
    asked = [now for now in range(100, 112) if peer.ping_due(float(now))]
    assert asked == [102, 104, 106, 108, 110]
    assert not peer.is_gone(109.5)
    assert peer.is_gone(110.0)
    peer.mark_heard(111.0)
    assert not peer.is_gone(120.0)
    assert peer.silence(120.0) == 9.0


def test_the_wait_between_two_pings_doubles_up_to_its_limit_and_starts_again_when_heard() -> None:
    peer = Liveness(0.0, ping_seconds=1.0, longest_ping_seconds=4.0)
    assert [now for now in range(16) if peer.ping_due(float(now))] == [1, 3, 7, 11, 15]
    peer.mark_heard(15.5)
    assert peer.next_due(16.0) == 0.5
    assert not peer.is_gone(1e9)


def test_a_peer_without_pings_is_never_due() -> None:
    peer = Liveness(0.0)
    assert not peer.ping_due(1e9)
    assert peer.next_due(1e9) == math.inf
