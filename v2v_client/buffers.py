"""Batch buffers that are used again, but never while anything still looks at them.

Fresh memory costs more than the copy into it: the kernel hands out zeroed pages one fault at a time. So a buffer whose
last user is gone goes back to its pool.

How the last user is known: an array of a batch does not own its memory but refers to a small *loan* object that does
(NumPy keeps the object behind ``__array_interface__`` alive as the array's base). Whatever is made from that array
without copying, a view, a torch tensor, a tensor's storage, another tensor or array of the same storage, keeps the
loan alive; its finalizer puts the memory back. No reference is counted by hand, and no promise of the user is needed.
"""

from __future__ import annotations

import math
import weakref
from collections import deque
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt


class _Loan:
    """Owner, in the eyes of NumPy, of borrowed memory."""

    __slots__ = ("__array_interface__", "__weakref__")

    def __init__(self, memory: npt.NDArray[np.uint8], dtype: np.dtype[Any], shape: tuple[int, ...]) -> None:
        self.__array_interface__ = {
            "version": 3,
            "data": (memory.ctypes.data, False),
            "shape": shape,
            "typestr": dtype.str,
        }


class BufferPool:
    """Arrays of one dtype and shape.

    Args:
        dtype, shape: of the arrays.
        spare: most buffers kept while nobody uses them.
    """

    def __init__(self, dtype: str, shape: tuple[int, ...], spare: int) -> None:
        self._dtype = np.dtype(dtype)
        self._shape = shape
        # A deque, because finalizers may run in any thread (that of DataLoader's pinning, say): its methods are atomic.
        self._free: deque[npt.NDArray[np.uint8]] = deque(maxlen=spare)

    def take(self) -> npt.NDArray[Any]:
        """A C-contiguous array of unspecified content; its memory comes back when the last reference to it dies."""
        try:
            memory = self._free.pop()
        except IndexError:
            memory = np.empty(math.prod(self._shape) * self._dtype.itemsize, np.uint8)
        loan = _Loan(memory, self._dtype, self._shape)
        # The finalizer holds the memory while the loan lives.
        weakref.finalize(loan, self._free.append, memory).atexit = False
        return np.asarray(loan)


class BatchBuffers:
    """The arrays of batches, which one iteration of a dataset leaves to the next."""

    def __init__(self) -> None:
        self._form: object = None
        self._pools: dict[str, BufferPool] = {}

    def shape(self, layout: Mapping[str, tuple[str, tuple[int, ...]]], batch_size: int, spare: int) -> None:
        """Makes the next arrays ones for batches of that many samples; memory of another form is let go.

        Args:
            layout: dtype and shape of each array of one sample.
            batch_size: samples of a batch.
            spare: most batches kept while nobody uses them.
        """
        form = dict(layout), batch_size, spare
        if form != self._form:
            self._form = form
            self._pools = {
                name: BufferPool(dtype, (batch_size, *shape), spare) for name, (dtype, shape) in layout.items()
            }

    def take(self) -> dict[str, npt.NDArray[Any]]:
        """Arrays for a batch, of unspecified content, by name; see :meth:`BufferPool.take`."""
        return {name: pool.take() for name, pool in self._pools.items()}
