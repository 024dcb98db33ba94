"""Which of several brokers a consumer takes from, and whose turn it is when that one is lost. Pure.

All of them make the same samples, so the choice moves load and nothing else. Consumers (the loader workers of all
ranks, in the order of the ranks) are dealt to the list in blocks of neighbours: where launchers number the ranks host
by host, and the list has a broker for each host in that order, every host takes from its own. The consumers of a lost
broker are spread over all others.
"""

from __future__ import annotations

from collections.abc import Sequence

from v2v_protocol.errors import UsageError


def addresses(given: str | Sequence[str]) -> tuple[str, ...]:
    """The addresses in a list, or in a text with commas between them.

    Raises:
        UsageError: there is none, or one comes twice.
    """
    texts = given.split(",") if isinstance(given, str) else given
    found = tuple(text.strip() for text in texts)
    if not found or not all(found):
        raise UsageError(f"address {given!r}: give tcp://host:port, or several of them")
    if len(set(found)) < len(found):
        raise UsageError(f"address {given!r}: the same broker twice")
    return found


def order(brokers: Sequence[str], consumer: int, consumers: int) -> tuple[str, ...]:
    """All brokers, in the order in which a consumer turns to them.

    Args:
        brokers: their addresses, the same list for every consumer.
        consumer: its number, 0 <= consumer < consumers.
        consumers: how many there are.
    """
    home = consumer * len(brokers) // consumers
    others = [*brokers[home + 1 :], *brokers[:home]]
    first = consumer % len(others) if others else 0
    return (brokers[home], *others[first:], *others[:first])
