"""How many connections each address may open without saying anything. Pure: time is an argument.

A connection costs the server most before it has said anything: the arithmetic of a handshake, half a millisecond of
processor time, is done before anyone knows whether its key is good. So each address has an account. A new connection
takes one from it and gives it back with its first message; what is not given back comes again with time. An address
whose account is empty is turned away for a while. What it has open stays.
"""

from __future__ import annotations

from dataclasses import dataclass

SILENT_AT_ONCE = 256
"""Above what one host connects at a time: all loader workers of all its ranks."""
SILENT_PER_SECOND = 8.0
AWAY_SECONDS = 10.0
MOST_AWAY = 256
"""Addresses that are turned away at a time; the kernel looks through them at every newcomer."""
UNKNOWN = b""
"""Stands for the address of a connection that was gone too soon."""
KNOWN_SECONDS = 3600.0
MOST_KNOWN = 256
_MOST_ACCOUNTS = 4096


@dataclass(slots=True)
class _Account:
    left: float
    counted_at: float
    away_until: float = 0.0
    is_told: bool = False


class Callers:
    """The accounts of all addresses.

    Attributes:
        away: addresses that are turned away now; :data:`UNKNOWN` among them stands for all that are not known.
    """

    def __init__(self) -> None:
        self.away: tuple[bytes, ...] = ()
        self._accounts: dict[bytes, _Account] = {}
        self._news: list[bytes] = []
        self._known: dict[bytes, float] = {}  # when each spoke, the latest last

    @property
    def known(self) -> tuple[bytes, ...]:
        """Addresses that have spoken within the hour."""
        return tuple(self._known)[-MOST_KNOWN:]

    def came(self, address: bytes, now: float) -> bool:
        """A connection was opened.

        Returns:
            whether :attr:`away` has changed.
        """
        account = self._accounts.get(address)
        if account is None:
            if len(self._accounts) >= _MOST_ACCOUNTS:
                del self._accounts[next(iter(self._accounts))]
            account = self._accounts[address] = _Account(SILENT_AT_ONCE, now)
        _refill(account, now)
        account.left -= 1
        if account.left >= 0 or account.away_until > now:
            return False
        account.left, account.away_until = 0.0, now + AWAY_SECONDS
        if not account.is_told:
            account.is_told = True
            self._news.append(address)
        return self._changed(now)

    def spoke(self, address: bytes, now: float) -> None:
        """A connection has said its first message."""
        if address != UNKNOWN:
            self._known.pop(address, None)
            self._known[address] = now
            if len(self._known) > _MOST_ACCOUNTS:
                del self._known[next(iter(self._known))]
        account = self._accounts.get(address)
        if account is not None:
            account.left = min(account.left + 1, SILENT_AT_ONCE)

    def look(self, now: float) -> bool:
        """Forgets who has a full account, and lets in again whose time is over. To be called now and then.

        Returns:
            whether :attr:`away` has changed.
        """
        while self._known and now - self._known[oldest := next(iter(self._known))] > KNOWN_SECONDS:
            del self._known[oldest]
        for address, account in list(self._accounts.items()):
            _refill(account, now)
            if account.left >= SILENT_AT_ONCE and account.away_until <= now:
                del self._accounts[address]
        return self._changed(now)

    def take_news(self) -> list[bytes]:
        """Addresses that were turned away for the first time since they were last forgotten."""
        news, self._news = self._news, []
        return news

    def _changed(self, now: float) -> bool:
        before = self.away
        away = [address for address, account in self._accounts.items() if account.away_until > now]
        self.away = tuple(away[-MOST_AWAY:])
        return self.away != before


def _refill(account: _Account, now: float) -> None:
    account.left = min(account.left + (now - account.counted_at) * SILENT_PER_SECOND, SILENT_AT_ONCE)
    account.counted_at = now
