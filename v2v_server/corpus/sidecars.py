"""The sidecars of all videos of a catalogue: what each holds, and whether it fits its video.

The index keeps this, and is believed while sizes and times of the files stay the same. New and changed sidecars are
read in a confined process of their own, under limits of time and memory.
"""

from __future__ import annotations

import hashlib
import sqlite3
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, field
from functools import partial

from v2v_protocol.errors import VideoError
from v2v_server.corpus.index.file import FigureKind, Figures, Store
from v2v_server.corpus.probe import LARGEST_MEMORY_BYTES, LONGEST_SECONDS
from v2v_server.corpus.sources.asking import Notice, by_parts
from v2v_server.corpus.sources.names import printable
from v2v_server.corpus.sources.sidecar import files_between, open_sidecar, read_files, sidecar_id
from v2v_server.corpus.sources.source import VideoSource
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


def files_kind(ending: str) -> FigureKind:
    """Return the kind of figures that holds the files of sidecars, see :func:`files_for_lease`."""
    return FigureKind(f"files of {ending}", "1")


def files_for_lease(data: bytes | None, fingerprint: str, start: int, count: int) -> bytes | str:
    """Return the table of the files of some frames; or why the sidecar cannot be used.

    Args:
        data: what the index holds of the sidecar; None: nothing.
        fingerprint: as catalogued.
        start, count: the frames.
    """
    mark, _, table = (data or b"").partition(b"\n")
    if mark != fingerprint.encode():
        return "has changed since this catalogue was opened; start again to serve it as it is now"
    try:
        part = files_between(table, start, start + count)
    except ValueError:
        return "has a damaged entry in the index: delete the index and start again"
    if len(part) > _LARGEST_PART_BYTES:
        return f"has too many files for {count} frames: their names take {len(part)} of {_LARGEST_PART_BYTES} bytes"
    return part


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
    sidecars, notes, tell = dict[str, Sidecars](), list[str](), notice or (lambda text: None)
    for ending, ids in source.with_sidecars(sorted(videos), endings).items():
        collection = _Collection(source, store, ending)
        changed = collection.compare(ids, tell) if ids else []
        jobs = [(video, sidecar_id(video, ending), ending, *shape(video)) for video in changed]
        collection.read(jobs, videos, processes, tell)
        sidecars[ending] = collection.sidecars()
        notes += collection.notes(len(videos))
    return sidecars, notes


class _Collection:
    """The sidecars of one ending while they are collected."""

    def __init__(self, source: VideoSource, store: Store, ending: str) -> None:
        self._source, self._store, self._ending, self._kind = (
            source,
            store,
            ending,
            FigureKind(f"sidecar {ending}", "2"),
        )
        self._found, self._states, self._problems = (
            dict[str, tuple[str, str, str]](),
            dict[str, str](),
            dict[str, str](),
        )

    def compare(self, ids: Sequence[str], tell: Notice) -> list[str]:
        """Take over what the index knows, and return the videos whose sidecars are to be read."""
        known, changed, done = dict[str, str](), list[str](), 0
        with suppress(sqlite3.Error):  # an index that cannot be read costs time only
            self._store.make_figures()
            known = {id: data.decode("utf-8", "replace") for id, _, data in self._store.all_figures(self._kind)}
        with closing(by_parts(lambda part: [self._state(video) for video in part], ids)) as answered:
            for part, states in answered:
                done += len(part)
                for video, state in zip(part, states, strict=True):
                    before, *found = known.get(video, "").split("\n")
                    if isinstance(state, OSError):
                        self._problems[video] = _line(state)
                    elif state:
                        self._states[video] = state
                        if state == before and len(found) == 3:
                            self._found[video] = found[0], found[1], found[2]
                        else:
                            changed.append(video)
                tell(f"looking for sidecars {self._ending} in {self._source}: {done} of {len(ids)} videos")
        return changed

    def _state(self, video: str) -> str | OSError:
        try:
            return self._source.sidecar_state(sidecar_id(video, self._ending))
        except OSError as error:
            return error

    def read(self, jobs: Sequence[_Job], videos: Mapping[str, str], processes: int, tell: Notice) -> None:
        """Read new and changed sidecars, and put what was found into the index."""
        isolated = run_isolated(
            partial(read_sidecar, self._source),
            jobs,
            processes,
            deadline_seconds=lambda job: LONGEST_SECONDS,
            memory_bytes=LARGEST_MEMORY_BYTES,
            writable=() if self._source.is_local else None,  # copies are fetched: from a network, into a folder
        )
        facts, files = list[Figures](), list[Figures]()
        try:
            for done, ((video, id, *_), result) in enumerate(isolated, 1):
                tell(f"read {id}, {done} of {len(jobs)} new or changed sidecars {self._ending}")
                if isinstance(result, Died):
                    self._problems[video] = f"reading it took too much time or memory, or crashed ({result.how})"
                    continue
                *found, table = result
                if not found[0]:
                    self._problems[video] = found[1]
                    continue
                self._found[video] = found[0], found[1], found[2]
                text = "\n".join((self._states[video], *found))
                facts.append(Figures(video, videos[video], b"", text.encode()))
                files.append(Figures(video, videos[video], b"", found[0].encode() + b"\n" + table))
                if len(facts) == _TOGETHER:
                    self._save(facts, files)
        finally:
            self._save(facts, files)  # also of an interrupted start

    def _save(self, facts: list[Figures], files: list[Figures]) -> None:
        self._store.put_figures(files_kind(self._ending), files)
        self._store.put_figures(self._kind, facts)
        facts.clear()
        files.clear()

    def sidecars(self) -> Sidecars:
        fingerprints = {id: self._found[id][0] for id in sorted(self._found)}
        sha = hashlib.sha256(f"v2v sidecars 1\n{self._ending}\n".encode())
        for id, fingerprint in fingerprints.items():
            sha.update(f"{id}\0{fingerprint}\n".encode())
        refused = {id: problem for id, (_, problem, _) in self._found.items() if problem}
        return Sidecars(fingerprints, sha.hexdigest()[:32], self._states, self._problems | refused)

    def notes(self, videos: int) -> list[str]:
        refused = [f"{id}: {problem}" for id, (_, problem, _) in self._found.items() if problem]
        not_read = [f"{id}: {files}" for id, (*_, files) in self._found.items() if files]
        unreadable = [f"{sidecar_id(id, self._ending)}: {reason}" for id, reason in self._problems.items()]
        found = [f"{len(self._found)} of {videos} videos have a sidecar {self._ending}"] if self._found else []
        return found + [
            f"{len(those)} sidecars {text} ({those[0]})"
            for those, text in (
                (unreadable, "cannot be read and count as missing"),
                (refused, f"{self._ending} are refused, and their videos are served without these labels"),
                (not_read, f"{self._ending} have files that are no labels"),
            )
            if those
        ]


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
    if isinstance(text, MemoryError):
        text = "reading it takes too much memory"
    elif isinstance(text, Exception):
        plain = getattr(text, "reason", None) or getattr(text, "strerror", None) or str(text)
        text = plain if isinstance(text, OSError | VideoError | ValueError) else f"{type(text).__name__}: {plain}"
    return printable(text.replace("\n", " "))[:_LONGEST_REASON]
