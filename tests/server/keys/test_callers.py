"""The accounts of addresses: who speaks is never turned away, who does not costs a bounded number of handshakes."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from v2v_server.keys.callers import (
    AWAY_SECONDS,
    KNOWN_SECONDS,
    MOST_AWAY,
    SILENT_AT_ONCE,
    SILENT_PER_SECOND,
    UNKNOWN,
    Callers,
)

HOST, OTHER = b"\x0a\0\0\1", b"\x0a\0\0\2"


def test_a_host_that_connects_and_speaks_may_do_so_for_ever() -> None:
    callers = Callers()
    for _ in range(20 * SILENT_AT_ONCE):
        assert not callers.came(HOST, 0.0)
        callers.spoke(HOST, 0.0)
    callers.look(0.0)
    assert callers.away == ()


def test_all_loader_workers_of_a_host_may_come_at_once() -> None:
    callers = Callers()
    for _ in range(SILENT_AT_ONCE):
        assert not callers.came(HOST, 0.0)
    assert callers.came(HOST, 0.0)
    assert callers.away == (HOST,)


def test_others_are_not_concerned_and_its_time_ends() -> None:
    callers = Callers()
    for _ in range(SILENT_AT_ONCE + 1):
        callers.came(HOST, 0.0)
    assert not callers.came(OTHER, 0.0)
    assert callers.away == (HOST,)
    assert not callers.look(AWAY_SECONDS - 0.1)
    assert callers.look(AWAY_SECONDS)
    assert callers.away == ()


def test_it_is_told_of_once_until_it_is_forgotten() -> None:
    callers = Callers()
    now = 0.0
    for _ in range(5):
        while HOST not in callers.away:
            callers.came(HOST, now)
        now += AWAY_SECONDS
        callers.look(now)
    assert callers.take_news() == [HOST]
    assert callers.take_news() == []
    now += SILENT_AT_ONCE / SILENT_PER_SECOND
    callers.look(now)
    while HOST not in callers.away:
        callers.came(HOST, now)
    assert callers.take_news() == [HOST]


@given(gaps=st.lists(st.floats(0.0, 30.0), max_size=60), burst=st.integers(1, 400))
def test_a_silent_host_gets_in_no_more_often_than_its_account_says(gaps: list[float], burst: int) -> None:
    """The kernel lets in nobody from an address that is away; the connections that come meanwhile never happen."""
    callers = Callers()
    now, let_in = 0.0, 0
    for gap in gaps:
        now += gap
        callers.look(now)
        for _ in range(burst):
            if HOST in callers.away:
                break
            callers.came(HOST, now)
            let_in += 1
        times_away = now / AWAY_SECONDS + 1
        assert let_in <= SILENT_AT_ONCE + SILENT_PER_SECOND * now + times_away


def test_the_kernel_gets_no_endless_list() -> None:
    callers = Callers()
    for number in range(2 * MOST_AWAY):
        for _ in range(SILENT_AT_ONCE + 1):
            callers.came(number.to_bytes(4), float(number) / 1000)
    assert len(callers.away) == MOST_AWAY
    assert callers.away[-1] == (2 * MOST_AWAY - 1).to_bytes(4)


def test_accounts_of_a_million_addresses_are_not_kept() -> None:
    callers = Callers()
    for number in range(20_000):
        callers.came(number.to_bytes(8), 0.0)
    assert len(callers._accounts) <= 4096


def test_who_is_gone_too_soon_costs_strangers_their_turn_and_not_those_who_are_known() -> None:
    callers = Callers()
    callers.spoke(HOST, 0.0)
    while UNKNOWN not in callers.away:
        callers.came(UNKNOWN, 1.0)
    assert callers.known == (HOST,)
    callers.look(1.0 + AWAY_SECONDS)
    assert callers.away == ()
    callers.spoke(UNKNOWN, 1.0 + AWAY_SECONDS)
    callers.spoke(OTHER, 1.0 + AWAY_SECONDS)
    assert callers.known == (HOST, OTHER)
    callers.look(KNOWN_SECONDS + 1.0)
    assert callers.known == (OTHER,)
