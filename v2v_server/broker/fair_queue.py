"""Share worker time between consumers by deficit round robin, at logarithmic cost for each request. No I/O.

Deficit round robin: Shreedhar and Varghese, "Efficient fair queuing using deficit round robin", SIGCOMM 1995. The cost
of a sample is known only once it is made, so a consumer pays afterwards. Consumers that wait are served in turn while
their balance is not negative. If all of them are in debt, each earns the same number of quanta, so that the smallest
debt is paid. A consumer whose samples take ten times the work therefore gets a tenth of the samples, not ten times the
time.

    waiting, balance >= 0     heap by turn: the consumer that was served longest ago comes first
    waiting, balance < 0      heap by the earnings that pay the debt: ``earned`` of the queue minus the balance
    not waiting               in no heap; earns nothing

Quanta are not added to every balance: the queue counts what each waiting debtor has earned. Balances are whole
nanoseconds, so that this sum is exact. Heap entries that no longer hold are skipped when they reach the top, and
removed when they outnumber the consumers.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import count
from typing import TypeAlias

_SECOND_NS = 1_000_000_000
_QUANTUM_NS = _SECOND_NS // 20
_MOST_DEBTS = 4096
"""Number of debts remembered for absent consumers; the oldest is dropped first."""
_MOST_STALE = 64
"""Entries that a heap may hold, besides two for each consumer, before it is rebuilt."""

_Place: TypeAlias = tuple[bool, int]  # (whether in debt, key in the heap of such consumers)


@dataclass(slots=True)
class _Balance:
    turn: int
    balance_ns: int = 0  # without what a waiting debtor has earned
    place: _Place | None = None  # None: does not wait


class FairQueue:
    """Order in which waiting consumers are served."""

    def __init__(self) -> None:
        self._accounts: dict[bytes, _Balance] = {}
        self._debts_ns: dict[bytes, int] = {}  # of absent consumers
        self._turns = count()
        self._earned_ns = 0
        self._heaps: tuple[list[tuple[int, bytes]], list[tuple[int, bytes]]] = [], []  # solvent, in debt

    def add(self, identity: bytes, debtors: Iterable[bytes] = ()) -> None:
        """Add a consumer, which does not wait yet.

        Args:
            identity: the consumer.
            debtors: absent consumers whose debts it takes over.
        """
        debt_ns = sum(self._debts_ns.pop(each, 0) for each in debtors)
        self._accounts[identity] = _Balance(next(self._turns), -debt_ns)

    def remove(self, identity: bytes) -> None:
        """Remove a consumer; its debt is remembered."""
        balance_ns = self._balance_ns(self._accounts.pop(identity))
        if balance_ns < 0:
            self._remember(identity, -balance_ns)

    def charge(self, identity: bytes, seconds: float) -> None:
        """Charge worker time to a consumer, whether it is present or not."""
        cost_ns = round(seconds * _SECOND_NS)
        account = self._accounts.get(identity)
        if account is None:
            self._remember(identity, cost_ns)
        else:
            self._settle(identity, account, self._balance_ns(account) - cost_ns, waits=account.place is not None)

    def balance_seconds(self, identity: bytes) -> float:
        """Return what a consumer has earned and not used; negative: its debt."""
        return self._balance_ns(self._accounts[identity]) / _SECOND_NS

    def drop_savings(self, identity: bytes) -> None:
        """Drop what an idle consumer has earned and not used.

        A debt stays; otherwise asking for one sample at a time would be free. The debt is at most the cost of the
        samples that were in work at the same time.
        """
        account = self._accounts[identity]
        account.balance_ns = min(account.balance_ns, 0)

    def set_waiting(self, identity: bytes, *, waits: bool) -> None:
        """Note whether a consumer waits for a worker."""
        account = self._accounts[identity]
        if waits != (account.place is not None):
            self._settle(identity, account, self._balance_ns(account), waits=waits)

    def next(self) -> bytes | None:
        """Return the consumer to serve, and put its next turn behind those of all others; None if none waits."""
        if (identity := self._first(in_debt=False)) is None:
            if self._first(in_debt=True) is None:
                return None
            self._pay_smallest_debt()
            return self.next()
        account = self._accounts[identity]
        account.turn = next(self._turns)
        self._settle(identity, account, account.balance_ns, waits=True)
        return identity

    def _pay_smallest_debt(self) -> None:
        debt_ns = self._heaps[True][0][0] - self._earned_ns
        self._earned_ns += (debt_ns // _QUANTUM_NS + 1) * _QUANTUM_NS
        while (debtor := self._first(in_debt=True)) is not None and self._heaps[True][0][0] <= self._earned_ns:
            account = self._accounts[debtor]
            self._settle(debtor, account, self._balance_ns(account), waits=True)

    def _balance_ns(self, account: _Balance) -> int:
        in_debt, key = account.place or (False, 0)
        return self._earned_ns - key if in_debt else account.balance_ns

    def _settle(self, identity: bytes, account: _Balance, balance_ns: int, *, waits: bool) -> None:
        """Set a balance, and move the consumer to the heap where it belongs."""
        account.balance_ns = balance_ns
        in_debt = balance_ns < 0
        place = (in_debt, self._earned_ns - balance_ns if in_debt else account.turn) if waits else None
        if place == account.place:
            return
        account.place = place
        if place is None:
            return
        heap = self._heaps[in_debt]
        heapq.heappush(heap, (place[1], identity))
        if len(heap) > 2 * len(self._accounts) + _MOST_STALE:
            heap[:] = {entry for entry in heap if self._holds(entry, in_debt=in_debt)}
            heapq.heapify(heap)

    def _first(self, *, in_debt: bool) -> bytes | None:
        """Return the consumer at the top of a heap; None if the heap is empty."""
        heap = self._heaps[in_debt]
        while heap and not self._holds(heap[0], in_debt=in_debt):
            heapq.heappop(heap)
        return heap[0][1] if heap else None

    def _holds(self, entry: tuple[int, bytes], *, in_debt: bool) -> bool:
        account = self._accounts.get(entry[1])
        return account is not None and account.place == (in_debt, entry[0])

    def _remember(self, identity: bytes, debt_ns: int) -> None:
        self._debts_ns[identity] = self._debts_ns.pop(identity, 0) + debt_ns
        if len(self._debts_ns) > _MOST_DEBTS:
            del self._debts_ns[next(iter(self._debts_ns))]
