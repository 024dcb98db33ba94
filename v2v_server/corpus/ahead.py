"""Catalogue a corpus before a server needs it, on one host or many."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from v2v_protocol.errors import CorpusError
from v2v_server.corpus.catalogue import Catalogue, index_path, list_corpus, open_catalogue, refresh_index
from v2v_server.corpus.index import Shard, make_folder, merge_parts, parts_in, write_part
from v2v_server.corpus.probe import VideoProgress
from v2v_server.corpus.scenes.collect import SceneCollection
from v2v_server.corpus.sources.source import COPIES_GIB, Notice, SourceOptions, VideoSource, open_source
from v2v_server.store.pixels import VIDEOS, VideosKind
from v2v_server.video.rows import Rows


@dataclass(frozen=True)
class Ahead:
    """What to catalogue, and how; see :func:`v2v_server.corpus.catalogue.open_catalogue`."""

    videos: str
    list_file: str | None = None
    rows: Rows | None = None
    cache_dir: str | None = None
    copies: str | None = None
    copies_gib: float = COPIES_GIB
    kind: VideosKind = VIDEOS
    scene: bool = False
    processes: int = 1


@dataclass(frozen=True, slots=True)
class Part:
    """A finished shard.

    Attributes:
        path: of its index.
        videos: number of videos of the corpus.
        taken_in: videos in this shard.
        problems: how many of them cannot be used, by reason.
    """

    path: Path
    videos: int
    taken_in: int
    problems: Counter[str]


def catalogue_ahead(
    asked: Ahead, parts: Path | None, progress: VideoProgress | None, notice: Notice | None
) -> Catalogue:
    """Open the catalogue of a corpus with all of its files in the index. The caller closes it.

    Args:
        asked: the corpus.
        parts: folder of the parts that other hosts made; files that match are not probed again.
        progress, notice: as in :func:`v2v_server.corpus.catalogue.open_catalogue`.

    Raises:
        CorpusError: as for ``open_catalogue``; or parts are missing or cannot be read.
    """
    if parts is not None:
        complete = parts_in(parts)
        merge_parts(index_path(_source(asked).name, asked.cache_dir), complete)
    return open_catalogue(
        asked.videos,
        list_file=asked.list_file,
        rows=asked.rows,
        cache_dir=asked.cache_dir,
        copies=asked.copies,
        copies_gib=asked.copies_gib,
        kind=asked.kind,
        scene=asked.scene,
        processes=asked.processes,
        progress=progress,
        notice=notice,
    )


def catalogue_shard(
    asked: Ahead, shard: Shard, out: Path, progress: VideoProgress | None, notice: Notice | None
) -> Part:
    """Catalogue a shard of a corpus and write its index to the parts.

    Progress is kept in this host's cache folder, so that a killed run continues.

    Args:
        asked: the corpus.
        out: folder of the parts, which all hosts see.
        progress, notice: as in :func:`v2v_server.corpus.catalogue.open_catalogue`.

    Raises:
        CorpusError: there is no such corpus, or a folder cannot be written to.
    """
    make_folder(out)
    source = _source(asked)
    corpus = list_corpus(source, asked.rows, notice)
    ids = [id for id in corpus.ids if shard.holds(id)]
    scenes = SceneCollection(corpus.rows) if asked.scene else None
    index = index_path(source.name, asked.cache_dir, shard)
    store, table, notes = refresh_index(source, ids, index, scenes, asked.processes, progress, notice)
    store.close()
    if notes:
        raise CorpusError(notes[0])
    return Part(
        write_part(index, out, shard),
        len(corpus.ids),
        len(ids),
        Counter(problem for problem in table.problem if problem is not None),
    )


def _source(asked: Ahead) -> VideoSource:
    return open_source(
        asked.videos, SourceOptions(asked.list_file, asked.copies, asked.copies_gib, asked.cache_dir, asked.kind)
    )
