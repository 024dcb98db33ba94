"""Probing many files in processes of their own, so that a file that kills its reader costs only itself."""

from __future__ import annotations

import math
import multiprocessing
import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

from v2v_protocol.errors import VideoError
from v2v_server.video.fingerprint import fingerprint
from v2v_server.video.probe import probe
from v2v_server.video.store import Record

_BATCH = 16

Examine = Callable[[str, str], Record]
"""(root, id) -> what is known of that file; see :func:`examine`."""


def examine(root: str, id: str) -> Record:
    """What is known of one file. Never raises: what goes wrong is the record's ``problem``.

    A file that cannot be read gets the size -1, which no file has: it is looked at again next time.
    """
    path = Path(root, id)
    try:
        status = path.stat()
        mark = fingerprint(path)
    except OSError as error:
        return Record(id, -1, 0, problem=f"cannot be read: {error.strerror or error}")
    except VideoError as error:
        return Record(id, -1, 0, problem=error.reason)
    size, mtime = status.st_size, status.st_mtime_ns
    try:
        facts = probe(path)
    except VideoError as error:
        where = "" if error.frame is None else f"frame {error.frame}: "
        return Record(id, size, mtime, problem=where + error.reason)
    except Exception as error:  # noqa: BLE001 - one strange file must not end the survey of all others
        return Record(id, size, mtime, problem=f"probing failed: {type(error).__name__}: {error}")
    return Record(
        id=id,
        size_bytes=size,
        mtime_ns=mtime,
        fingerprint=mark,
        frames=facts.frames,
        width_px=facts.width_px,
        height_px=facts.height_px,
        frames_per_second=None if math.isnan(facts.frames_per_second) else facts.frames_per_second,
        codec=facts.codec,
        frame_index=facts.index.to_bytes(),
    )


def survey(root: Path, ids: Sequence[str], processes: int, examine: Examine = examine) -> Iterator[Record]:
    """A record for each id, in any order.

    Args:
        root: the folder that ids are relative to.
        ids: relative paths.
        processes: processes to probe in, spawned and ended here; 0 probes in this one, where a file that crashes the
            decoder takes the caller along.
        examine: what is done with each file; must be picklable.
    """
    if processes == 0:
        yield from (examine(os.fspath(root), id) for id in ids)
        return
    batches = deque(ids[at : at + _BATCH] for at in range(0, len(ids), _BATCH))
    suspects: list[str] = []
    with _pool(processes) as pool:
        waiting: dict[Future[list[Record]], Sequence[str]] = {}
        while batches or waiting:
            while batches and len(waiting) < 2 * processes:
                batch = batches.popleft()
                try:
                    waiting[pool.submit(_examine_all, examine, os.fspath(root), batch)] = batch
                except BrokenProcessPool:
                    suspects.extend(batch)
            for done in wait(waiting, return_when=FIRST_COMPLETED).done if waiting else ():
                batch = waiting.pop(done)
                try:
                    yield from done.result()
                except BrokenProcessPool:
                    suspects.extend(batch)
    yield from _one_by_one(root, suspects, examine)


def _one_by_one(root: Path, ids: Sequence[str], examine: Examine) -> Iterator[Record]:
    """The same with a single process that has one file at a time: whoever dies, dies of that file."""
    left = deque(ids)
    while left:
        with _pool(1) as pool:
            while left:
                id = left.popleft()
                try:
                    yield pool.submit(examine, os.fspath(root), id).result()
                except BrokenProcessPool:
                    yield _culprit(root, id)
                    break


def _culprit(root: Path, id: str) -> Record:
    why = "crashes the decoder: the process that probed it died"
    try:
        status = Path(root, id).stat()
    except OSError:
        return Record(id, -1, 0, problem=why)  # gone meanwhile; should it come back, it is looked at again
    return Record(id, status.st_size, status.st_mtime_ns, problem=why)


def _pool(processes: int) -> ProcessPoolExecutor:
    return ProcessPoolExecutor(processes, multiprocessing.get_context("spawn"))


def _examine_all(examine: Examine, root: str, ids: Sequence[str]) -> list[Record]:
    return [examine(root, id) for id in ids]
