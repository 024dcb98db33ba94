"""Lending memory to whoever gets an array of it, and learning when its last user is gone.

An array that is lent does not own its memory but refers to a small *loan* object that does (NumPy keeps the object
behind ``__array_interface__`` alive as the array's base). Whatever is made from that array without copying, a view, a
torch tensor, a tensor's storage, another tensor or array of the same storage, keeps the loan alive; its finalizer gives
the memory back. No reference is counted by hand, and no promise of the user is needed.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

Bytes = npt.NDArray[np.uint8]


class _Loan:
    """Owner, in the eyes of NumPy, of borrowed memory."""

    __slots__ = ("__array_interface__", "__weakref__")

    def __init__(self, memory: Bytes, dtype: np.dtype[Any], shape: tuple[int, ...]) -> None:
        self.__array_interface__ = {
            "version": 3,
            "data": (memory.ctypes.data, False),
            "shape": shape,
            "typestr": dtype.str,
        }


def lend(
    memory: Bytes, dtype: np.dtype[Any], shape: tuple[int, ...], back: Callable[[Bytes], object]
) -> npt.NDArray[Any]:
    """The memory as a C-contiguous array.

    Args:
        memory: contiguous, of at least that many bytes; kept until it is back.
        dtype, shape: of the array.
        back: called with the memory once nothing refers to it any more, in whatever thread that happens; not at the
            end of the process.
    """
    loan = _Loan(memory, dtype, shape)
    # The finalizer holds the memory while the loan lives.
    weakref.finalize(loan, back, memory).atexit = False
    return np.asarray(loan)
