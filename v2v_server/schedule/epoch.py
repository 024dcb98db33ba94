"""The schedule: which sequence each index of an epoch is made from. Pure; nothing is stored per index.

    candidate 0 of (seed, epoch, place)     the sequence that the epoch's permutation puts at ``place``
    candidate k                             a hash of (seed, epoch, place, k), of a video that no candidate before it is
                                            of (as far as a few attempts find one)

A candidate whose video fails is passed over for the next one. That moves only this place: catalogue, permutation and
every other place stay as they are, and the sample's provenance lists the refusals.

Places and indices are the same where each decoded clip gives one sample. With K samples of a clip, S apart, an epoch is
made of blocks of S places and S K indices:

    index      block S K + view S + offset          view 0 .. K-1, offset 0 .. S-1
    place      block S + offset

so the K samples of a place, its siblings, are S, 2 S ... (K-1) S apart. S is the number of samples from one batch of a
consumer to its next: no batch holds two siblings, all of them go to the same consumer, and they come within K batches.
What does not fill a block at the end of the epoch is dropped, others in each epoch.
"""

from __future__ import annotations

from functools import lru_cache

from v2v_protocol.errors import UsageError
from v2v_protocol.spec import StreamSpec
from v2v_server.schedule.permutation import Permutation, hashed_below
from v2v_server.schedule.sequences import SequenceTable, VideoSequence

_MOST_ATTEMPTS = 16
MOST_CANDIDATES = 8
"""Candidates of one place. A corpus where this many random videos in a row are broken needs a person, not a ninth."""


class Schedule:
    """Order of the sequences of one corpus under one spec.

    Args:
        table: the sequences; must not be empty.
        shuffle: False keeps catalogue order in every epoch.
        samples_per_decode: K.
        sibling_spacing: S; not 0 where K > 1.

    Raises:
        UsageError: K > 1 and S = 0.
    """

    def __init__(
        self, table: SequenceTable, *, shuffle: bool, samples_per_decode: int = 1, sibling_spacing: int = 0
    ) -> None:
        if samples_per_decode > 1 and not sibling_spacing:
            raise UsageError(
                f"samples_per_decode = {samples_per_decode} and sibling_spacing = 0: say how many samples lie between "
                "a batch and the next (batch size x ranks x loader workers)"
            )
        self._table = table
        self._shuffle = shuffle
        self._views = samples_per_decode
        self._spacing = sibling_spacing if samples_per_decode > 1 else 1

    @classmethod
    def of(cls, table: SequenceTable, spec: StreamSpec) -> Schedule:
        """The schedule that a spec asks for.

        Raises:
            UsageError: its ``sibling_spacing`` is open.
        """
        return cls(
            table,
            shuffle=spec.shuffle,
            samples_per_decode=spec.samples_per_decode,
            sibling_spacing=spec.sibling_spacing,
        )

    @property
    def count(self) -> int:
        """Indices of an epoch."""
        return self._table.count // self._spacing * self._spacing * self._views

    def place(self, index: int) -> int:
        """The place of an index: equal for siblings.

        Raises:
            IndexError: index is outside 0 .. count-1.
        """
        if not 0 <= index < self.count:
            raise IndexError(f"index {index} of an epoch of {self.count} samples")
        block, within = divmod(index, self._spacing * self._views)
        return block * self._spacing + within % self._spacing

    def candidate(self, seed: int, epoch: int, index: int, candidate: int) -> VideoSequence:
        """The sequence that candidate number ``candidate`` (0 .. MOST_CANDIDATES - 1) of an index is made from.

        Raises:
            IndexError: index is outside 0 .. count-1.
        """
        place = self.place(index)
        first = self._table[_permuted(self._table.count, seed, epoch, place) if self._shuffle else place]
        tried = [first]
        for number in range(1, candidate + 1):
            tried.append(self._substitute(seed, epoch, place, number, {sequence.video.id for sequence in tried}))
        return tried[candidate]

    def _substitute(self, seed: int, epoch: int, place: int, candidate: int, refused: set[str]) -> VideoSequence:
        for attempt in range(_MOST_ATTEMPTS):
            sequence = self._table[hashed_below(self._table.count, seed, epoch, place, candidate, attempt)]
            if sequence.video.id not in refused:
                break
        return sequence


@lru_cache(maxsize=1024)  # a lease asks twice, and so do its siblings
def _permuted(count: int, seed: int, epoch: int, place: int) -> int:
    return _permutation(count, seed, epoch)(place)


@lru_cache(maxsize=64)
def _permutation(count: int, seed: int, epoch: int) -> Permutation:
    return Permutation(count, seed, epoch)
