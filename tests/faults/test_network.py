"""The network between consumer and server breaks; the consumer goes on by itself, with every sample once."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest

from tests.faults.proxy import Proxy, Way
from tests.stream.conftest import SMALL, digest, epoch_of
from v2v_client import ServerLost, V2VStreamDataset
from v2v_client.local_server import LocalServer
from v2v_client.options import Patience

QUICK = Patience(ping_seconds=0.2, rewant_seconds=0.6)
NEVER_BY_THE_CLOCK = Patience(ping_seconds=1000.0, rewant_seconds=1000.0)
"""A client that recovers with this patience noticed the cut itself."""


@pytest.fixture(scope="module")
def undisturbed(server: LocalServer) -> list[str]:
    return [digest(batch) for batch in epoch_of(server.address)]


@pytest.fixture
def proxy(server: LocalServer) -> Iterator[Proxy]:
    with Proxy(server.address) as running:
        yield running


def dataset(
    proxy: Proxy, patience: Patience = QUICK, timeout_seconds: float = 60.0, *, shared_memory: bool = False
) -> V2VStreamDataset:
    """As on another host, unless it shares memory with the workers: then little but headers goes through the proxy."""
    return V2VStreamDataset(
        proxy.address,
        batch_size=3,
        recipe=SMALL,
        seed=3,
        patience=patience,
        timeout_seconds=timeout_seconds,
        shared_memory=shared_memory,
    )


def disturbed(stream: V2VStreamDataset, strike: Callable[[], object]) -> list[str]:
    """Return the digests of an epoch whose network is struck after the first batch."""
    batches = iter(stream)
    first = digest(next(batches))
    strike()
    return [first, *map(digest, batches)]


def test_without_a_fault_the_proxy_changes_nothing(proxy: Proxy, undisturbed: list[str]) -> None:
    assert [digest(batch) for batch in dataset(proxy, NEVER_BY_THE_CLOCK)] == undisturbed
    assert proxy.connections == 2  # the first asks how large a sample is
    assert (proxy.refused, proxy.truncated, proxy.swallowed) == (0, 0, 0)


@pytest.mark.parametrize("shared_memory", [False, True])
def test_cut_after_every_batch(proxy: Proxy, undisturbed: list[str], shared_memory: bool) -> None:
    """With shared memory, what was answered and not heard of is in slots that are never used again."""
    got = []
    for batch in dataset(proxy, NEVER_BY_THE_CLOCK, shared_memory=shared_memory):
        got.append(digest(batch))
        proxy.cut()
    assert got == undisturbed
    assert shared_memory or proxy.connections > 3


def test_cut_and_refused_for_a_while(proxy: Proxy, undisturbed: list[str]) -> None:
    assert (
        disturbed(dataset(proxy, NEVER_BY_THE_CLOCK), lambda: (proxy.refuse(connections=4), proxy.cut())) == undisturbed
    )
    assert proxy.refused == 4


def test_refused_at_the_start(proxy: Proxy, undisturbed: list[str]) -> None:
    proxy.refuse(connections=4)
    assert [digest(batch) for batch in dataset(proxy)] == undisturbed


def test_delay(proxy: Proxy, undisturbed: list[str]) -> None:
    """Slower than anybody's patience: everything is asked for again and again, and still comes once."""
    proxy.delay(0.05)
    patience = Patience(ping_seconds=0.01, rewant_seconds=0.3)
    assert [digest(batch) for batch in dataset(proxy, patience)] == undisturbed


@pytest.mark.parametrize(
    ("way", "after_bytes", "shared_memory"),
    [
        (Way.TO_CLIENT, 10, False),  # in the greeting
        (Way.TO_CLIENT, 700, False),  # in Welcome
        (Way.TO_CLIENT, 20_000, False),  # in a sample's first array
        (Way.TO_CLIENT, 75_001, False),
        (Way.TO_SERVER, 70, False),  # in the greeting
        (Way.TO_SERVER, 300, False),  # in Hello
        (Way.TO_CLIENT, 1500, True),
        (Way.TO_CLIENT, 4000, True),
        (Way.TO_CLIENT, 9000, True),
    ],
)
def test_truncated_at_the_start(
    proxy: Proxy, undisturbed: list[str], way: Way, after_bytes: int, shared_memory: bool
) -> None:
    proxy.truncate(after_bytes, way=way, connections=3)
    assert [digest(batch) for batch in dataset(proxy, shared_memory=shared_memory)] == undisturbed
    assert proxy.truncated == 3


def test_truncated_in_mid_message_again_and_again(proxy: Proxy, undisturbed: list[str]) -> None:
    """No connection lives for two samples (of 31 kB)."""
    stream = dataset(proxy, NEVER_BY_THE_CLOCK)
    assert disturbed(stream, lambda: proxy.truncate(50_000, connections=8)) == undisturbed
    assert proxy.truncated == 8


def test_a_truncated_request(proxy: Proxy, undisturbed: list[str]) -> None:
    stream = dataset(proxy, NEVER_BY_THE_CLOCK)
    assert disturbed(stream, lambda: proxy.truncate(9, way=Way.TO_SERVER, connections=1)) == undisturbed
    assert proxy.truncated == 1


@pytest.mark.parametrize("after_bytes", [0, 45_000])
def test_a_dead_connection_is_left_for_another(proxy: Proxy, undisturbed: list[str], after_bytes: int) -> None:
    """It stays open and swallows everything, and so do the next two."""
    assert disturbed(dataset(proxy), lambda: proxy.blackhole(after_bytes, connections=3)) == undisturbed
    assert proxy.swallowed > 0
    assert proxy.connections >= 2 + 3


def test_a_dataset_that_gave_up_begins_again_after_healing(proxy: Proxy, undisturbed: list[str]) -> None:
    stream = dataset(proxy, timeout_seconds=3.0)
    batches = iter(stream)
    got = [digest(next(batches))]
    state = stream.state_dict()
    proxy.blackhole()
    with pytest.raises(ServerLost):
        list(batches)
    proxy.heal()
    # What the iterator had delivered before it gave up is where the dataset stands.
    again = dataset(proxy)
    again.load_state_dict(state)
    assert got + [digest(batch) for batch in again] == undisturbed
