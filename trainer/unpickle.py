"""Read PyTorch files without executing code that they contain.

``torch.load(weights_only=True)`` handles plain files. Published checkpoints of the event_cnn_minimal family (E2VID+,
FireNet+, HyperE2VID, ET-Net) and of V2V also hold pickled objects: a ConfigParser, whole optimisers and schedulers. A
second reader handles these. It knows the few constructors of tensors, and replaces everything else, functions included,
with an inert :class:`Placeholder`, without importing it.
"""

from __future__ import annotations

import lzma
import pickle
import struct
import tarfile
import warnings
import zipfile
import zlib
from collections import OrderedDict
from collections.abc import Callable, Iterable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import torch
import torch._utils

from v2v_protocol.errors import UsageError


class Placeholder:
    """Replace an object of any class, or the result of any call, in a pickle. It keeps the state and does nothing."""

    def __init__(self, *_arguments: Any, **_named: Any) -> None:
        self.content: list[Any] = []

    def __call__(self, *_arguments: Any, **_named: Any) -> Placeholder:
        return Placeholder()

    def __setstate__(self, state: Any) -> None:
        self.content = [state]

    def __setitem__(self, _key: Any, value: Any) -> None:
        """Keep an item of a dict whose class is unknown."""
        self.content.append(value)

    def append(self, item: Any) -> None:
        """Keep an item of a list whose class is unknown."""
        self.content.append(item)

    def extend(self, items: Iterable[Any]) -> None:
        """Keep items of a list whose class is unknown."""
        self.content.extend(items)

    def update(self, items: Iterable[Any]) -> None:
        """Keep items of a set whose class is unknown."""
        self.content.extend(items)


_KNOWN: dict[tuple[str, str], Callable[..., Any]] = {
    ("collections", "OrderedDict"): OrderedDict,
    ("torch", "Size"): torch.Size,
    ("torch._utils", "_rebuild_tensor"): torch._utils._rebuild_tensor,
    ("torch._utils", "_rebuild_tensor_v2"): torch._utils._rebuild_tensor_v2,
    ("torch._utils", "_rebuild_parameter"): torch._utils._rebuild_parameter,
}
"""The only names that are resolved (PyTorch resolves its storage classes itself). They do not run code of the file."""


class _TensorUnpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        return _KNOWN.get((module, name), Placeholder)


def _load(file: Any, **options: Any) -> Any:
    return _TensorUnpickler(file, **options).load()


_TENSORS_ONLY = SimpleNamespace(Unpickler=_TensorUnpickler, load=_load, __name__="pickle")
"""Stands in for the pickle module in ``torch.load``."""


_DAMAGE = (
    *(pickle.UnpicklingError, struct.error, EOFError, OSError, ImportError, AttributeError),
    *(ArithmeticError, AssertionError, LookupError, MemoryError, RuntimeError, TypeError, ValueError),
    *(zipfile.BadZipFile, zlib.error, lzma.LZMAError),
)
"""Errors that PyTorch and pickle raise on malformed files."""


def _check_sums(path: str | Path) -> None:
    """Check the CRC-32 of each entry of a zip archive; ``torch.load`` does not.

    Raises:
        BadZipFile: an entry is damaged.
    """
    if not zipfile.is_zipfile(path):
        return
    with zipfile.ZipFile(path) as archive:
        # PyTorch writes 0 everywhere where it is told not to compute them.
        if any(entry.CRC for entry in archive.infolist()) and (damaged := archive.testzip()):
            raise zipfile.BadZipFile(f"wrong CRC-32 of {damaged}")


def read_torch_file(path: str | Path, *, plain: bool = False) -> Any:
    """Read a file of ``torch.save`` onto the CPU, without executing code from it.

    Args:
        path: the file.
        plain: True refuses objects that are neither tensors nor plain values; False replaces them with a
            :class:`Placeholder`.

    Raises:
        UsageError: there is no such file, it is not a PyTorch file, it is damaged, or (``plain``) it holds objects.
    """
    if not Path(path).is_file():
        raise UsageError(f"no file {path}")
    try:
        if tarfile.is_tarfile(path):
            raise UsageError(f"{path} is a tar archive (packed, or PyTorch before 0.1.12): give the checkpoint itself")
        _check_sums(path)
        with warnings.catch_warnings():
            # These warnings concern how the file was written (its pickle protocol, old storage classes).
            warnings.simplefilter("ignore", UserWarning)
            try:
                return torch.load(path, map_location="cpu", weights_only=True)
            except pickle.UnpicklingError:
                if plain:
                    raise
                return torch.load(path, map_location="cpu", weights_only=False, pickle_module=_TENSORS_ONLY)
    except _DAMAGE as error:
        reason = str(error).partition("\n")[0] or type(error).__name__
        raise UsageError(
            f"{path} is not a PyTorch file of {'tensors and plain values' if plain else 'weights'}, "
            f"or damaged: {reason}"
        ) from error
