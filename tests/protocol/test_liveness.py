"""Liveness: silence is counted from what was heard, pings are spaced as asked, and time away does not count."""

from __future__ import annotations

import math

from hypothesis import given
from hypothesis import strategies as st

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


def test_a_peer_nobody_asks_is_never_due() -> None:
    peer = Liveness(0.0)
    assert not peer.ping_due(1e9)
    assert peer.next_due(1e9) == math.inf


@given(away=st.floats(0.0, 1e6), silent=st.floats(0.0, 30.0))
def test_time_in_which_nobody_listened_does_not_count(away: float, silent: float) -> None:
    peer = Liveness(0.0, gone_seconds=20.0, ping_seconds=5.0)
    peer.leave_out(away)
    now = away + silent
    assert abs(peer.silence(now) - silent) < 1e-6
    assert peer.next_due(now) <= max(0.0, 5.0 - silent) + 1e-6
