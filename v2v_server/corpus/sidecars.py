"""The sidecars of all videos of a catalogue: what each holds, and whether it fits its video.

The index keeps this, and is believed while sizes and times of the files stay the same. New and changed sidecars are
read in a confined process of their own, under limits of time and memory.
"""

from __future__ import annotations

import hashlib
import sqlite3
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, field
from functools import partial

from v2v_protocol.errors import VideoError
from v2v_protocol.programs import printable
from v2v_server.corpus.index import FigureKind, Figures, Store
from v2v_server.corpus.probe import LARGEST_PROBE_BYTES, LONGEST_SECONDS
from v2v_server.corpus.sources.sidecar import files_between, open_sidecar, read_files, sidecar_id
from v2v_server.corpus.sources.source import Notice, VideoSource, by_parts
from v2v_server.labels.formats import check_labels
from v2v_server.system.isolate import Died, run_isolated

Shape = Callable[[str], tuple[int, int, int]]
"""Number of frames, and height and width of the upright picture, of the video of an id."""
_Job = tuple[str, str, str, int, int, int]
"""Id of the video, id and ending of its sidecar, and the shape of the video."""
_Found = tuple[str, str, str, bytes]
"""Fingerprint, why it is refused, which files are not read, and the table of its files; the texts may be empty."""

_TOGETHER = 64
_LONGEST_REASON = 500
_LARGEST_PART_BYTES = 512 << 10
"""Limit of the files that a lease names: its message has 1 MiB."""


@dataclass(frozen=True, slots=True)
class Sidecars:
    """The sidecars of one ending. The mappings are by the video's id.

    Attributes:
        fingerprints: videos without such a sidecar are missing.
        digest: names all of them.
        states: sizes and times, see :meth:`v2v_server.corpus.sources.source.VideoSource.sidecar_state`.
        problems: why a sidecar is not used.
    """

    fingerprints: Mapping[str, str]
    digest: str
    states: Mapping[str, str] = field(default_factory=dict)
    problems: Mapping[str, str] = field(default_factory=dict)


def sidecar_kind(ending: str) -> FigureKind:
    """Return the kind of figures that holds the sidecars of an ending."""
    return FigureKind(f"sidecar {ending}", "2")


def files_for_lease(data: bytes | None, fingerprint: str, start: int, count: int) -> bytes | str:
    """Return the table of the files of some frames; or why the sidecar cannot be used.

    Args:
        data: what the index holds of the sidecar; None: nothing.
        fingerprint: as catalogued.
        start, count: the frames.
    """
    mark, _, table = (data or b"").partition(b"\n")
    with suppress(ValueError):  # damaged
        if mark == fingerprint.encode():
            part = files_between(table, start, start + count)
            too_long = f"has too many files for a clip of {count} frames: the list of them has {len(part)} bytes"
            return part if len(part) <= _LARGEST_PART_BYTES else f"{too_long}; the limit is {_LARGEST_PART_BYTES}"
    return "differs from the index, which another program changed: restart the server to serve it as it is now"


def collect_sidecars(
    source: VideoSource,
    store: Store,
    videos: Mapping[str, str],
    shape: Shape,
    endings: Sequence[str],
    processes: int,
    notice: Notice | None,
) -> tuple[dict[str, Sidecars], list[str]]:
    """Return the sidecars of each ending, and notes for the user. Only new and changed ones are read.

    Args:
        source: where the videos come from.
        store: the index.
        videos: fingerprint of each video's file, by id.
        shape: of each video.
        endings: see :mod:`v2v_server.corpus.sources.sidecar`.
        processes: number of processes that read; 0 reads in this one.
        notice: progress callback.
    """
    sidecars, notes = dict[str, Sidecars](), list[str]()
    for ending, ids in source.with_sidecars(sorted(videos), endings).items():
        states = _states(source, ending, ids, notice) if ids else {}
        problems = {video: _line(state) for video, state in states.items() if isinstance(state, OSError)}
        present = {video: state for video, state in states.items() if isinstance(state, str) and state}
        found = _known(store, ending, present) if present else {}
        jobs = [(video, sidecar_id(video, ending), ending, *shape(video)) for video in present if video not in found]
        for video, facts in _read(source, store, ending, jobs, present, videos, processes, notice):
            found[video] = facts
        problems |= {video: facts[1] for video, facts in found.items() if facts[1]}
        fingerprints = {video: found[video][0] for video in sorted(found) if found[video][0]}
        sidecars[ending] = Sidecars(fingerprints, _digest(ending, fingerprints), present, problems)
        missing = [
            f"{sidecar_id(video, ending)}: {why}" for video, why in problems.items() if video not in fingerprints
        ]
        refused = [f"{video}: {why}" for video, why in problems.items() if video in fingerprints]
        not_read = [f"{sidecar_id(video, ending)}: {facts[2]}" for video, facts in found.items() if facts[2]]
        notes += [f"{len(fingerprints)} of {len(videos)} videos have a sidecar {ending}"] if fingerprints else []
        notes += [
            f"{len(those)} sidecars {text} ({those[0]})"
            for those, text in (
                (missing, "cannot be read and count as missing"),
                (refused, f"{ending} are refused, and their videos are served without these labels"),
                (not_read, f"{ending} have files that are no labels"),
            )
            if those
        ]
    return sidecars, notes


