"""Map each index of an epoch to a sequence. Pure; nothing is stored per index.

    candidate 0 of (seed, epoch, place)     the sequence that the epoch's permutation puts at ``place``
    candidate k                             a hash of (seed, epoch, place, k), from a video that no earlier candidate
                                            uses (if a few attempts find one)

If the video of a candidate fails, the next candidate is tried. That changes only this place: catalogue, permutation and
every other place stay the same, and the sample's provenance lists the refusals.

Places and indices are the same if each decoded clip gives one sample. With K samples of a clip, S apart, an epoch
consists of blocks of S places and S K indices:

    index      block S K + view S + offset          view 0 .. K-1, offset 0 .. S-1
    place      block S + offset

so the K samples of a place, its siblings, are S, 2 S ... (K-1) S apart. S is the number of samples from one batch of a
consumer to its next. So no batch holds two siblings, all siblings go to the same consumer, and they come within K
batches. Places that do not fill a block at the end of the epoch are dropped; they differ in each epoch.
"""

from __future__ import annotations

from functools import lru_cache

from v2v_protocol.errors import UsageError
from v2v_protocol.spec import StreamSpec
from v2v_server.schedule.permutation import Permutation, hashed_below
from v2v_server.schedule.sequences import SequenceTable, VideoSequence

_MOST_ATTEMPTS = 16
MOST_CANDIDATES = 8
"""Candidates of one place. If this many random videos in a row are broken, a person must repair the corpus."""


class Schedule:
    """Order of the sequences of one corpus under one spec.

    Args:
        table: the sequences; must not be empty.
        shuffle: False keeps catalogue order in every epoch.
        samples_per_decode: K.
        sibling_spacing: S; not 0 if K > 1.

    Raises:
        UsageError: K > 1 and S = 0.
    """

    def __init__(
        self, table: SequenceTable, *, shuffle: bool, samples_per_decode: int = 1, sibling_spacing: int = 0
    ) -> None:
        if samples_per_decode > 1 and not sibling_spacing:
            raise UsageError(
                f"samples_per_decode = {samples_per_decode} and sibling_spacing = 0: set sibling_spacing to the number "
                "of samples from one batch to the next (batch size x ranks x loader workers)"
            )
        self._table = table
        self._shuffle = shuffle
        self._views = samples_per_decode
        self._spacing = sibling_spacing if samples_per_decode > 1 else 1

    @classmethod
    def of(cls, table: SequenceTable, spec: StreamSpec) -> Schedule:
        """Return the schedule that a spec asks for.

        Raises:
            UsageError: its ``sibling_spacing`` is not set.
        """
        return cls(
            table,
            shuffle=spec.shuffle,
            samples_per_decode=spec.samples_per_decode,
            sibling_spacing=spec.sibling_spacing,
        )

    @property
    def count(self) -> int:
        """Return the number of indices of an epoch."""
        return self._table.count // self._spacing * self._spacing * self._views

    def place(self, index: int) -> int:
        """Return the place of an index; siblings have the same place.

        Raises:
            IndexError: index is outside 0 .. count-1.
        """
        if not 0 <= index < self.count:
            raise IndexError(f"index {index} of an epoch of {self.count} samples")
        block, within = divmod(index, self._spacing * self._views)
        return block * self._spacing + within % self._spacing

    def candidate(self, seed: int, epoch: int, index: int, candidate: int) -> VideoSequence:
        """Return the sequence of candidate number ``candidate`` (0 .. MOST_CANDIDATES - 1) of an index.

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
