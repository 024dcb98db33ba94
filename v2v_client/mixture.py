"""Order the batches of several datasets, the members of a :class:`v2v_client.dataset.Mixture`. Pure.

In an epoch, member i gives ``shares[i]`` batches of its own epoch of that number: as many as the weights allow before a
member is used up. Batch j of them is due at the time (j + u) / shares[i], where u is a random number of (seed, epoch,
i, j), and the batches come in the order of their times. So after any number of batches each member has given its share,
give or take a few, and a position in the epoch needs no history.

To :mod:`v2v_client.position` a mixture is one stream of its samples. Its :class:`StreamIdentity` holds those of the
members, and what the order depends on.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from v2v_client.position import Consumer, EpochPlan, ResumeState, StreamIdentity
from v2v_protocol.errors import ProtocolError, StateMismatch, UsageError
from v2v_protocol.settings import format_value, plain

_ROUNDING = 1e-6
"""Deviation from 1 that a sum of rounded weights may have."""


@dataclass(frozen=True, slots=True)
class MixtureConsumer(Consumer):
    """Convert between a rank's states of a mixture and its batches.

    Attributes:
        seed: of the order.
        weights: of each member, in epochs 0, 1, 2 ...; the last ones stay.
    """

    seed: int
    weights: list[list[float]]

    def shares(self, epoch: int) -> list[float]:
        """Return the weights of an epoch."""
        return self.weights[min(epoch, len(self.weights) - 1)]

    def order(self, stream: StreamIdentity, epoch: int) -> npt.NDArray[np.int64]:
        """Return the number of the member that each batch of an epoch comes from, [batches]."""
        weights = self.shares(epoch)
        own = [each["sequences"] // (self.world_size * self.batch_size) for each in stream.spec["members"]]
        scale = min(batches / weight for batches, weight in zip(own, weights, strict=True) if weight)
        times = []
        for member, (batches, weight) in enumerate(zip(own, weights, strict=True)):
            share = min(batches, max(int(scale > 0), round(scale * weight))) if weight else 0
            words = np.random.Philox(key=self.seed, counter=epoch << 192 | member << 128).random_raw(share)
            times.append((np.arange(share) + (words >> np.uint64(11)) * 2.0**-53) / max(share, 1))
        members = np.repeat(np.arange(len(times)), [len(each) for each in times])
        return members[np.argsort(np.concatenate(times), kind="stable")]

    def plan(self, stream: StreamIdentity, state: ResumeState) -> EpochPlan:
        """See :meth:`Consumer.plan`."""
        samples = len(self.order(stream, state.epoch)) * self.world_size * self.batch_size
        return EpochPlan(samples, self.world_size, self.rank, self.batch_size, state.origin, state.position)

    def identity(self, members: Sequence[StreamIdentity]) -> StreamIdentity:
        """Return the stream of a mixture of the members' streams."""
        order = {"seed": self.seed, "weights": self.weights, "samples": self.world_size * self.batch_size}
        spec = {"mixture": order, "members": [each.to_dict() for each in members]}
        names = ("spec_digest", "catalogue_digest", "sidecars")
        digests, catalogues, sidecars = (", ".join(getattr(each, name) for each in members) for name in names)
        versions, sequences = zip(*((each.numerics_version, each.sequences) for each in members), strict=True)
        return StreamIdentity(spec, digests, catalogues, max(versions), sum(sequences), sidecars)

    def members_of(self, state: ResumeState, stream: StreamIdentity, count: int) -> list[StreamIdentity]:
        """Return the streams of the members that a state is of.

        Args:
            stream: that of the state. In a new epoch the order may be another.
            count: number of members.

        Raises:
            StateMismatch: the state is of no mixture, or of another one.
        """
        members = stream.spec.get("members")
        try:
            streams = [
                StreamIdentity.from_dict(each) for each in (members if isinstance(members, list | tuple) else [])
            ]
        except ProtocolError as error:
            raise StateMismatch(f"the state is not one of mixed datasets: {error}") from error
        ours, theirs = self.identity(streams or [stream]).spec["mixture"], stream.spec.get("mixture")
        is_new = state.is_beginning and not (state.share and state.share.batches)
        if len(streams) != count or (ours != theirs and not is_new):
            raise StateMismatch(
                f"the state is of {len(streams)} mixed datasets with {theirs}, this mixture of {count} "
                f"with {ours}; give the same (in a new epoch, weights and samples may differ)"
            )
        return streams


def read_weights(weights: Iterable[Any]) -> list[list[float]]:
    """Return the weights of each member in epochs 0, 1, 2 ..., from a share or a list of shares for each member.

    Raises:
        UsageError: those of an epoch are not shares.
    """
    given: list[list[Any]] = [
        ([*each] or [None]) if isinstance(each, list | tuple) else [each] for each in map(plain, weights)
    ]
    epochs = range(max(map(len, given), default=1))
    rows = [[each[min(epoch, len(each) - 1)] for each in given] for epoch in epochs]
    for epoch, row in enumerate(rows):
        are_shares = all(
            isinstance(weight, int | float) and not isinstance(weight, bool) and 0 <= weight <= 1 for weight in row
        )
        if not are_shares or abs(sum(row) - 1) > _ROUNDING:
            raise UsageError(
                f"mix: weights {format_value(row)} in epoch {epoch}: give shares from 0 to 1 that sum to 1"
            )
    return rows
