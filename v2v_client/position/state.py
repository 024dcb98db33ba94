"""Define the state that a consumer saves: the stream, and the position in it. Pure.

A state is a plain dict, so a trainer's checkpoint can hold it. It pins everything that determines a sample's bytes; a
server of another stream is refused before the first batch.
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
from v2v_protocol.settings import format_value
from v2v_protocol.spec import StreamSpec

STATE_VERSION = 1
Count: TypeAlias = Annotated[int, Limits(0, LARGEST_INDEX)]


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
        """Return the spec as an object."""
        return StreamSpec.from_dict(self.spec)

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
        origin, position, world_size: see :mod:`v2v_client.position.plan`.
        share: progress of a loader worker since ``position``; None for the state of a rank, which is valid for any
            number of loader workers.
        quarantine: number of the quarantine snapshot to continue with; None for the server's newest.
    """

    stream: StreamIdentity | None
    seed: Annotated[int, Limits(0, LARGEST_SEED)]
    epoch: Annotated[int, Limits(0, LARGEST_EPOCH)]
    origin: Count
    position: Count
    world_size: Annotated[int, Limits(1, LARGEST_INDEX)]
    share: LoaderShare | None = None
    quarantine: Count | None = None

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
            UsageError: the values are not a state of this release; the message names field, value and limit.
        """
        if not isinstance(values, Mapping) or values.get("version") != STATE_VERSION:
            found = f"version {values.get('version')!r}" if isinstance(values, Mapping) else format_value(values)
            raise UsageError(
                f"not a state of V2VStreamDataset: {found}, expected version {STATE_VERSION}. Give the saved "
                "Batch.resume_state itself, for instance torch.load('last.pt')['stream']"
            )
        plain = {name: value for name, value in values.items() if name not in ("version", *_OF_STREAM)}
        stream = {name: values[name] for name in _OF_STREAM if name in values}
        plain["stream"] = None if values.get("spec", "") is None else stream
        plain["share"] = plain.pop("loader_worker", None)
        try:
            return read_fields(cls, plain)
        except ProtocolError as error:
            raise UsageError(f"not a state of V2VStreamDataset: {error}") from error
