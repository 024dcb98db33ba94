"""Bytes of an object in a store, read as a stream, with the state of the object that they are of.

The answers of S3 and of HTTP servers say which state of an object they deliver. So one question gives bytes and state,
and no other one can come in between. Of other stores the state is asked for before and afterwards.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from importlib import import_module
from typing import IO, Any

from v2v_protocol.errors import VideoUnreadable

PART_BYTES = 1 << 20
ReadBytes = Callable[[int], bytes]
"""Returns the next bytes, at most as many as asked for; none at the end."""


@contextmanager
def open_part(store: Any, path: str, start: int, end: int) -> Iterator[tuple[ReadBytes, Mapping[str, Any] | None]]:
    """Lend what reads bytes ``start .. end - 1`` of an object, and what the answer says of the object.

    It may read on, where a store knows no end. What the answer says is None if it says nothing, else ``size`` in bytes
    and marks such as ``ETag``.

    Args:
        store: a file system of fsspec.
        end: 0 reads to the end of the object.

    Raises:
        VideoUnreadable: the server does not send parts of files.
        Exception: an error of the store.
    """
    kind = store.protocol if isinstance(store.protocol, str) else store.protocol[0]
    sync: Any = import_module("fsspec.asyn").sync
    asked = f"bytes={start}-{end - 1}" if end else ""
    if kind == "s3":
        bucket, key, _ = store.split_path(path)
        answer = sync(
            store.loop, store._call_s3, "get_object", Bucket=bucket, Key=key, **({"Range": asked} if asked else {})
        )
        body, told = answer["Body"], {"ETag": answer["ETag"]}
        length, part = answer["ContentLength"], answer.get("ContentRange", "")
        read = partial(sync, store.loop, body.read)
        close = partial(store.loop.call_soon_threadsafe, body.close)
    elif kind == "http":
        # An encoded answer has other bytes, and often another mark. The size is not used, but would be asked for.
        headers = {"Accept-Encoding": "identity", **({"Range": asked} if asked else {})}
        file = store.open(path, block_size=0, size=1, headers=headers)
        told = {name: file.r.headers.get(name) for name in ("ETag", "Last-Modified")}
        length, part = file.r.headers.get("Content-Length"), file.r.headers.get("Content-Range", "")
        read, close = file.read, file.close
    else:
        with store.open(path, "rb", block_size=PART_BYTES, cache_type="none") as file:
            file.seek(start)
            yield file.read, None
        return
    try:
        if asked and not part:
            raise VideoUnreadable(path, None, "its server sends whole files only: copy the archives to a disk")
        yield read, told | {"size": part.rpartition("/")[2] if part else length}
    finally:
        close()


def copy_bytes(read: ReadBytes, file: IO[bytes], size: int) -> None:
    """Write the next bytes to a file.

    Raises:
        EOFError: there are fewer.
    """
    while size:
        if not (block := read(min(size, PART_BYTES))):
            raise EOFError("its answer ends early")
        file.write(block)
        size -= len(block)


def inflate(read: ReadBytes, file: IO[bytes], size: int) -> None:
    """Write what the next bytes stand for, which are deflated.

    Args:
        size: of what they stand for, as their archive states it, bytes: no more are written.

    Raises:
        EOFError: there are fewer.
        ValueError: they stand for more bytes, or fewer.
        zlib.error: they are damaged.
    """
    inflater, left = zlib.decompressobj(-zlib.MAX_WBITS), size
    while not inflater.eof:
        if not (data := inflater.unconsumed_tail or read(PART_BYTES)):
            raise EOFError("its answer ends early")
        block = inflater.decompress(data, PART_BYTES)
        if (left := left - len(block)) < 0:
            break
        file.write(block)
    if left:
        raise ValueError(f"it has {'more' if left < 0 else 'fewer'} than the {size} bytes that its archive states")
