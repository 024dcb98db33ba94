"""Choose where numba stores compiled kernels (a separate folder for every state of their sources and every processor),
and import OpenCV on first use.

Numba treats compiled code as current while the one file that defines the function is unchanged. Our kernels include
functions and constants of several files. After a change of one of them numba would silently use the old kernel, with
other results. A digest of all these files in the folder's name prevents this.

Numba numbers the files of compiled code, and its index states which of them is for which processor. Two hosts that
share a folder and compile at the same time may take the same number. Then the index leads one of them to the code of
the other, whose instructions it may lack, at every later start. So the processor is in the digest too.
"""

from __future__ import annotations

import hashlib
import os
import re
import stat
import sys
import tempfile
from collections.abc import Iterator, Mapping, MutableMapping
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from itertools import takewhile
from pathlib import Path
from typing import TYPE_CHECKING, Any

SOURCES = Path(__file__).parents[1] / "simulation"
"""The folder of the pixel kernels; with "motion" and "worlds" beside it, it has all files that a kernel may use."""

_FOLDERS = SOURCES, SOURCES.with_name("motion"), SOURCES.with_name("worlds")

PROCESSORS = Path("/proc/cpuinfo")
"""Linux's description of the processors. Asking LLVM, as numba does, would load it in every process."""

_VARIABLE = "NUMBA_CACHE_DIR"
_KIND = re.compile(r"(vendor_id|cpu family|model|flags|Features|CPU (implementer|architecture|variant|part)|isa)\s*:")
_OURS = re.compile(r"numba-[0-9a-f]{12}")


def use_compile_cache() -> None:
    """Make numba store what this process compiles in the folder of :func:`choose_compile_cache`."""
    choose_compile_cache()
    numba = sys.modules.get("numba")
    if numba is not None and not _is_users(numba.config.CACHE_DIR):
        # Numba has read the environment already.
        numba.config.CACHE_DIR = os.environ.get(_VARIABLE, "")


def choose_compile_cache(environment: MutableMapping[str, str] = os.environ) -> None:
    """Set ``NUMBA_CACHE_DIR``, which numba reads when it is imported.

    A value set by the user stays, and emptying that folder is up to the user. Otherwise it is a folder
    ``numba-DIGEST``: next to the code if that is writable; else below ``V2V_CACHE_DIR``, or the user's cache folder if
    that is not set; else below the folder for temporary files. Numba alone would try the code and the home folder, and
    fail to start if neither is writable, as in a hardened container.

    If no folder is writable it is not set, and numba reports the problem if it compiles.
    """
    # One of our folders was set by a parent process, which may have started before the sources changed.
    if _is_users(environment.get(_VARIABLE, "")):
        return
    try:
        name = f"numba-{sources_digest()}"
    except PackageNotFoundError:
        return  # without numba nothing is compiled
    for parent in _parents(environment):
        if _can_be_written(parent / name):
            environment[_VARIABLE] = str(parent / name)
            return
    environment.pop(_VARIABLE, None)


def compile_cache(environment: Mapping[str, str] = os.environ) -> tuple[Path, ...]:
    """Return the chosen folder, if there is one."""
    chosen = environment.get(_VARIABLE, "")
    return (Path(chosen),) if chosen else ()


def sources_digest(*folders: Path) -> str:
    """Return a digest of the kernels' sources, the version of numba and the processor: 12 hexadecimal digits."""
    digest = hashlib.sha256(version("numba").encode() + _processor())
    for path in [path for folder in folders or _FOLDERS for path in sorted(folder.rglob("*.py"))]:
        digest.update(path.name.encode() + b"\0" + hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()[:12]


def _processor() -> bytes:
    """Return the processor's model and instruction sets, as far as the system reports them."""
    told = [os.uname().machine]
    with suppress(OSError), PROCESSORS.open(encoding="utf-8", errors="replace") as file:
        told += filter(_KIND.match, takewhile(str.strip, file))  # the first processor's lines end with an empty line
    return "\n".join(told).encode()


def _is_users(folder: str) -> bool:
    return bool(folder) and _OURS.fullmatch(Path(folder).name) is None


def _parents(environment: Mapping[str, str]) -> Iterator[Path]:
    yield SOURCES / "__pycache__"
    if environment.get("V2V_CACHE_DIR"):
        yield Path(environment["V2V_CACHE_DIR"]).absolute()
    elif environment.get("XDG_CACHE_HOME"):
        yield Path(environment["XDG_CACHE_HOME"]).absolute() / "v2v"
    elif (home := os.path.expanduser("~")) != "~":  # a user without an entry in the user database has none
        yield Path(home) / ".cache" / "v2v"
    try:
        temporary = Path(tempfile.gettempdir()) / f"v2v-{os.getuid()}"
    except FileNotFoundError:
        return  # no folder is writable
    # Numba unpickles the files it finds, and any user could have written them here.
    if _is_private(temporary):
        yield temporary


def _is_private(folder: Path) -> bool:
    """Create the folder if it is missing; return whether other users cannot write to it."""
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
    except OSError:
        return False
    return stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o022


def _can_be_written(folder: Path) -> bool:
    """Create the folder if it is missing; return whether it is writable."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return False
    return os.access(folder, os.W_OK | os.X_OK)


if TYPE_CHECKING:
    import cv2 as cv2
else:

    class _OpenCV:
        """OpenCV, imported on first use.

        A worker whose samples have no flow and are not resized does not need OpenCV, and starts without its 30 MB. A
        module that uses a part of OpenCV at import time, as a default value or a constant, would load it for all: use
        ``cv2.NAME`` inside functions only.
        """

        def __getattr__(self, name: str) -> Any:
            import cv2

            value = getattr(cv2, name)
            setattr(self, name, value)  # the next access does not call this function
            return value

    cv2 = _OpenCV()
