"""Define where a consumer stands: the state that it saves, and which samples come after it. Pure.

A state is a plain dict, so a trainer's checkpoint can hold it. It pins everything that determines a sample's bytes; a
server of another stream is refused before the first batch.

Which samples a rank and a loader worker take of an epoch:

    global index of rank r of W at local position p  =  origin + p W + r
    batch k of a rank                                =  local positions [position + k b, position + (k + 1) b)
    loader worker w of Wl                            =  batches w, w + Wl, w + 2 Wl ...

``origin`` is 0 unless an epoch was resumed with another world size. Positions count samples, so a resumed epoch may use
any batch size. Ranks that are all at local position p have together consumed [0, origin + p W). Another world size can
continue there, and only there, by counting from that origin. A state taken after a batch is such a place, because every
rank has as many batches as the others.

The samples after the last whole global batch of W b samples are dropped; a shuffled epoch drops others each time.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, TypeAlias

from v2v_protocol.errors import ProtocolError, StateMismatch, UsageError
from v2v_protocol.messages import Welcome
from v2v_protocol.persisted import Limits, Persisted, always_written, later, read_fields
from v2v_protocol.sample import LARGEST_EPOCH, LARGEST_INDEX, LARGEST_SEED
from v2v_protocol.settings import format_value, plain
from v2v_protocol.spec import StreamSpec

STATE_VERSION = 1
Count: TypeAlias = Annotated[int, Limits(0, LARGEST_INDEX)]
Snapshot: TypeAlias = Count | tuple[Count | None, ...] | None
"""Number of the quarantine snapshot to continue with; of a mixture, that of each member. None: the server's newest."""


@dataclass(frozen=True, slots=True)
class StreamIdentity(Persisted):
    """Hold the server's half of every sample's identity.

    Attributes:
        spec: the resolved spec as plain values.
        spec_digest, catalogue_digest, numerics_version: see :class:`v2v_protocol.sample.SampleId`.
        sequences: N, samples of an epoch.
        sidecars: names the files beside the videos that the requested arrays are made from; "" if there are none.
    """

    spec: Mapping[str, Any]
    spec_digest: str
    catalogue_digest: str
    numerics_version: Count
    sequences: Count
    sidecars: str = later("")

    @classmethod
    def of(cls, welcome: Welcome) -> StreamIdentity:
        """Return the stream that a server offers.

        Raises:
            ProtocolError: the spec is not valid, or the digest is not that of the spec.
        """
        try:
            digest = StreamSpec.from_dict(welcome.spec).digest
        except (UsageError, TypeError, ValueError) as error:
            raise ProtocolError(f"the server's resolved spec is not valid: {error}") from error
        if digest != welcome.spec_digest:
            raise ProtocolError(
                f"the server names its resolved spec {welcome.spec_digest}, but it is {digest}: client and server are "
                "of different releases"
            )
        return cls(**{name: getattr(welcome, name) for name in _OF_STREAM})

    @property
    def resolved(self) -> StreamSpec:
        """Return the spec as an object.

        Raises:
            StateMismatch: a value of it, which another release saved, is not one of this release.
        """
        try:
            return StreamSpec.from_dict(self.spec)
        except UsageError as error:
            raise StateMismatch(
                f"the stream of the state cannot be made: {error}; begin a new stream, or resume with the release that "
                "saved the state"
            ) from error

    def require_same(self, other: StreamIdentity, *, ours: str, theirs: str) -> None:
        """Check that another stream has the same samples.

        Args:
            other: the stream that is offered.
            ours, theirs: names of the two sides for the message.

        Raises:
            StateMismatch: it has not; the message names what differs, on both sides.
        """
        # The cause comes first: another version may give the same spec and videos other digests.
        remedies = {
            "numerics_version": "serve with the release that the state was saved with",
            "spec_digest": "ask for the recipe and options that were saved",
            "catalogue_digest": "serve the same folder of videos (added, removed or changed files alter it; "
            "with scenes, so does a release that analyses scenes in another way)",
            "sequences": "serve the same folder of videos",
            "sidecars": "request the same arrays, and serve the same files beside the videos",
        }
        for name, remedy in remedies.items():
            mine, offered = getattr(self, name), getattr(other, name)
            if mine != offered:
                changed = differences(self.spec, other.spec) if name == "spec_digest" else ""
                digests = f"{name}: {ours} has {mine}, {theirs} has {offered}"
                raise StateMismatch(f"{f'{ours} / {theirs}: {changed}' if changed else digests}; {remedy}")


