"""An address in object storage: what lies below it, and getting one object of it.

Each store has exceptions of its own; here they become three: gone, denied, and everything else, which may pass.
"""

from __future__ import annotations

import hashlib
import random
import re
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from pathlib import Path, PurePosixPath
from typing import Any, TypeVar

from v2v_protocol.errors import CorpusError, ProtocolError, UsageError

T = TypeVar("T")

TRIES = 3
_FIRST_WAIT_SECONDS = 0.5
_MARKS = ("ETag", "etag", "md5Hash", "generation", "blob_id", "mtime", "created")
"""What names a state of an object, in the words of S3, Google, Hugging Face, a disk, memory."""
_OPTIONS: dict[str, dict[str, Any]] = {
    # Listings are asked for anew: an object that was deleted shall be missed. We try again ourselves.
    "s3": {"use_listings_cache": False, "config_kwargs": {"connect_timeout": 5, "read_timeout": 15}},
    "gs": {"use_listings_cache": False},
    "hf": {"use_listings_cache": False},
}
_CREDENTIALS = re.compile("credential|token|unauthorized|forbidden|accesskey", re.IGNORECASE)


class ObjectGone(Exception):
    """The store says that there is no such object."""


class AccessDenied(Exception):
    """The store lets nobody in, or not us."""


class StoreFault(Exception):
    """The store, or the way to it, failed: that may pass."""


@dataclass(frozen=True, slots=True)
class ObjectState:
    """What tells one state of an object from another.

    Attributes:
        size_bytes: of the object.
        mark: 63 bits that stand for its ETag, or for what its store has instead.
    """

    size_bytes: int
    mark: int


def is_url(source: str) -> bool:
    """Whether a corpus is named by an address rather than a path."""
    return re.match(r"[a-z][a-z0-9+.-]+://", source) is not None


class Bucket:
    """An address such as ``s3://bucket/prefix``. Who may read it is found out as its store's own tools do: environment,
    profile, role of the machine. Can be pickled.

    Args:
        url: the address.

    Raises:
        UsageError: it holds a password, which would be shown wherever the address is.
    """

    def __init__(self, url: str) -> None:
        self.url = url.rstrip("/")
        if "@" in self.url.partition("://")[2].partition("/")[0]:
            raise UsageError("--videos: leave user and password out of the address; its store's own settings hold them")

    def __reduce__(self) -> tuple[type[Bucket], tuple[str]]:
        return Bucket, (self.url,)

    @cached_property
    def _store(self) -> Any:
        """
        Raises:
            UsageError: a package lacks, or nobody knows such addresses.
        """
        kind = self.url.partition("://")[0]
        try:
            store = import_module("fsspec").filesystem(kind, **_OPTIONS.get(kind, {}))
        except ImportError as error:
            raise UsageError(
                f"--videos {self.url}: {error}; the extra 'cloud' brings fsspec and s3fs: pip install "
                "'.[server,cloud]' in a checkout of v2v-stream. Other stores need a package more: gcsfs for gs://, "
                "huggingface_hub for hf://"
            ) from error
        except ValueError as error:
            raise UsageError(f"--videos {self.url}: {error}") from error
        if hasattr(store, "retries"):
            store.retries = 1
        return store

    @cached_property
    def _prefix(self) -> str:
        return str(self._store._strip_protocol(self.url)).rstrip("/")

    def objects(self) -> dict[str, ObjectState]:
        """All objects below the address, by their relative paths.

        Raises:
            CorpusError: they cannot be listed.
        """
        try:
            found = self._ask(lambda: self._store.find(self._prefix, detail=True))
        except ObjectGone as error:
            raise CorpusError(f"--videos {self.url}: there is no such bucket or prefix") from error
        except AccessDenied as error:
            raise CorpusError(
                f"--videos {self.url}: access is denied ({error}): give this user credentials of the store as its own "
                "tools take them (for s3:// AWS_PROFILE, or AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY; and "
                "AWS_ENDPOINT_URL where it is not Amazon's) that may list and read"
            ) from error
        except StoreFault as error:
            raise CorpusError(f"--videos {self.url}: cannot be listed: {error}") from error
        start = f"{self._prefix}/"
        return {path[len(start) :]: _state(info) for path, info in found.items() if path.startswith(start)}

    def state(self, id: str, tries: int = TRIES) -> ObjectState:
        """Of one object.

        Raises:
            ObjectGone, AccessDenied, StoreFault: see there.
        """
        return self._ask(lambda: _state(self._store.info(self._path(id))), tries)

    def fetch(self, id: str, to: Path) -> None:
        """Writes an object into a file.

        Raises:
            ObjectGone, AccessDenied, StoreFault: see there.
        """
        self._ask(lambda: self._store.get_file(self._path(id), str(to)))

    def _path(self, id: str) -> str:
        if PurePosixPath(id).is_absolute() or ".." in PurePosixPath(id).parts:
            raise ProtocolError(f"video id {id!r} leads out of {self.url}")
        return f"{self._prefix}/{id}"

    def _ask(self, question: Callable[[], T], tries: int = TRIES) -> T:
        """An answer of the store, which is asked again after a pause that doubles where that may help."""
        self._store  # noqa: B018 - what lacks here is no fault of the store's
        for left in reversed(range(tries)):
            try:
                return question()
            except ProtocolError:
                raise
            except FileNotFoundError as error:
                raise ObjectGone("the store has no such object") from error
            except Exception as error:
                said = " ".join(f"{type(error).__name__}: {error}".split())[:300]
                if isinstance(error, PermissionError) or _CREDENTIALS.search(type(error).__name__):
                    raise AccessDenied(said) from error
                if not left:
                    raise StoreFault(said) from error
            time.sleep(_FIRST_WAIT_SECONDS * 2 ** (tries - left - 1) * random.uniform(1, 1.5))
        raise AssertionError


def _state(info: dict[str, Any]) -> ObjectState:
    mark = next((str(info[key]) for key in _MARKS if info.get(key) is not None), "")
    return ObjectState(int(info["size"]), int.from_bytes(hashlib.sha256(mark.encode()).digest()[:8]) >> 1)
