"""What a corpus consists of before anything is known of its files: where it lies, and which files it has."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from v2v_protocol.errors import CorpusError
from v2v_server.cloud.copies import Copies
from v2v_server.corpus.files import (
    UNPRINTABLE,
    VIDEO_SUFFIXES,
    Notice,
    bucket_files,
    corpus_root,
    is_said,
    left_out_note,
    printable,
    regular_files,
    video_files,
)
from v2v_server.corpus.listfile import LIST_SUFFIXES, ListEntry, read_list
from v2v_server.corpus.manifest import Manifest, find_manifest, refuse_prepared_below
from v2v_server.video.rows import Rows


@dataclass(frozen=True)
class Corpus:
    """A corpus whose files nobody has opened yet.

    Attributes:
        root: the folder that ids are relative to, resolved; or the copies of videos in object storage.
        rows: which rows of the pictures may be used.
        ids: of the files that look like videos, or that a list names.
        listed: the lines of the list; empty without one.
        refused: files, folders and lines of the list that give no video, by id, with reasons.
        manifest: of a prepared folder.
        left_out: reports files whose endings are not looked at; "" where there is no such file.
    """

    root: Path | Copies
    rows: Rows
    ids: tuple[str, ...]
    listed: tuple[ListEntry, ...]
    refused: Mapping[str, str]
    manifest: Manifest | None
    left_out: str = ""


def find_corpus(
    source: str | os.PathLike[str],
    list_file: str | os.PathLike[str] | None,
    rows: Rows | None,
    bucket: Copies | None,
    notice: Notice | None,
) -> Corpus:
    """Looks for the files of a corpus.

    Args:
        source, list_file, rows, notice: as in :func:`v2v_server.corpus.catalogue.open_catalogue`.
        bucket: what lies in object storage, where that is the source.

    Raises:
        CorpusError: there is no such folder or list, it cannot be read, it makes no sense, or it names no video.
    """
    root: Path | Copies
    manifest = None
    try:
        if bucket is not None:
            root, listed = bucket, None if list_file is None else read_list(list_file)
        else:
            root, listed = _wanted(Path(source), list_file)
            manifest = find_manifest(root)
    except OSError as error:  # a folder that this user may not enter, a share that has gone
        raise CorpusError(f"{source}: cannot be looked at: {error.strerror or error}") from error
    refused: dict[str, str] = {}
    left_out = Counter[str]()
    named = None if listed is None else [entry.id for entry in listed]
    if manifest is not None:
        rows = manifest.served_rows(rows)
        ids = manifest.wanted(named, refused)
    else:
        ids = _found(root, refused, left_out, notice) if named is None else regular_files(root, named, refused, notice)
        refuse_prepared_below(root, ids)
    note = left_out_note(left_out)
    if not ids:
        raise CorpusError(
            f"{source}: no video found; looked for {' '.join(sorted(VIDEO_SUFFIXES))}"
            f"{told(refused)}{note and '. '}{note}"
        )
    return Corpus(root, rows or Rows(), tuple(ids), listed or (), refused, manifest, note)


def _wanted(source: Path, list_file: str | os.PathLike[str] | None) -> tuple[Path, tuple[ListEntry, ...] | None]:
    """The root folder, and the entries to take from it; None takes every video below it."""
    folder = corpus_root(source)
    if source.is_dir():
        return folder, None if list_file is None else read_list(list_file)
    if list_file is not None:
        raise CorpusError(f"{source}: not a folder; a list file names videos of a folder")
    if source.suffix.lower() in LIST_SUFFIXES:
        return folder, read_list(source)
    if printable(source.name) != source.name:
        raise CorpusError(f"{printable(source.name)}: {UNPRINTABLE}")
    return folder, (ListEntry(source.name),)


def _found(
    root: Path | Copies, refused: dict[str, str], left_out: Counter[str], notice: Notice | None
) -> tuple[str, ...]:
    """The videos below a folder, or an address."""
    ids = []
    if isinstance(root, Copies):
        files = bucket_files(root.listed, refused, left_out)
    else:
        files = video_files(root, refused, left_out)
    for id in files:
        ids.append(id)
        if notice is not None and is_said(len(ids)):
            notice(f"looking for videos: {len(ids)} so far")
    return tuple(ids)


def told(problems: Mapping[str, str]) -> str:
    """The first few reasons, for an error message."""
    if not problems:
        return ""
    shown = "; ".join(f"{id}: {problems[id]}" for id in sorted(problems)[:3])
    more = f"; and {len(problems) - 3} more" if len(problems) > 3 else ""
    return f" ({shown}{more})"
