"""The files of a corpus, before one of them is opened."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

from v2v_protocol.errors import CorpusError
from v2v_server.corpus.sources.asking import Notice, is_said
from v2v_server.corpus.sources.names import left_out_note
from v2v_server.corpus.sources.source import VideoSource
from v2v_server.video.rows import Rows


@dataclass(frozen=True)
class Corpus:
    """A listed source.

    Attributes:
        source: where the videos come from.
        rows: which rows of the pictures may be used.
        ids: of the files that may be videos.
        refused: files, folders and lines of the list that give no video, by id, with reasons.
        left_out: reports files of other endings; "" if there are none.
    """

    source: VideoSource
    rows: Rows
    ids: tuple[str, ...]
    refused: Mapping[str, str]
    left_out: str = ""


def list_corpus(source: VideoSource, rows: Rows | None, notice: Notice | None) -> Corpus:
    """List the files of a source.

    Args:
        source: where the videos come from.
        rows, notice: as in :func:`v2v_server.corpus.catalogue.open_catalogue`.

    Raises:
        CorpusError: the source cannot be listed, makes no sense, or has no video; or its folder of copies cannot be
            written to.
    """
    source.make()
    rows = source.rows(rows)
    source.rates = {entry.id: entry.rate for entry in source.listed or () if entry.rate is not None}
    refused: dict[str, str] = {}
    left_out = Counter[str]()
    ids = list[str]()
    for id in source.videos(refused, left_out):
        if [id] != ids[-1:]:  # a folder of pictures may be named by each
            ids.append(id)
        if notice is not None and is_said(len(ids)):
            notice(f"looking for videos in {source}: {len(ids)} so far")
    note = left_out_note(left_out)
    if not ids:
        raise CorpusError(
            f"{source}: no video found; looked for {source.kind.form.LOOKED_FOR}"
            f"{format_problems(refused)}{note and '. '}{note}"
        )
    return Corpus(source, rows, tuple(ids), refused, note)


def format_problems(problems: Mapping[str, str]) -> str:
    """Return the first few reasons, for an error message; "" without one."""
    if not problems:
        return ""
    shown = "; ".join(f"{id}: {problems[id]}" for id in sorted(problems)[:3])
    more = f"; and {len(problems) - 3} more" if len(problems) > 3 else ""
    return f" ({shown}{more})"
