"""An address in object storage: list the objects below it, and get one of them.

Each store has exceptions of its own. Here they become the three of every source: gone, denied, and everything else,
which may pass.
"""

from __future__ import annotations

import hashlib
import random
import re
import time
from collections.abc import Callable
from functools import cached_property
from importlib import import_module
from pathlib import Path, PurePosixPath
from typing import Any, TypeVar

from v2v_protocol.errors import CorpusError, ProtocolError, UsageError, VideoDenied, VideoGone, VideoUnreadable
from v2v_server.corpus.sources.source import FileState

T = TypeVar("T")

TRIES = 3
_FIRST_WAIT_SECONDS = 0.5
_MARKS = ("ETag", "etag", "md5Hash", "generation", "blob_id", "mtime", "created")
"""What names a state of an object: the terms of S3, Google, Hugging Face, a disk, memory."""
_OPTIONS: dict[str, dict[str, Any]] = {
    # No cached listings: they would hide that an object was deleted. We retry ourselves.
    "s3": {"use_listings_cache": False, "config_kwargs": {"connect_timeout": 5, "read_timeout": 15}},
    "gs": {"use_listings_cache": False},
    "hf": {"use_listings_cache": False},
}
_CREDENTIALS = re.compile("credential|token|unauthorized|forbidden|accesskey", re.IGNORECASE)


def is_url(source: str) -> bool:
    """Return whether a corpus is named by an address rather than a path."""
    return re.match(r"[a-z][a-z0-9+.-]+://", source) is not None


class Bucket:
    """An address such as ``s3://bucket/prefix``. Credentials are found as the store's own tools find them: environment,
    profile, role of the machine. Can be pickled.

    Args:
        url: the address.

    Raises:
        UsageError: it contains a password, which would be shown wherever the address is.
    """

    def __init__(self, url: str) -> None:
        self.url = url.rstrip("/")
        if "@" in self.url.partition("://")[2].partition("/")[0]:
            raise UsageError("--videos: leave user and password out of the address; its store's own settings hold them")

    def __reduce__(self) -> tuple[type[Bucket], tuple[str]]:
        return Bucket, (self.url,)

    @cached_property
    def _store(self) -> Any:
        """Return the file system of fsspec.

        Raises:
            UsageError: a package is missing, or fsspec has no such kind of address.
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

    def objects(self) -> dict[str, FileState]:
        """Return the states of all objects below the address, by relative path.

        Raises:
            CorpusError: they cannot be listed.
        """
        try:
            return self.find("")
        except VideoGone as error:
            raise CorpusError(f"--videos {self.url}: there is no such bucket or prefix") from error
        except VideoDenied as error:
            raise CorpusError(
                f"--videos {self.url}: {error.reason}: give this user credentials of the store as its own "
                "tools take them (for s3:// AWS_PROFILE, or AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY; and "
                "AWS_ENDPOINT_URL where it is not Amazon's) that may list and read"
            ) from error
        except VideoUnreadable as error:
            raise CorpusError(f"--videos {self.url}: cannot be listed: {error.reason}") from error

    def find(self, below: str, tries: int = TRIES) -> dict[str, FileState]:
        """Return the states of all objects below a folder of the address, "" or ending in a slash, by relative path.

        Raises:
            VideoGone, VideoDenied, VideoUnreadable: they cannot be listed.
        """
        start = f"{self._prefix}/{below}"
        listed = self._ask(below, lambda: self._store.find(start.rstrip("/"), detail=True), tries)
        found = {path[len(start) :]: _state(info) for path, info in listed.items() if path.startswith(start)}
        if below and not found:
            raise VideoGone(below, None, f"is not in {self.url} any more")
        return found

    def state(self, id: str, tries: int = TRIES) -> FileState:
        """Ask for the state of one object: its size, and 63 bits that stand for its ETag or the store's equivalent.

        Raises:
            VideoGone, VideoDenied, VideoUnreadable: the store does not deliver it.
        """
        return self._ask(id, lambda: _state(self._store.info(self._path(id))), tries)

    def fetch(self, id: str, to: Path) -> None:
        """Write an object to a file.

        Raises:
            VideoGone, VideoDenied, VideoUnreadable: the store does not deliver it.
        """
        self._ask(id, lambda: self._store.get_file(self._path(id), str(to)))

    def _path(self, id: str) -> str:
        if PurePosixPath(id).is_absolute() or ".." in PurePosixPath(id).parts:
            raise ProtocolError(f"video id {id!r} leads out of {self.url}")
        return f"{self._prefix}/{id}"

    def _ask(self, id: str, question: Callable[[], T], tries: int = TRIES) -> T:
        """Return an answer of the store. A question that may succeed later is repeated after a pause that doubles."""
        self._store  # noqa: B018 - errors of the installation are not the store's
        for left in reversed(range(tries)):
            try:
                return question()
            except ProtocolError:
                raise
            except FileNotFoundError as error:
                raise VideoGone(id, None, f"is not in {self.url} any more") from error
            except Exception as error:
                said = " ".join(f"{type(error).__name__}: {error}".split())[:300]
                if isinstance(error, PermissionError) or _CREDENTIALS.search(type(error).__name__):
                    raise VideoDenied(id, None, f"access is denied ({said})") from error
                if not left:
                    raise VideoUnreadable(
                        id, None, f"the store gives no answer ({said}; tried {tries} times)"
                    ) from error
            time.sleep(_FIRST_WAIT_SECONDS * 2 ** (tries - left - 1) * random.uniform(1, 1.5))
        raise AssertionError


def _state(info: dict[str, Any]) -> FileState:
    mark = next((str(info[key]) for key in _MARKS if info.get(key) is not None), "")
    return int(info["size"]), int.from_bytes(hashlib.sha256(mark.encode()).digest()[:8]) >> 1, 0
