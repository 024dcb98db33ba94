"""Probe many files in processes of their own, so that a file that kills its reader costs only itself."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Generator, Iterable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np

from v2v_protocol.errors import VideoError, VideoUnreadable
from v2v_server.corpus.index import IndexRow
from v2v_server.corpus.sources.source import VideoSource
from v2v_server.store.pixels import kind_of, open_pixels
from v2v_server.system.isolate import Died, run_twice
from v2v_server.video.fingerprint import fingerprint
from v2v_server.video.probe import VideoFacts

LONGEST_SECONDS = 3600.0
"""Limit for reading a whole file, also on slow storage; beyond it the file is treated as endless."""

LARGEST_PROBE_BYTES = 2 << 30
"""Memory that a process may allocate to probe a file: enough for 16 pictures of the largest size, or a list of 2**24
frames. A file of some kB can claim a thousand million frames, for which a demuxer would allocate memory."""

_MOST_TOGETHER = 1024
_MOST_SECONDS = 10.0
VideoProgress = Callable[[int, int], None]
"""(files done so far, files to do)."""
ProbeFile = Callable[[VideoSource, str], IndexRow]
"""(source, id) -> what is known of that file; see :func:`probe_file`."""
T = TypeVar("T")


def probe_file(source: VideoSource, id: str) -> IndexRow:
    """Probe one file; an error becomes the record's ``problem``.

    A file that cannot be read gets the size -1, which no file has: it is probed again at the next start.
    """
    if kind_of(id) == "photographs" and not source.kind.is_rendered:
        return IndexRow(id, -1, problem="is a picture: add --videos-kind photographs")
    try:
        before = source.state(id)
        with source.open_local(id, "") as path:
            mark = fingerprint(path)
            facts = _timed(_facts(path, source.kind.videos_kind), source, id)
        name = facts.made_of or (f"{mark}-{facts.content}" if facts.content else mark)
        if source.state(id) != before:
            return IndexRow(id, -1, problem="changes while it is read; the next start tries again")
        source.keep_as(id, mark, name)
    except OSError as error:
        return IndexRow(id, -1, problem=f"cannot be read: {error.strerror or error}")
    except VideoUnreadable as error:
        return IndexRow(id, -1, problem=error.reason)
    except VideoError as error:
        where = "" if error.frame is None else f"frame {error.frame}: "
        return IndexRow(id, *before, problem=where + error.reason)
    except Exception as error:  # noqa: BLE001 - one strange file must not end the probing of all others
        return IndexRow(id, *before, problem=f"probing failed: {type(error).__name__}: {error}")
    return IndexRow(
        id,
        *before,
        fingerprint=name,
        frames=facts.frames,
        width_px=facts.width_px,
        height_px=facts.height_px,
        frames_per_second=None if math.isnan(facts.frames_per_second) else facts.frames_per_second,
        codec=facts.codec,
        interlaced=facts.interlaced,
        remark=facts.remark,
        frame_index=facts.index.to_bytes(),
    )


def facts_of(path: Path, kind: str = "videos") -> VideoFacts:
    """Return what is known of the video in a file. Errors: :class:`v2v_server.store.pixels.Pixels`."""
    with open_pixels(path, kind) as pixels:
        return pixels.facts()


def _timed(facts: VideoFacts, source: VideoSource, id: str) -> VideoFacts:
    """Return the facts of pictures that follow each other at a rate that the user states, if they state no times; those
    of a photograph, of all frames that it is shown for.
    """
    rate, frames = source.rate(id), source.kind.frames if source.kind.is_rendered else facts.frames
    if not rate or facts.index.seekable:
        return facts
    index = facts.index.timed(np.rint(np.arange(frames) * 1e9 / rate).astype(np.int64))
    content = f"{facts.content}@{rate:g}"
    return replace(facts, frames=frames, frames_per_second=rate, index=index, content=content)


def _facts(path: Path, kind: str) -> VideoFacts:
    """Return what is known of the video; retry once after an error of the system rather than of the decoder.

    Raises:
        VideoUnreadable: the system reported an error twice.
        VideoError: the file is not a supported video.
    """
    for is_last in (False, True):
        try:
            return facts_of(path, kind)
        except VideoError as error:
            if not isinstance(error.__cause__, OSError):
                raise
            if is_last:
                raise VideoUnreadable(error.video, error.frame, error.reason) from error
    raise AssertionError("the last try returns or raises")


def probe_files(
    source: VideoSource,
    ids: Iterable[str],
    processes: int,
    probe: ProbeFile = probe_file,
    longest_seconds: float = LONGEST_SECONDS,
) -> Generator[IndexRow, None, None]:
    """Yield a record of each id, in any order.

    A file at which a process died is probed once more after all others, alone.

    Args:
        source: where the videos come from.
        ids: relative paths.
        processes: number of processes to probe in; 0 probes in this one, which a file that crashes the decoder ends.
        probe: probes one file; must be picklable.
        longest_seconds: limit for one file; the next start tries it again.
    """
    results = run_twice(
        partial(probe, source),
        ids,
        processes,
        deadline_seconds=lambda id: longest_seconds,
        memory_bytes=LARGEST_PROBE_BYTES,
        writable=() if source.is_local else None,  # copies are fetched: from a network, into a folder
    )
    for id, found in results:
        yield _culprit(source, id, found) if isinstance(found, Died) else replace(found, id=id)


def _culprit(source: VideoSource, id: str, death: Died) -> IndexRow:
    if death.overdue_seconds:
        return IndexRow(id, -1, problem=f"cannot be probed: {death.how}; the next start tries again")
    if not death.is_crash:
        why = f"could not be probed: the process ended over it twice ({death.how}), which says nothing of the file"
        return IndexRow(id, -1, problem=f"{why}; the next start tries again")
    why = f"crashes the decoder: the process that probed it died ({death.how})"
    try:
        return IndexRow(id, *source.state(id), problem=why)
    except VideoUnreadable:
        return IndexRow(id, -1, problem=why)  # gone meanwhile; if it comes back, it is probed again


def batches(
    items: Iterable[T], total: int, progress: VideoProgress | None, clock: Callable[[], float] = time.monotonic
) -> Iterator[list[T]]:
    """Yield items in batches that are written to the index at once: a kill loses at most one.

    Args:
        total: number of items, for ``progress``.
        progress: called after each item.
    """
    batch: list[T] = []
    begun = clock()
    for done, item in enumerate(items, 1):
        batch.append(item)
        if progress is not None:
            progress(done, total)
        if len(batch) == _MOST_TOGETHER or clock() - begun > _MOST_SECONDS:
            yield batch
            batch, begun = [], clock()
    if batch:
        yield batch
