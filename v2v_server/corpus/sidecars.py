"""The sidecars of all videos of a catalogue. The index keeps their fingerprints."""

from __future__ import annotations

import hashlib
import sqlite3
from collections.abc import Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass

from v2v_protocol.errors import VideoError
from v2v_server.corpus.index.file import FigureKind, Figures, Store
from v2v_server.corpus.sources.asking import Notice, by_parts
from v2v_server.corpus.sources.sidecar import fingerprint_of, open_sidecar, sidecar_id
from v2v_server.corpus.sources.source import VideoSource


@dataclass(frozen=True, slots=True)
class Sidecars:
    """The sidecars of one ending.

    Attributes:
        fingerprints: by the video's id; videos without such a sidecar are missing.
        digest: names all of them.
    """

    fingerprints: Mapping[str, str]
    digest: str


def collect_sidecars(
    source: VideoSource, store: Store, videos: Mapping[str, str], endings: Sequence[str], notice: Notice | None
) -> tuple[dict[str, Sidecars], list[str]]:
    """Return the sidecars of each ending, and notes for the user. Only new and changed ones are read.

    Args:
        source: where the videos come from.
        store: the index.
        videos: fingerprint of each video's file, by id.
        endings: see :mod:`v2v_server.corpus.sources.sidecar`.
        notice: progress callback.
    """
    sidecars, notes = dict[str, Sidecars](), list[str]()
    for ending, ids in source.with_sidecars(sorted(videos), endings).items():
        fingerprints, unreadable = _fingerprints(source, store, videos, ids, ending, notice) if ids else ({}, [])
        if fingerprints:
            notes.append(f"{len(fingerprints)} of {len(videos)} videos have a sidecar {ending}")
        if unreadable:
            notes.append(f"{len(unreadable)} sidecars cannot be read and count as missing ({unreadable[0]})")
        sidecars[ending] = Sidecars(fingerprints, _digest(ending, fingerprints))
    return sidecars, notes


def _fingerprints(
    source: VideoSource,
    store: Store,
    videos: Mapping[str, str],
    ids: Sequence[str],
    ending: str,
    notice: Notice | None,
) -> tuple[dict[str, str], list[str]]:
    """Return the fingerprint of each of these videos' sidecars, and why others cannot be read."""
    kind = FigureKind(f"sidecar {ending}", "1")
    known = dict[str, str]()  # state and fingerprint
    with suppress(sqlite3.Error):  # an index that cannot be read or written costs time only
        store.make_figures()
        known = {id: data.decode("ascii", "replace") for id, _, data in store.all_figures(kind)}
    fingerprints, fresh, unreadable, done = dict[str, str](), list[Figures](), list[str](), 0

    def states(part: Sequence[str]) -> list[str]:
        return source.sidecar_states([sidecar_id(video, ending) for video in part])

    with closing(by_parts(states, ids)) as answered:
        for part, found in answered:
            done += len(part)
            for video, state in zip(part, found, strict=True):
                before, _, mark = known.get(video, "").partition(" ")
                if not state:
                    continue
                if before != state:
                    try:
                        with open_sidecar(source, sidecar_id(video, ending), "") as opened:
                            mark = fingerprint_of(opened)
                    except (OSError, VideoError) as error:
                        unreadable.append(f"{sidecar_id(video, ending)}: {getattr(error, 'reason', error)}")
                        continue
                    fresh.append(Figures(video, videos[video], b"", f"{state} {mark}".encode()))
                fingerprints[video] = mark
            with suppress(sqlite3.Error):
                store.put_figures(kind, fresh)  # now, so that an interrupted start keeps them
                fresh = []
            if notice is not None:
                notice(f"looking for sidecars {ending} in {source}: {done} of {len(ids)} videos")
    return fingerprints, unreadable


def _digest(ending: str, fingerprints: Mapping[str, str]) -> str:
    sha = hashlib.sha256(f"v2v sidecars 1\n{ending}\n".encode())
    for id in sorted(fingerprints):
        sha.update(f"{id}\0{fingerprints[id]}\n".encode())
    return sha.hexdigest()[:32]