_OF_STREAM = tuple(StreamIdentity.__slots__)


def differences(ours: Mapping[str, Any], theirs: Mapping[str, Any]) -> str:
    """Return the fields in which two resolved specs differ, as text: ``recipe.gamma 2.2 / 1.8``."""

    def flat(spec: Mapping[str, Any]) -> dict[str, Any]:
        recipe = spec.get("recipe", {})
        named = {f"recipe.{key}": value for key, value in recipe.items()} if isinstance(recipe, Mapping) else {}
        return named | {key: value for key, value in spec.items() if key != "recipe"}

    left, right = flat(ours), flat(theirs)
    found = [
        f"{key} {left.get(key)} / {right.get(key)}"
        for key in sorted(left.keys() | right.keys())
        if left.get(key) != right.get(key)
    ]
    return f"{', '.join(found[:5])}{', ...' if len(found) > 5 else ''}"


@dataclass(frozen=True, slots=True)
class LoaderShare(Persisted):
    """Hold the progress of one loader worker, for a loader that saves the state of each worker.

    Attributes:
        worker, workers: number of the worker, and how many there are.
        batch_size: samples of its batches.
        batches: batches that it has delivered since the position in the state.
    """

    worker: Count
    workers: Count
    batch_size: Count
    batches: Count


@dataclass(frozen=True, slots=True)
class ResumeState(Persisted):
    """Hold where a rank, or one of its loader workers, stands.

    Attributes:
        stream: what the samples are made of; None before the first connection.
        seed, epoch: of the samples to come.
        origin, position, world_size: see the module.
        share: progress of a loader worker since ``position``; None for the state of a rank, which is valid for any
            number of loader workers.
        quarantine: the quarantine snapshot to continue with.
    """

    stream: StreamIdentity | None
    seed: Annotated[int, Limits(0, LARGEST_SEED)]
    epoch: Annotated[int, Limits(0, LARGEST_EPOCH)]
    origin: Count
    position: Count
    world_size: Annotated[int, Limits(1, LARGEST_INDEX)]
    share: LoaderShare | None = None
    quarantine: Snapshot = None

    @property
    def place(self) -> tuple[int, int, int]:
        """Return the epoch, and the origin and position in it."""
        return self.epoch, self.origin, self.position

    @property
    def is_beginning(self) -> bool:
        """Return whether nothing of the epoch is consumed."""
        return self.origin == self.position == 0

    def at_epoch(self, epoch: int) -> ResumeState:
        """Return the state at the beginning of ``epoch``, with the server's newest quarantine snapshot."""
        return dataclasses.replace(self, epoch=epoch, origin=0, position=0, share=None, quarantine=None)

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, those of the stream beside the others."""
        plain = Persisted.to_dict(self)
        stream, share = plain.pop("stream") or dict.fromkeys(always_written(StreamIdentity)), plain.pop("share")
        return {"version": STATE_VERSION, **stream, **plain, "loader_worker": share}

    @classmethod
    def from_dict(cls, values: Any) -> ResumeState:
        """Return the state that :meth:`to_dict` wrote.

        Raises:
            StateMismatch: the values are not a state of this release; the message names field, value and limit.
            UsageError: they are no mapping.
        """
        values = plain(values)
        if not isinstance(values, Mapping) or values.get("version") != STATE_VERSION:
            found = f"version {values.get('version')!r}" if isinstance(values, Mapping) else format_value(values)
            raise (StateMismatch if isinstance(values, Mapping) else UsageError)(
                f"not a state of V2VStreamDataset: {found}, expected version {STATE_VERSION}. Give the saved "
                "Batch.resume_state itself, for instance torch.load('last.pt')['stream']"
            )
        fields = {name: value for name, value in values.items() if name not in ("version", *_OF_STREAM)}
        stream = {name: values[name] for name in _OF_STREAM if name in values}
        fields["stream"] = None if values.get("spec", "") is None else stream
        fields["share"] = fields.pop("loader_worker", None)
        try:
            return read_fields(cls, fields)
        except ProtocolError as error:
            raise StateMismatch(f"not a state of V2VStreamDataset: {error}") from error


@dataclass(frozen=True, slots=True)
class EpochPlan:
    """Hold one rank's batches of one epoch, counted from where the epoch was started or resumed.

    Attributes:
        sequences: N, samples of the epoch.
        world_size, rank: W and r.
        batch_size: b, samples of one rank's batch.
        origin: global index that local positions count from.
        position: local samples that this rank has consumed before the first batch of the plan.

    Raises:
        StateMismatch: the position is outside the epoch.
        UsageError: another number is outside its range.
    """

    sequences: int
    world_size: int = 1
    rank: int = 0
    batch_size: int = 1
    origin: int = 0
    position: int = 0

    def __post_init__(self) -> None:
        if self.world_size < 1 or not 0 <= self.rank < self.world_size:
            raise UsageError(f"rank {self.rank} of world size {self.world_size}: ranks are 0 .. world size - 1")
        if self.batch_size < 1:
            raise UsageError(f"batch_size = {self.batch_size}: give 1 or more")
        consumed = self.origin + self.position * self.world_size
        if min(self.origin, self.position) < 0 or consumed > self.sequences:
            raise StateMismatch(
                f"position {self.position} of {self.world_size} ranks from global index {self.origin} is outside an "
                f"epoch of {self.sequences} sequences: give the saved state unchanged"
            )

    @property
    def batches(self) -> int:
        """Return the number of batches of this rank from its position to the end; it is equal for all ranks."""
        of_rank = (self.sequences - self.origin) // self.world_size
        return (of_rank - self.position) // self.batch_size

    def indices(self, batch: int) -> tuple[int, ...]:
        """Return the global indices of the samples of batch ``batch``, in order."""
        first = self.position + batch * self.batch_size
        return tuple(
            self.origin + position * self.world_size + self.rank for position in range(first, first + self.batch_size)
        )

    def shares_decodes(self, spacing: int, workers: int) -> bool:
        """Return whether all siblings, ``spacing`` apart in the epoch, go to the same loader worker of the same rank.

        Raises:
            UsageError: two siblings could be in one global batch.
        """
        together = self.world_size * self.batch_size
        if spacing < together:
            raise UsageError(
                f"sibling_spacing = {spacing}: samples of one decode would come in one global batch of "
                f"{self.world_size} x {self.batch_size} = {together} samples (world size x batch_size); use a smaller "
                "batch_size, or begin a new stream"
            )
        return spacing % (together * workers) == 0

    def require_batches(self) -> None:
        """Check that the epoch holds at least one global batch.

        Raises:
            UsageError: it does not.
        """
        if self.batches < 1:
            raise UsageError(
                f"an epoch of {self.sequences} sequences holds no global batch of {self.world_size} x "
                f"{self.batch_size} = {self.world_size * self.batch_size} samples (world size x batch_size); use a "
                "smaller batch_size, fewer ranks or more videos"
            )


@dataclass(frozen=True, slots=True)
class Consumer:
    """Convert between a rank's states and its batches.

    Attributes:
        batch_size: samples of one rank's batch.
        rank, world_size: of this process.
    """

    batch_size: int
    rank: int
    world_size: int

    def plan(self, stream: StreamIdentity, state: ResumeState) -> EpochPlan:
        """Return the batches of an epoch from ``state`` on."""
        return EpochPlan(stream.sequences, self.world_size, self.rank, self.batch_size, state.origin, state.position)

    def after(self, state: ResumeState, plan: EpochPlan, batch: int, quarantine: Snapshot) -> ResumeState:
        """Return the rank's state after a batch. After the last one, it is the beginning of the next epoch.

        Args:
            state: where the plan begins.
            batch: number of the batch in the plan.
            quarantine: newest quarantine snapshot seen.
        """
        if batch + 1 == plan.batches:
            return state.at_epoch(state.epoch + 1)
        position = plan.position + (batch + 1) * plan.batch_size
        return dataclasses.replace(state, position=position, share=None, quarantine=quarantine)

    def adopt(self, state: ResumeState) -> ResumeState:
        """Return ``state`` for this world size; another one counts from the first index that no rank consumed."""
        if state.world_size == self.world_size:
            return state
        origin = state.origin + state.position * state.world_size
        return dataclasses.replace(state, origin=origin, position=0, world_size=self.world_size)

    def skip_rest(self, state: ResumeState) -> ResumeState:
        """Return the next epoch if less than a global batch is left of a resumed one; otherwise ``state``."""
        if state.is_beginning or state.stream is None or self.plan(state.stream, state).batches:
            return state
        return state.at_epoch(state.epoch + 1)
