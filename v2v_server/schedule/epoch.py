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

import hashlib
from functools import lru_cache

from v2v_protocol.errors import UsageError
from v2v_protocol.spec import StreamSpec
from v2v_server.schedule.sequences import SequenceTable, VideoSequence

_ROUNDS = 8
_LEAST_HALF_BITS = 4
_MASK64 = (1 << 64) - 1
_MOST_ATTEMPTS = 16
MOST_CANDIDATES = 8
"""Candidates of one place. If this many random videos in a row are broken, a person must repair the corpus."""


class Permutation:
    """The permutation of 0 .. n-1 keyed by (seed, epoch), computed without storing it.

    A balanced Feistel network permutes the smallest suitable power of four that is at least n. An output outside
    0 .. n-1 is permuted again until it falls inside (cycle walking: Black and Rogaway, "Ciphers with arbitrary finite
    domains", CT-RSA 2002). Looking up an index takes constant expected time and memory. So starting an epoch over ten
    million sequences, or resuming in the middle of it, costs no more than one over ten.

    Args:
        n: size of the domain, at least 1.
        seed: 0 .. 2**64 - 1.
        epoch: 0 .. 2**32 - 1.

    Raises:
        ValueError: ``n`` is below 1.
    """

    def __init__(self, n: int, seed: int, epoch: int) -> None:
        if n < 1:
            raise ValueError(f"a permutation of {n} elements")
        self.n = n
        # Spare bits keep small domains well mixed: 2-bit halves reach too few permutations.
        self._half_bits = max(_LEAST_HALF_BITS, ((n - 1).bit_length() + 1) // 2)
        self._half_mask = (1 << self._half_bits) - 1
        key = hashlib.blake2b(b"v2v permutation 1" + seed.to_bytes(8, "little") + epoch.to_bytes(8, "little")).digest()
        self._round_keys = tuple(int.from_bytes(key[8 * i : 8 * i + 8], "little") for i in range(_ROUNDS))

    def __call__(self, index: int) -> int:
        """Return the image of ``index`` under the permutation.

        Raises:
            IndexError: index is outside 0 .. n-1.
        """
        if not 0 <= index < self.n:
            raise IndexError(f"index {index} of an epoch of {self.n} sequences")
        value = self._feistel(index)
        while value >= self.n:
            value = self._feistel(value)
        return value

    def _feistel(self, value: int) -> int:
        left, right = value >> self._half_bits, value & self._half_mask
        for key in self._round_keys:
            left, right = right, left ^ (_mix64(right ^ key) & self._half_mask)
        return left << self._half_bits | right


def _mix64(x: int) -> int:
    """Apply the finaliser of splitmix64 (Steele, Lea and Flood, "Fast splittable pseudorandom number generators",
    2014).
    """
    x = (x ^ x >> 30) * 0xBF58476D1CE4E5B9 & _MASK64
    x = (x ^ x >> 27) * 0x94D049BB133111EB & _MASK64
    return x ^ x >> 31


def hashed_below(n: int, *words: int) -> int:
    """Return a number in 0 .. n-1 that is a pure hash of the words (each 0 .. 2**64 - 1). Its bias is at most n /
    2**64.
    """
    data = b"".join(word.to_bytes(8, "little") for word in words)
    return int.from_bytes(hashlib.blake2b(b"v2v candidate 1" + data, digest_size=8).digest(), "little") % n


class Schedule:
    """Order of the sequences of one corpus under one spec.

    Args:
        table: the sequences; must not be empty.
        shuffle: False keeps catalogue order in every epoch.
        samples_per_decode: K.
        sibling_spacing: S; not 0 if K > 1.

    Attributes:
        table: the sequences.

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
        self.table = table
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
        return self.table.count // self._spacing * self._spacing * self._views

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
        first = self.table[_permuted(self.table.count, seed, epoch, place) if self._shuffle else place]
        tried = [first]
        for number in range(1, candidate + 1):
            tried.append(self._substitute(seed, epoch, place, number, {sequence.video.id for sequence in tried}))
        return tried[candidate]

    def _substitute(self, seed: int, epoch: int, place: int, candidate: int, refused: set[str]) -> VideoSequence:
        for attempt in range(_MOST_ATTEMPTS):
            sequence = self.table[hashed_below(self.table.count, seed, epoch, place, candidate, attempt)]
            if sequence.video.id not in refused:
                break
        return sequence


@lru_cache(maxsize=1024)  # a lease asks twice, and so do its siblings
def _permuted(count: int, seed: int, epoch: int, place: int) -> int:
    return _permutation(count, seed, epoch)(place)


@lru_cache(maxsize=64)
def _permutation(count: int, seed: int, epoch: int) -> Permutation:
    return Permutation(count, seed, epoch)
