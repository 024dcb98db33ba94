"""Mix the batches of several datasets, its members, in a fixed order.

In an epoch, member i gives ``shares[i]`` batches of its own epoch of that number: as many as the weights allow before a
member is used up. Batch j of them is due at the time (j + u) / shares[i], where u is a random number of (seed, epoch,
i, j), and the batches come in the order of their times. So after any number of batches each member has given its share,
give or take a few, and a position in the epoch needs no history.

To :mod:`v2v_client.position` a mixture is one stream of its samples. Its :class:`StreamIdentity` holds those of the
members, and what the order depends on.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from v2v_client.batch import Batch
from v2v_client.dataset import V2VStreamDataset
from v2v_client.passes import Iteration, Position
from v2v_client.position import Consumer, EpochPlan, ResumeState, StreamIdentity
from v2v_protocol.errors import ProtocolError, StateMismatch, UsageError
from v2v_protocol.sample import LARGEST_SEED
from v2v_protocol.settings import format_value, plain, require_whole

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


class Mixture(V2VStreamDataset):
    """Stream the batches of several datasets; see :meth:`V2VStreamDataset.mix`.

    Attributes:
        members: the datasets; closing the mixture closes them. Iterate only the mixture.

    Raises:
        UsageError: the weights are not shares, or the datasets do not fit together.
    """

    def __init__(self, weights: Mapping[V2VStreamDataset, float | Sequence[float]], seed: int) -> None:
        if not isinstance(weights, Mapping):
            raise UsageError(
                f"mix: {format_value(weights)}: give a dict of datasets with their weights, "
                "V2VStreamDataset.mix({first: 0.7, second: 0.3})"
            )
        for each in weights:
            if not isinstance(each, V2VStreamDataset) or isinstance(each, Mixture):
                hint = (
                    f"V2VStreamDataset({each!r}, ...)"
                    if isinstance(each, str)
                    else "a V2VStreamDataset that is no mixture"
                )
                raise UsageError(f"mix: {format_value(each)} is no dataset to mix: give {hint}")
        self.members = members = tuple(weights)
        given: list[list[Any]] = [
            ([*each] or [None]) if isinstance(each, list | tuple) else [each] for each in map(plain, weights.values())
        ]
        epochs = range(max(map(len, given), default=1))
        self._weights = [[each[min(epoch, len(each) - 1)] for each in given] for epoch in epochs]
        for epoch, row in enumerate(self._weights):
            are_shares = all(
                isinstance(weight, int | float) and not isinstance(weight, bool) and 0 <= weight <= 1 for weight in row
            )
            if not are_shares or abs(sum(row) - 1) > _ROUNDING:
                raise UsageError(
                    f"mix: weights {format_value(row)} in epoch {epoch}: give shares from 0 to 1 that sum to 1"
                )
        for number, member in enumerate(members):
            if any(member._samples() == other._samples() for other in members[:number]):
                raise UsageError(
                    f"mix: {member!r} is a member twice, so its samples would come twice: give one weight, or "
                    "another seed, recipe or address"
                )
        for name in ("arrays", "batch_size", "rank", "world_size"):
            values = [member._settings()[name] for member in members]
            if any(value != values[0] for value in values):
                raise UsageError(f"mix: the datasets have {name} = {', '.join(map(str, values))}; give all the same")
        self._seed = require_whole("seed", seed, 0, LARGEST_SEED)
        self._explicit, self._ambient = members[0]._explicit, members[0]._ambient
        self._position = Position(seed, members[0].epoch)
        self._offered, self._is_closed = None, False
        self._stop_server = lambda: [member.close() for member in members]  # type: ignore[func-returns-value]  # self would stay

    def _settings(self) -> dict[str, Any]:
        settings = [member._settings() for member in self.members]
        address = " + ".join(each["address"] for each in settings)
        return settings[0] | {"address": address, "seed": self._seed, "weights": self._weights}

    @property
    def _consumer(self) -> MixtureConsumer:
        batch_size = self.members[0]._consumer.batch_size
        return MixtureConsumer(batch_size, self.rank, self.world_size, self._seed, self._weights)

    def _ask_stream(self, start: ResumeState) -> StreamIdentity:
        return self._identity([member._ask_stream(start) for member in self.members])

    def _identity(self, members: Sequence[StreamIdentity]) -> StreamIdentity:
        order = {"seed": self._seed, "weights": self._weights, "samples": self.world_size * self._consumer.batch_size}
        spec = {"mixture": order, "members": [each.to_dict() for each in members]}
        names = ("spec_digest", "catalogue_digest", "sidecars")
        digests, catalogues, sidecars = (", ".join(getattr(each, name) for each in members) for name in names)
        versions, sequences = zip(*((each.numerics_version, each.sequences) for each in members), strict=True)
        return StreamIdentity(spec, digests, catalogues, max(versions), sum(sequences), sidecars)

    def _check(self, state: ResumeState, stream: StreamIdentity) -> StreamIdentity:
        """Return the stream of a state, if it is of these datasets. In a new epoch their order may be another."""
        members = stream.spec.get("members")
        try:
            streams = [
                StreamIdentity.from_dict(each) for each in (members if isinstance(members, list | tuple) else [])
            ]
        except ProtocolError as error:
            raise StateMismatch(f"the state is not one of mixed datasets: {error}") from error
        ours, theirs = self._identity(streams or [stream]).spec["mixture"], stream.spec.get("mixture")
        is_new = state.is_beginning and not (state.share and state.share.batches)
        if len(streams) != len(self.members) or (ours != theirs and not is_new):
            raise StateMismatch(
                f"the state is of {len(streams)} mixed datasets with {theirs}, this mixture of {len(self.members)} "
                f"with {ours}; give the same (in a new epoch, weights and samples may differ)"
            )
        for member, each in zip(self.members, streams, strict=True):
            member._check(state, each)
        return self._identity(streams)

    @contextmanager
    def _opened(self, begun: Iteration) -> Iterator[tuple[Any, Iteration, EpochPlan]]:
        pinned = begun.state.stream
        streams = (
            [None] * len(self.members) if pinned is None else map(StreamIdentity.from_dict, pinned.spec["members"])
        )
        with ExitStack() as stack:
            connections = []
            for member, stream, snapshot in zip(self.members, streams, self._snapshots(begun.state), strict=True):
                start = dataclasses.replace(begun.state, stream=stream, quarantine=snapshot)
                connections.append(stack.enter_context(member._connected(start, begun.workers)))
            forms = {each.address: each.conversation.layout for each in connections}
            if any(each.conversation.layout != connections[0].conversation.layout for each in connections):
                raise UsageError(f"mix: samples differ in form, {forms}: give recipes of one size, and one voxel_dtype")
            stream = self._identity([each.conversation.stream for each in connections])
            begun = self._position.pin(begun, stream, "this mixture")
            consumer, needed = self._consumer, self.world_size * self.members[0]._consumer.batch_size
            for each, weight in zip(connections, consumer.shares(begun.state.epoch), strict=True):
                if weight and each.conversation.stream.sequences < needed:
                    raise UsageError(
                        f"mix: {each.address} gives {each.conversation.stream.sequences} sequences, and a batch of all "
                        f"ranks needs {needed}: use a smaller batch_size, fewer ranks or more videos"
                    )
            yield connections, begun, consumer.plan(stream, begun.state)

    def _snapshots(self, state: ResumeState) -> list[int | None]:
        return [*state.quarantine] if isinstance(state.quarantine, list | tuple) else [None] * len(self.members)

    def _take(self, connections: Any, begun: Iteration, plan: EpochPlan, batches: Sequence[int]) -> Iterator[Batch]:
        consumer, state, snapshots = self._consumer, begun.state, self._snapshots(begun.state)
        order = consumer.order(state.stream, state.epoch)  # type: ignore[arg-type]  # it was pinned
        places = plan.position // plan.batch_size + np.array(batches, np.int64)
        taken = [
            member._take(
                connection,
                begun,
                member._consumer.plan(connection.conversation.stream, state.at_epoch(state.epoch)),
                np.flatnonzero(np.isin(np.flatnonzero(order == number), places)).tolist(),
            )
            for number, (member, connection) in enumerate(zip(self.members, connections, strict=True))
        ]
        for batch_number, number in zip(batches, order[places].tolist(), strict=True):
            batch = next(taken[number])
            snapshots[number] = batch.resume_state["quarantine"]
            after = consumer.after(state, plan, batch_number, tuple(snapshots))
            yield dataclasses.replace(batch, resume_state=after.to_dict())
