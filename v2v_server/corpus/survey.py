"""Probing many files in processes of their own, so that a file that kills its reader costs only itself."""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Iterable
from functools import partial
from pathlib import Path

from v2v_protocol.errors import VideoError, VideoUnreadable
from v2v_server.corpus.index.file import IndexRow
from v2v_server.corpus.sources.source import VideoSource
from v2v_server.store.clips import facts_of
from v2v_server.system.isolate import Died, run_isolated
from v2v_server.video.fingerprint import fingerprint
from v2v_server.video.probe import VideoFacts

LONGEST_SECONDS = 3600.0
"""For reading a file from end to end, on slow storage: who needs longer waits for a file that never comes."""

LARGEST_MEMORY_BYTES = 2 << 30
"""What a process may allocate to examine a file: enough for 16 pictures of the largest size, or a list of 2**24 frames.
A file of some kB can claim a thousand million frames, for which a demuxer would make room."""

Examine = Callable[[VideoSource, str], IndexRow]
"""(source, id) -> what is known of that file; see :func:`examine`."""


def examine(source: VideoSource, id: str) -> IndexRow:
    """What is known of one file. Never raises: what goes wrong is the record's ``problem``.

    A file that cannot be read gets the size -1, which no file has: it is looked at again next time.
    """
    try:
        before = source.state(id)
        with source.open_local(id, "") as path:
            mark = fingerprint(path)
            facts = _facts(path)
        if source.state(id) != before:
            return IndexRow(id, -1, problem="changes while it is read; the next start tries again")
    except OSError as error:
        return IndexRow(id, -1, problem=f"cannot be read: {error.strerror or error}")
    except VideoUnreadable as error:
        return IndexRow(id, -1, problem=error.reason)
    except VideoError as error:
        where = "" if error.frame is None else f"frame {error.frame}: "
        return IndexRow(id, *before, problem=where + error.reason)
    except Exception as error:  # noqa: BLE001 - one strange file must not end the survey of all others
        return IndexRow(id, *before, problem=f"probing failed: {type(error).__name__}: {error}")
    return IndexRow(
        id,
        *before,
        fingerprint=f"{mark}-{facts.content}" if facts.content else mark,
        frames=facts.frames,
        width_px=facts.width_px,
        height_px=facts.height_px,
        frames_per_second=None if math.isnan(facts.frames_per_second) else facts.frames_per_second,
        codec=facts.codec,
        interlaced=facts.interlaced,
        frame_index=facts.index.to_bytes(),
    )


def _facts(path: Path) -> VideoFacts:
    """What is known of the video; an error of the system, rather than of the decoder, has to come twice.

    Raises:
        VideoUnreadable: it came twice.
        VideoError: the file is no video that this program serves.
    """
    try:
        return facts_of(path)
    except VideoError as error:
        if not isinstance(error.__cause__, OSError):
            raise
    try:
        return facts_of(path)
    except VideoError as error:
        if isinstance(error.__cause__, OSError):
            raise VideoUnreadable(error.video, error.frame, error.reason) from error
        raise


def survey(
    source: VideoSource,
    ids: Iterable[str],
    processes: int,
    examine: Examine = examine,
    longest_seconds: float = LONGEST_SECONDS,
) -> Generator[IndexRow, None, None]:
    """A record for each id, in any order.

    A file at which a process died is examined once more when all others are done, alone: the process may have been
    killed from outside, or the memory may not have sufficed for it and its neighbours.

    Args:
        source: where the videos come from.
        ids: relative paths.
        processes: processes to probe in, spawned and ended here; 0 probes in this one, where a file that crashes the
            decoder takes the caller along.
        examine: what is done with each file; must be picklable.
        longest_seconds: a process that is at a file for longer is ended; the next start tries that file again.
    """
    isolated = partial(
        run_isolated,
        partial(examine, source),
        deadline_seconds=lambda id: longest_seconds,
        memory_bytes=LARGEST_MEMORY_BYTES,
        writable=() if source.is_local else None,  # copies are fetched: from a network, into a folder
    )
    suspects: list[str] = []
    for id, found in isolated(ids, processes):
        if isinstance(found, Died) and found.overdue_seconds:
            yield IndexRow(id, -1, problem=f"cannot be probed: {found.how}; the next start tries again")
        elif isinstance(found, Died):
            suspects.append(id)
        else:
            yield found
    for id, found in isolated(suspects, 1):
        yield _culprit(source, id, found) if isinstance(found, Died) else found


def _culprit(source: VideoSource, id: str, death: Died) -> IndexRow:
    if not death.is_crash:
        why = f"could not be probed: the process ended over it twice ({death.how}), which says nothing of the file"
        return IndexRow(id, -1, problem=f"{why}; the next start tries again")
    why = f"crashes the decoder: the process that probed it died ({death.how})"
    try:
        return IndexRow(id, *source.state(id), problem=why)
    except VideoUnreadable:
        return IndexRow(id, -1, problem=why)  # gone meanwhile; should it come back, it is looked at again
