import pytest
from hypothesis import given
from hypothesis import strategies as st

from v2v_client.session.liveness import Due, Liveness, Patience
from v2v_protocol.errors import UsageError

PATIENCE = Patience(timeout_seconds=60, ping_seconds=2, rewant_seconds=10)


def timeline(until: float, *, pong: bool) -> list[tuple[float, Due]]:
    """What is done in a silence, with a clock that jumps to whatever is due next."""
    liveness, now, done = Liveness(PATIENCE, 0.0), 0.0, []
    while now < until:
        now += liveness.next_due(now)
        due = liveness.due(now)
        assert due is not None, "woken for nothing"
        done.append((now, due))
        if due is Due.GIVE_UP:
            break
        if pong:
            liveness.heard(now, answer=False)
    return done


def test_a_dead_server_is_pinged_then_connected_anew_ever_more_rarely_then_given_up():
    done = timeline(100, pong=False)
    assert done[:5] == [(2, Due.PING), (4, Due.PING), (6, Due.PING), (8, Due.PING), (10, Due.CONNECT_ANEW)]
    assert [now for now, due in done if due is Due.CONNECT_ANEW] == [10, 30]
    assert done[-1] == (60, Due.GIVE_UP)


def test_a_server_that_only_answers_pings_is_asked_again_ever_more_rarely_and_never_given_up():
    done = timeline(200, pong=True)
    assert Due.GIVE_UP not in [due for _, due in done]
    assert [now for now, due in done if due is Due.WANT_AGAIN] == [10, 30, 70, 130, 190]


@pytest.mark.parametrize("timeout_seconds", [0.5, 2.0, 3.0])
def test_nobody_is_given_up_unasked(timeout_seconds):
    """However short the deadline is beside the time between pings: a server that is busy says nothing by itself."""
    liveness = Liveness(Patience(timeout_seconds=timeout_seconds), 0.0)
    now = liveness.next_due(0.0)
    assert now < timeout_seconds
    assert liveness.due(now) is Due.PING


@given(st.floats(0, 1e6), st.floats(0, 50))
def test_time_spent_elsewhere_is_no_silence(away, listened):
    liveness = Liveness(PATIENCE, 0.0)
    liveness.pause(listened)
    liveness.listen(listened + away)
    assert liveness.silence(listened + away) == pytest.approx(listened, abs=1e-6)


def test_a_time_in_which_this_process_was_stopped_is_no_silence():
    liveness = Liveness(PATIENCE, 0.0)
    liveness.woke(1.5, due=1.0)
    assert liveness.silence(1.5) == 1.5
    liveness.woke(1000.0, due=2.0)
    assert liveness.silence(1000.0) == 2.0
    assert liveness.due(1000.0) is Due.PING


@pytest.mark.parametrize("name", ["timeout_seconds", "ping_seconds", "rewant_seconds"])
def test_times_are_positive(name):
    with pytest.raises(UsageError, match=name):
        Patience(**{name: 0.0})
