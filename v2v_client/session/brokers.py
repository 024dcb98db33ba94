"""Choose which of several brokers a consumer uses, and in which order it tries the others. Pure.

All brokers make the same samples, so the choice only distributes load. Consumers (the loader workers of all ranks, in
the order of the ranks) are assigned to the list in contiguous blocks. If the launcher numbers ranks host by host, and
the list has one broker per host in the same order, every host uses its own broker. The consumers of a lost broker are
spread over all others.
"""

from __future__ import annotations

from collections.abc import Sequence

from v2v_protocol.errors import UsageError


def addresses(given: str | Sequence[str]) -> tuple[str, ...]:
    """Return the addresses of a list or of a comma-separated text.

    Raises:
        UsageError: there is no address, or one occurs twice.
    """
    texts = given.split(",") if isinstance(given, str) else given
    found = tuple(text.strip() for text in texts)
    if not found or not all(found):
        raise UsageError(f"address {given!r}: give tcp://host:port, or several of them")
    if len(set(found)) < len(found):
        raise UsageError(f"address {given!r}: a broker occurs twice; give each once")
    return found


def order(brokers: Sequence[str], consumer: int, consumers: int) -> tuple[str, ...]:
    """Return all brokers, in the order in which a consumer tries them.

    Args:
        brokers: their addresses, the same list for every consumer.
        consumer: the consumer's number, 0 <= consumer < consumers.
        consumers: number of consumers.
    """
    home = consumer * len(brokers) // consumers
    others = [*brokers[home + 1 :], *brokers[:home]]
    first = consumer % len(others) if others else 0
    return (brokers[home], *others[first:], *others[:first])