def _states(source: VideoSource, ending: str, ids: Sequence[str], notice: Notice | None) -> dict[str, str | OSError]:
    """Return the state of each video's sidecar, or why it cannot be told."""

    def states(part: Sequence[str]) -> list[str | OSError]:
        return [source.sidecar_state(sidecar_id(video, ending)) for video in part]

    found = dict[str, str | OSError]()
    with closing(by_parts(states, ids)) as answered:
        for part, those in answered:
            found.update(zip(part, those, strict=True))
            if notice is not None:
                notice(f"looking for sidecars {ending} in {source}: {len(found)} of {len(ids)} videos")
    return found


def _known(store: Store, ending: str, states: Mapping[str, str]) -> dict[str, list[str]]:
    """Return the facts of unchanged sidecars from the index."""
    with suppress(sqlite3.Error):  # an index that cannot be read costs time only
        store.make_figures()
        rows = ((row[0], row[-1]) for row in store.rows(sidecar_kind(ending)))
        entries = {id: data.decode("utf-8", "replace").split("\n") for id, data in rows if isinstance(data, bytes)}
        return {id: entry[1:] for id, entry in entries.items() if entry[0] == states.get(id) and len(entry) == 4}
    return {}


def _read(
    source: VideoSource,
    store: Store,
    ending: str,
    jobs: Sequence[_Job],
    states: Mapping[str, str],
    videos: Mapping[str, str],
    processes: int,
    notice: Notice | None,
) -> Iterator[tuple[str, list[str]]]:
    """Read new and changed sidecars, put what is found into the index, and yield it: (video, facts)."""
    isolated = run_isolated(
        partial(read_sidecar, source),
        jobs,
        processes,
        deadline_seconds=lambda job: LONGEST_SECONDS,
        memory_bytes=LARGEST_PROBE_BYTES,
        writable=() if source.is_local else None,  # copies are fetched: from a network, into a folder
    )
    fresh = list[Figures]()
    try:
        for done, ((video, id, *_), result) in enumerate(isolated, 1):
            if notice is not None:
                notice(f"read {id}, {done} of {len(jobs)} new or changed sidecars {ending}")
            died = (
                f"reading it took too much time or memory, or crashed ({result.how})"
                if isinstance(result, Died)
                else ""
            )
            *facts, table = ("", died, "", b"") if isinstance(result, Died) else result
            if facts[0]:
                text, mark = "\n".join((states[video], *facts)), facts[0].encode() + b"\n"
                fresh.append(Figures(video, videos[video], text.encode(), mark + table))
            if len(fresh) == _TOGETHER:
                _save(store, ending, fresh)
            yield video, facts
    finally:
        _save(store, ending, fresh)  # also of an interrupted start


def _save(store: Store, ending: str, fresh: list[Figures]) -> None:
    with suppress(sqlite3.Error):  # the next start reads them again; until then leases refuse folders, in words
        store.put_figures(sidecar_kind(ending), fresh)
    fresh.clear()


def _digest(ending: str, fingerprints: Mapping[str, str]) -> str:
    sha = hashlib.sha256(f"v2v sidecars 1\n{ending}\n".encode())
    for id in sorted(fingerprints):
        sha.update(f"{id}\0{fingerprints[id]}\n".encode())
    return sha.hexdigest()[:32]


def read_sidecar(source: VideoSource, job: _Job) -> _Found:
    """Read a sidecar whole, and check that it fits its video; an error becomes the reason why it is not used."""
    _, id, ending, frames, height_px, width_px = job
    mark, table = "", b""
    try:
        with open_sidecar(source, id, "") as opened:
            mark, table = read_files(opened)
            return mark, "", _line(check_labels(ending, opened, (height_px, width_px), frames)), table
    except Exception as error:  # noqa: BLE001 - one strange file must not end the reading of all others
        is_unread = isinstance(error, OSError | VideoError)  # may pass: the next start tries again
        return "" if is_unread else mark, _line(error), "", table


def _line(text: Exception | str) -> str:
    """Return a text, or what an error says, for people: one line, not too long."""
    plain = text.reason if isinstance(text, VideoError) else getattr(text, "strerror", None) or str(text)
    if isinstance(text, Exception) and not isinstance(text, OSError | VideoError | ValueError):
        plain = f"reading it failed ({type(text).__name__}: {plain})"
    return printable(plain.replace("\n", " "))[:_LONGEST_REASON]
