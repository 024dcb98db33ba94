"""Test several brokers: which consumer uses which, and what happens if one is lost or serves another stream."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Iterator
from contextlib import closing

import pytest

from tests.client.fake_server import SPEC, FakeServer
from v2v_client import V2VStreamDataset
from v2v_client.connection import Connection, addresses, order
from v2v_client.options import Patience
from v2v_protocol.errors import ServerLost, StateMismatch, UsageError
from v2v_protocol.messages import Hello
from v2v_protocol.sample import DEFAULT_ARRAYS

QUICK = Patience(timeout_seconds=2.0, ping_seconds=0.05, takeover_seconds=0.3)
UNUSED_ADDRESS = "tcp://127.0.0.1:9"


@pytest.fixture
def servers() -> Iterator[tuple[FakeServer, FakeServer]]:
    with FakeServer(sequences=24, credit=4) as one, FakeServer(sequences=24, credit=6) as other:
        yield one, other


def dataset(brokers: object, **options: object) -> V2VStreamDataset:
    options = {"rank": 0, "world_size": 1, "timeout_seconds": 2.0, "patience": QUICK} | options
    return V2VStreamDataset(brokers, 4, DEFAULT_ARRAYS, seed=5, **options)  # type: ignore[arg-type]


# --- the rule ---------------------------------------------------------------------------------------------------------


def test_neighbouring_consumers_share_a_broker_and_hosts_use_their_own() -> None:
    homes = [order("abcd", rank, 32)[0] for rank in range(32)]
    assert homes == [name for name in "abcd" for _ in range(8)]


@pytest.mark.parametrize("brokers", range(1, 9))
@pytest.mark.parametrize("consumers", [1, 2, 3, 7, 8, 24])
def test_consumers_are_spread_evenly_even_after_a_broker_is_lost(brokers: int, consumers: int) -> None:
    names = "abcdefgh"[:brokers]
    orders = [order(names, consumer, consumers) for consumer in range(consumers)]
    assert all(sorted(each) == list(names) for each in orders)  # every broker comes once
    loads = Counter(each[0] for each in orders)
    assert max(loads.values()) - min(loads[name] for name in names) <= 1
    for lost in names if brokers > 1 else "":
        stand_ins = Counter(each[1] for each in orders if each[0] == lost)
        assert max(stand_ins.values(), default=0) <= -(-loads[lost] // (brokers - 1))


@pytest.mark.parametrize("given", ["tcp://a:1, tcp://b:2", ["tcp://a:1", "tcp://b:2"]])
def test_addresses_are_a_list_or_comma_separated(given: object) -> None:
    assert addresses(given) == ("tcp://a:1", "tcp://b:2")  # type: ignore[arg-type]


@pytest.mark.parametrize("given", ["", [], "tcp://a:1,", ["tcp://a:1", "tcp://a:1"]])
def test_no_address_or_a_repeated_one_is_refused(given: object) -> None:
    with pytest.raises(UsageError, match="address"):
        addresses(given)  # type: ignore[arg-type]


# --- what it is for ---------------------------------------------------------------------------------------------------


def test_after_a_broker_falls_silent_every_sample_still_comes_once(
    servers: tuple[FakeServer, FakeServer],
) -> None:
    one, other = servers
    stream = dataset([one.address, other.address])
    whole = [batch.indices for batch in dataset(other.address)]
    asked_before = len(other.wants)
    indices, silenced = [], False
    for batch in stream:
        indices.append(batch.indices)
        if not silenced:
            assert len(other.wants) == asked_before, "only compared until then"
            one.call(lambda: setattr(one, "mute", True))
            silenced = True
    assert indices == whole
    assert len(other.wants) > asked_before


def test_a_broker_that_never_answers_is_skipped(servers: tuple[FakeServer, FakeServer]) -> None:
    assert len(list(dataset([UNUSED_ADDRESS, servers[0].address]))) == 6


def test_brokers_of_different_videos_are_refused_with_both_named(servers: tuple[FakeServer, FakeServer]) -> None:
    one, other = servers
    other.catalogue = "catalogue-2"
    for rank in (0, 1):
        with pytest.raises(StateMismatch, match="catalogue") as refused:
            next(iter(dataset([one.address, other.address], rank=rank, world_size=2)))
        assert one.address in str(refused.value)
        assert other.address in str(refused.value)


def test_a_broker_that_takes_over_with_other_videos_is_refused(
    servers: tuple[FakeServer, FakeServer],
) -> None:
    """The broker may have been restarted on another folder since the comparison."""
    one, other = servers
    batches = iter(dataset([one.address, other.address]))
    next(batches)
    other.call(lambda: setattr(other, "catalogue", "catalogue-2"))
    one.call(lambda: setattr(one, "mute", True))
    with pytest.raises(StateMismatch, match="catalogue") as refused:
        list(batches)
    assert one.address in str(refused.value)
    assert other.address in str(refused.value)


def test_the_server_is_lost_once_each_broker_had_its_turn() -> None:
    with pytest.raises(ServerLost, match=r"^tcp.*no sample for") as lost:
        next(iter(dataset(["tcp://127.0.0.1:9", "tcp://127.0.0.1:11"], patience=QUICK, timeout_seconds=0.5)))
    assert "127.0.0.1:9, tcp://127.0.0.1:11" in str(lost.value)


def test_a_broker_without_workers_is_replaced_by_the_next(servers: tuple[FakeServer, FakeServer]) -> None:
    one, other = servers
    one.held, one.trouble = True, "no worker is connected"
    patience = dataclasses.replace(QUICK, timeout_seconds=0.4)
    hello = Hello(SPEC.to_dict(), DEFAULT_ARRAYS, 4, 5)
    with closing(Connection([one.address, other.address], hello, 0, patience=patience)) as connection:
        connection.open()
        connection.want([0])
        arrival = connection.receive()
        assert arrival is not None
        assert arrival.header.index == 0
        assert connection.address == other.address
