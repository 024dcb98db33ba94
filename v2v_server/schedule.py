"""The schedule: which sequence each index of an epoch is made from. Pure; nothing is stored per index.

    candidate 0 of (seed, epoch, index)     the sequence that the epoch's permutation puts at ``index``
    candidate k                             a hash of (seed, epoch, index, k), of a video that no candidate before it is
                                            of (as far as a few attempts find one)

A candidate whose video fails is passed over for the next one. That moves only this index: catalogue, permutation and
every other index stay as they are, and the sample's provenance lists the refusals.
"""

from __future__ import annotations

from functools import lru_cache

from v2v_server.permutation import Permutation, hashed_below
from v2v_server.sequences import Sequence, SequenceTable

_MOST_ATTEMPTS = 16
MOST_CANDIDATES = 8
"""Candidates of one index. A corpus where this many random videos in a row are broken needs a person, not a ninth."""


class Schedule:
    """Order of the sequences of one corpus under one spec.

    Args:
        table: the sequences; must not be empty.
        shuffle: False keeps catalogue order in every epoch.
    """

    def __init__(self, table: SequenceTable, *, shuffle: bool) -> None:
        self._table = table
        self._shuffle = shuffle

    @property
    def count(self) -> int:
        """N, indices of an epoch."""
        return self._table.count

    def candidate(self, seed: int, epoch: int, index: int, candidate: int) -> Sequence:
        """The sequence that candidate number ``candidate`` (0 .. MOST_CANDIDATES - 1) of an index is made from.

        Raises:
            IndexError: index is outside 0 .. count-1.
        """
        if not 0 <= index < self.count:
            raise IndexError(f"index {index} of an epoch of {self.count} sequences")
        first = self._table[_permutation(self.count, seed, epoch)(index) if self._shuffle else index]
        tried = [first]
        for number in range(1, candidate + 1):
            tried.append(self._substitute(seed, epoch, index, number, {sequence.video.id for sequence in tried}))
        return tried[candidate]

    def _substitute(self, seed: int, epoch: int, index: int, candidate: int, refused: set[str]) -> Sequence:
        for attempt in range(_MOST_ATTEMPTS):
            sequence = self._table[hashed_below(self.count, seed, epoch, index, candidate, attempt)]
            if sequence.video.id not in refused:
                break
        return sequence


@lru_cache(maxsize=64)
def _permutation(count: int, seed: int, epoch: int) -> Permutation:
    return Permutation(count, seed, epoch)
