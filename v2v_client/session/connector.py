"""Create a dataset's connections: to which broker, and with which Hello."""

from __future__ import annotations

import dataclasses
import functools
import logging
import platform
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass

from v2v_client.options import Options
from v2v_client.position.state import ResumeState
from v2v_client.session.brokers import order
from v2v_client.session.connection import Connection
from v2v_client.session.liveness import Patience
from v2v_protocol.errors import ServerLost
from v2v_protocol.link.dealer import Dealer
from v2v_protocol.messages import Hello

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class ConsumerId:
    """Hold which of a stream's consumers a process is.

    Attributes:
        rank, world_size: number of the rank, and of ranks.
        worker: number of the loader worker; None outside of one.
        workers: number of loader workers of each rank; 1 without any.
    """

    rank: int
    world_size: int
    worker: int | None = None
    workers: int = 1

    @property
    def name(self) -> str:
        """Return the name that status displays show."""
        of_loader = "" if self.worker is None else f", loader worker {self.worker} of {self.workers}"
        return f"rank {self.rank} of {self.world_size}{of_loader}"


@dataclass(frozen=True, slots=True)
class Connector:
    """Hold what all connections of a dataset have in common.

    Attributes:
        brokers: addresses of the servers.
        options: the requested stream.
        arrays, batch_size, seed, compress, keys, patience: see :class:`v2v_client.dataset.V2VStreamDataset`.
    """

    brokers: tuple[str, ...]
    options: Options
    arrays: tuple[str, ...]
    batch_size: int
    seed: int
    compress: bool
    keys: str | None
    patience: Patience

    def connection(
        self,
        member: ConsumerId,
        state: ResumeState,
        *,
        brokers: Sequence[str] | None = None,
        patience: Patience | None = None,
    ) -> Connection:
        """Return a connection that is not open yet.

        Args:
            member: the consumer that it is for.
            state: where the consumer starts; its stream is pinned.
            brokers: None tries all, in the order of this consumer.
            patience: None uses that of the dataset.

        Raises:
            StateMismatch: the options contradict the pinned stream.
        """
        consumer, consumers = member.rank * member.workers + (member.worker or 0), member.world_size * member.workers
        hello = Hello(
            self.options.spec(state.stream, "this dataset's stream"),
            self.arrays,
            self.batch_size,
            self.seed,
            quarantine=state.quarantine,
            stride=self.batch_size * consumers,
            name=member.name,
            host=platform.node(),
            packed=self.compress,
        )
        return Connection(
            brokers or order(self.brokers, consumer, consumers),
            hello,
            state.epoch,
            pinned=state.stream,
            pinned_by="this dataset" if state.is_beginning else "the saved state",
            patience=patience or self.patience,
            transport=functools.partial(Dealer, keys=self.keys),
        )

    def compare(self, connection: Connection, member: ConsumerId, state: ResumeState) -> None:
        """Compare an open connection with the first other broker that answers, which is the same for nearly all ranks.

        Raises:
            StateMismatch: the two brokers offer different streams.
        """
        patience = dataclasses.replace(self.patience, timeout_seconds=self.patience.takeover_seconds)
        for broker in self.brokers if len(self.brokers) > 1 else ():
            if broker == connection.address:
                continue
            try:
                with closing(self.connection(member, state, brokers=(broker,), patience=patience)) as other:
                    other.open()
                    connection.stream.require_same(other.stream, ours=connection.address, theirs=broker)
            except ServerLost as lost:
                _log.warning("cannot compare %s with %s before it takes over: %s", connection.address, broker, lost)
                continue
            return
