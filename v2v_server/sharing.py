"""Keep the newest finished samples up to a limit, in the order in which they arrived.

A sample lies in memory of the server that its worker filled, or in the frames of its message, if its worker or the
consumer that asked first is on another host. Consumers get the frames, or the name of sealed memory, and thus nothing
that a process can write to. The memory outlives the worker, and lasts until the ring drops it and its last reader is
done.

A consumer may open the memory after the ring has dropped the sample. It finds nothing there and asks again without a
slot; that answer is a message, which holds its bytes itself.

Memory: at most ``most_bytes``, or one sample, the samples that are being made, and dropped ones that are still on their
way to a consumer, which the credit of all consumers bounds (:mod:`v2v_server.broker.session`).
"""

from __future__ import annotations

import os
import resource
import weakref
from collections.abc import Container, Hashable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

from v2v_protocol.arena import NO_SLOT, ArenaName, Slot, array_offsets, create_memory, read_arrays, seal_memory
from v2v_protocol.messages import Buffer, Frames, SampleHeader, encode

mappings: weakref.WeakSet[object] = weakref.WeakSet()
"""All mappings that exist, each with a descriptor of its own: also those that only messages on their way refer to."""


class SampleMemory:
    """Memory for one sample.

    Args:
        sizes: bytes of each array.

    Attributes:
        slot: what a lease names, so that the worker writes there.
        nbytes: its size.

    Raises:
        OSError: the system does not support sealed anonymous files, or has no memory left.
    """

    def __init__(self, sizes: Sequence[int]) -> None:
        self._sizes = tuple(sizes)
        self.nbytes = array_offsets(sizes, 1)[-1]
        token = os.urandom(16).hex()
        self._descriptor = create_memory(ArenaName(os.getpid(), 0, 1, token).memory_name, self.nbytes)
        weakref.finalize(self, os.close, self._descriptor)
        self.slot = Slot(str(ArenaName(os.getpid(), self._descriptor, 1, token)), 1)

    def seal(self) -> bool:
        """Make the memory read-only for every process; return False if one still has it mapped for writing."""
        try:
            seal_memory(self._descriptor, content=True)
        except OSError:
            return False
        return True

    @cached_property
    def arrays(self) -> Sequence[bytes | memoryview]:
        """Bytes of each array, for all messages: mapped once, or copied if the system has no descriptor left. They stay
        valid without this object.
        """
        try:
            arrays = read_arrays(self._descriptor, self._sizes)
        except OSError:
            offsets = array_offsets(self._sizes, 1)
            return [os.pread(self._descriptor, size, at) for size, at in zip(self._sizes, offsets, strict=False)]
        mappings.add(arrays[0].obj)
        return arrays


_FILES_SHARE = 4
"""Samples use at most this part of the process's open files."""


@dataclass(frozen=True, slots=True)
class SharedSample:
    """A finished sample.

    Attributes:
        header: as its worker sent it.
        frames: the raw frames behind the header; empty if the arrays are in ``memory``.
        memory: sealed.
    """

    header: SampleHeader
    frames: Sequence[Buffer]
    memory: SampleMemory | None

    @property
    def nbytes(self) -> int:
        """Size in bytes."""
        return sum(map(len, self.frames)) if self.memory is None else self.memory.nbytes

    def message(self, slot: Slot | None, *, is_first: bool) -> Frames:
        """Build the message for a consumer.

        Args:
            slot: what the consumer's request named; None: it cannot read memory of this host.
            is_first: whether the work on the sample was done for this consumer.
        """
        changes: dict[str, Any] = {} if is_first else {"cpu_seconds": 0.0, "decoded": False, "cache": ""}
        if slot is not None:
            changes["slot"] = slot.number
            if self.memory is not None:
                return encode(replace(self.header, arena=self.memory.slot.arena, **changes))
        frames = self.frames if self.memory is None else self.memory.arrays
        return [*encode(replace(self.header, **changes)), *frames]


class SampleRing:
    """The newest samples by key, and the memory of those that are being made.

    Args:
        most_bytes: size limit.

    Attributes:
        being_made: memory lent for each lease.
    """

    def __init__(self, most_bytes: int) -> None:
        self._most_bytes = most_bytes
        self._samples: dict[Hashable, SharedSample] = {}
        self.being_made: dict[int, SampleMemory] = {}
        self._bytes = 0

    def get(self, key: Hashable) -> SharedSample | None:
        """Return a sample; None if the ring does not have it."""
        return self._samples.get(key)

    def lend(self, lease: int, sizes: Sequence[int]) -> Slot | None:
        """Return memory for the sample of a lease; None if there is none.

        Args:
            lease: its number.
            sizes: bytes of each array.
        """
        files, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
        used = 2 * (len(self._samples) + len(self.being_made)) + len(mappings)
        if files != resource.RLIM_INFINITY and used >= files // _FILES_SHARE:
            return None
        try:
            self.being_made[lease] = SampleMemory(sizes)
        except OSError:
            return None
        return self.being_made[lease].slot

    def lent(self, lease: int) -> Slot | None:
        """Return what was lent for a lease; None if nothing was."""
        memory = self.being_made.get(lease)
        return None if memory is None else memory.slot

    def release(self, leases: Container[int]) -> None:
        """Free memory whose lease is not among these."""
        for lease in [lease for lease in self.being_made if lease not in leases]:
            del self.being_made[lease]

    def add(self, key: Hashable, lease: int, header: SampleHeader, frames: Sequence[Buffer]) -> SharedSample:
        """Add a finished sample; the oldest ones make place for it.

        Args:
            key: equal for equal samples only.
            lease: its number.
            header, frames: the message of its worker.
        """
        memory = self.being_made.pop(lease, None)
        if frames:
            memory = None
        elif memory is not None and not memory.seal():
            frames, memory = [bytes(array) for array in memory.arrays], None
        sample = SharedSample(replace(header, slot=NO_SLOT), frames, memory)
        before = self._samples.pop(key, None)
        self._samples[key] = sample
        self._bytes += sample.nbytes - (0 if before is None else before.nbytes)
        while self._bytes > self._most_bytes and len(self._samples) > 1:
            self._bytes -= self._samples.pop(next(iter(self._samples))).nbytes
        return sample
