"""Compute a keyed permutation of 0 .. n-1 without storing it.

A balanced Feistel network permutes the smallest suitable power of four that is at least n. An output outside 0 .. n-1
is permuted again until it falls inside (cycle walking: Black and Rogaway, "Ciphers with arbitrary finite domains",
CT-RSA 2002). Looking up an index takes constant expected time and memory. So starting an epoch over ten million
sequences, or resuming in the middle of it, costs no more than one over ten.
"""

from __future__ import annotations

import hashlib

_ROUNDS = 8
_LEAST_HALF_BITS = 4
_MASK64 = (1 << 64) - 1


class Permutation:
    """The permutation of 0 .. n-1 keyed by (seed, epoch).

    Args:
        n: size of the domain, at least 1.
        seed: 0 .. 2**64 - 1.
        epoch: 0 .. 2**32 - 1.
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
