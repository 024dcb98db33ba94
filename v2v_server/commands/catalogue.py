"""The command line of `v2v-catalogue`: catalogue a corpus in advance, on one host or in shards on many."""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

from v2v_protocol.command import Parser, run_command
from v2v_protocol.errors import CorpusError, UsageError, V2VError
from v2v_protocol.programs import counted, show
from v2v_protocol.progress import Progress, format_duration
from v2v_protocol.spec import SCENES
from v2v_server.config import ServeConfig
from v2v_server.corpus.catalogue import Catalogue, index_path, list_corpus, open_catalogue, refresh_index
from v2v_server.corpus.index import Shard, make_folder, merge_parts, parts_in, write_part
from v2v_server.corpus.probe import SceneCollection
from v2v_server.corpus.sources.source import COPIES_GIB, SourceOptions, VideoSource, open_source
from v2v_server.corpus_words import notes_of
from v2v_server.kinds.registry import KindFlags, kind_from
from v2v_server.system.process import usable_cores
from v2v_server.video.rows import Rows

_SHOWN = 5


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    parser = Parser(
        "v2v-catalogue", "--videos DIR [flags]",
        "Catalogue every video in advance, so that v2v-serve starts at once. Continues where it was interrupted. On "
        "many hosts each one catalogues a shard, and one of them merges the parts.",
        [
            "v2v-catalogue --videos webvid10k/ --rows top:0.54 --scene auto",
            "v2v-catalogue --videos /data/webvid --shard 3/16 --out /data/parts",
            "v2v-catalogue --videos /data/webvid --merge /data/parts",
        ],
    )  # fmt: skip
    videos = parser.group("Videos")
    videos.add_argument(
        "--videos", required=True, metavar="DIR", help="folder, video, list file, or s3://bucket/prefix"
    )
    videos.add_argument(
        "--scene", choices=SCENES, default="off", help="auto: also compute the statistics that --scene auto needs"
    )
    parser.add_settings(ServeConfig, "list", "rows", "cache_dir", "copies", "copies_gib")
    parser.add_settings(KindFlags)
    run = parser.group("Run")
    run.add_argument(
        "--workers",
        type=int,
        default=usable_cores(),
        metavar="N",
        help="number of processes (default: one per available core)",
    )
    run.add_argument("--shard", metavar="K/N", help="only part K of N; needs --out")
    run.add_argument("--out", metavar="DIR", help="folder for the part; the host that merges must see it")
    run.add_argument("--merge", metavar="DIR", help="first merge the parts in this folder")
    interrupted = "interrupted; run the same command to continue"
    return run_command(parser, _run, argv, failures=(V2VError,), interrupted=interrupted)


def _run(arguments: argparse.Namespace) -> None:
    if arguments.workers < 1:
        raise UsageError(f"--workers {arguments.workers}: give at least 1")
    if (arguments.shard is None) != (arguments.out is None):
        raise UsageError("--shard K/N needs --out DIR, and --out needs --shard: give both or neither")
    if arguments.shard is not None and arguments.merge is not None:
        raise UsageError("--shard makes a part, --merge combines all of them: give one of them")
    begun = time.monotonic()
    shard = None if arguments.shard is None else Shard.parse(arguments.shard)
    with Progress("probing videos") as shown:
        probed = _Probed(shown)
        lines = _of_all(_catalogue_all(arguments, probed)) if shard is None else _of_shard(arguments, shard, probed)
    for line in [*lines, f"probed {counted(probed.files, 'file')} in {format_duration(time.monotonic() - begun)}"]:
        show(line)


def _source(arguments: argparse.Namespace) -> VideoSource:
    kind, copies_gib = kind_from(vars(arguments)), arguments.copies_gib or COPIES_GIB
    options = SourceOptions(arguments.list, arguments.copies, copies_gib, arguments.cache_dir, kind)
    return open_source(arguments.videos, options)


def _catalogue_all(arguments: argparse.Namespace, probed: _Probed) -> Catalogue:
    """Open the catalogue of a corpus with all of its files in the index: those of the parts, and those not probed yet.

    Raises:
        CorpusError: as for ``open_catalogue``; or parts are missing or cannot be read.
    """
    if arguments.merge is not None:
        complete = parts_in(Path(arguments.merge))
        merge_parts(index_path(_source(arguments).name, arguments.cache_dir), complete)
    return open_catalogue(
        arguments.videos,
        list_file=arguments.list,
        rows=Rows.parse(arguments.rows or "full"),
        cache_dir=arguments.cache_dir,
        copies=arguments.copies,
        copies_gib=arguments.copies_gib or COPIES_GIB,
        kind=kind_from(vars(arguments)),
        scene=arguments.scene != "off",
        processes=arguments.workers,
        progress=probed,
        notice=probed.notice,
    )


def _of_shard(arguments: argparse.Namespace, shard: Shard, probed: _Probed) -> list[str]:
    """Catalogue a shard of a corpus, write its index to the parts, and return lines that say so.

    Progress is kept in this host's cache folder, so that a killed run continues.

    Raises:
        CorpusError: there is no such corpus, or a folder cannot be written to.
    """
    make_folder(out := Path(arguments.out))
    source = _source(arguments)
    corpus = list_corpus(source, Rows.parse(arguments.rows or "full"), probed.notice)
    ids = [id for id in corpus.ids if shard.holds(id)]
    scenes = SceneCollection(corpus.rows) if arguments.scene != "off" else None
    index, refused = index_path(source.name, arguments.cache_dir, shard), dict[str, str]()
    store, table, notes = refresh_index(source, ids, index, scenes, arguments.workers, probed, probed.notice, refused)
    store.close()
    if notes:
        raise CorpusError(notes[0])
    problems = Counter(problem for problem in table.problem if problem is not None)
    path, usable = write_part(index, out, shard), len(table) - problems.total()
    lines = [f"shard {shard}: {len(ids)} of {len(corpus.ids)} videos and archives, {usable} videos can be used"]
    return [*lines, *(f"  {count}: {reason}" for reason, count in problems.most_common(_SHOWN)), f"part: {path}"]


class _Probed:
    """Count the files that are probed, and show the progress."""

    def __init__(self, shown: Progress) -> None:
        self._shown, self.notice, self.files = shown, shown.notice, 0

    def __call__(self, done: int, total: int) -> None:
        self.files += 1
        self._shown(done, total)


def _of_all(catalogue: Catalogue) -> list[str]:
    with closing(catalogue):
        lines = [*notes_of(catalogue), f"{catalogue.source}: {counted(len(catalogue.videos), 'video')} can be used"]
        if catalogue.refusals:
            lines.append(f"{counted(len(catalogue.refusals), 'file')} cannot be used:")
            lines += [f"  {refusal}" for refusal in catalogue.refusals[:_SHOWN]]
            if len(catalogue.refusals) > _SHOWN:
                lines.append(f"  ... and {len(catalogue.refusals) - _SHOWN} more: v2v-serve --list-refused lists all")
        lines.append(f"digest: {catalogue.digest}")
        if catalogue.scene_digest is not None:
            lines.append(f"with scenes: {catalogue.scene_digest}")
        return lines


if __name__ == "__main__":
    sys.exit(main())
