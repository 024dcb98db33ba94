"""The command line of `v2v-prepare`: arguments -> settings -> call.

Exit status: 0 every video file of the source was prepared; 1 some were not, or lack requested statistics; 2 wrong usage
or input; 130 interrupted. Errors are one line on stderr; `--debug` shows the traceback.
"""

from __future__ import annotations

import argparse
import contextlib
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict
from importlib import import_module
from pathlib import Path
from typing import Any

from v2v_protocol.command import FAILED, Parser, run_command
from v2v_protocol.errors import UsageError, V2VError
from v2v_protocol.programs import show
from v2v_protocol.progress import Progress
from v2v_protocol.spec import SCENES
from v2v_protocol.write_aside import JSON, write_json
from v2v_server.config import ServeConfig
from v2v_server.corpus.catalogue import open_catalogue
from v2v_server.corpus.sources.copies import is_url
from v2v_server.corpus.sources.listing import LIST_SUFFIXES
from v2v_server.kinds.registry import KindFlags, kind_from
from v2v_server.prepare import Report, check_destination, prepare
from v2v_server.store.format import DEFAULT_SIZE, SIZES
from v2v_server.store.planes import OPTIONAL, PLANES
from v2v_server.system.process import usable_cores
from v2v_server.video.rows import Rows

_SHOWN = 20


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    parser = Parser(
        "v2v-prepare", "SRC DST [flags]",
        "Decode a corpus once, and store its luma bit for bit in blocks that read fast.",
        [
            "v2v-prepare webvid10k/ store/ --rows top:0.54",
            "v2v-prepare clips/ store/ --size fast --scene auto",
        ],
        "Exit status: 1 if some videos were not prepared, or lack requested statistics.",
    )  # fmt: skip
    videos = parser.group("Videos")
    videos.add_argument(
        "source",
        metavar="SRC",
        help="folder of videos, a video, a list file, or an address in object storage; never written to",
    )
    videos.add_argument("destination", metavar="DST", help="folder to create, or to continue after an interruption")
    videos.add_argument(
        "--scene",
        choices=SCENES,
        default="off",
        help="auto: also compute the statistics that v2v-serve --scene auto uses",
    )
    parser.add_settings(ServeConfig, "list", "rows", "cache_dir")
    parser.add_settings(KindFlags)
    stored = parser.group("Files")
    stored.add_argument(
        "--size", choices=tuple(SIZES), default=DEFAULT_SIZE,
        help=f"{DEFAULT_SIZE} (default), about 9 times the size of SRC; fast: a third larger, reads faster; raw: "
        "not compressed, reads fastest from memory",
    )  # fmt: skip
    stored.add_argument(
        "--planes", choices=OPTIONAL, action="append", default=[],
        help="also store what some streams read: "
        f"{', '.join(f'{name} (for {PLANES[name].serves})' for name in OPTIONAL)}; a video prepared without it is "
        "prepared again",
    )  # fmt: skip
    run = parser.group("Run")
    run.add_argument(
        "--workers", type=int, default=usable_cores(), metavar="N",
        help="number of processes (default: one per available core)",
    )  # fmt: skip
    parser.add_output("Run", "--json", JSON, "also write a record of each video to this file")
    interrupted = "interrupted; run the same command to continue"
    return run_command(parser, _run, argv, failures=(V2VError,), interrupted=interrupted)


def _run(arguments: argparse.Namespace) -> int:
    if arguments.workers < 1:
        raise UsageError(f"--workers {arguments.workers}: give at least 1")
    if converter := kind_from(vars(arguments)).converter:
        return _convert(import_module(converter), arguments)
    started = time.monotonic()
    source = Path(arguments.source).absolute()
    single = source.is_file() and source.suffix.lower() not in LIST_SUFFIXES
    folder = source.parent if source.is_file() else source
    root = None if is_url(arguments.source) else folder.resolve()
    check_destination(Path(arguments.destination).resolve(), root, single)  # probing may take hours
    with Progress("probing videos") as probing:
        catalogue = open_catalogue(
            arguments.source,
            list_file=arguments.list,
            rows=Rows.parse(arguments.rows or "full"),
            cache_dir=arguments.cache_dir,
            kind=kind_from(vars(arguments)),
            processes=arguments.workers,
            progress=probing,
            notice=probing.notice,
        )
    with contextlib.closing(catalogue), Progress("preparing", "frames") as shown:
        report = prepare(
            catalogue,
            arguments.destination,
            arguments.size,
            processes=arguments.workers,
            scene=arguments.scene != "off",
            planes=tuple(dict.fromkeys(arguments.planes)),
            single=root is not None and _is_video(Path(arguments.source), catalogue.folder),
            progress=lambda done, total, made, expected: shown(done, total, _size(made, expected)),
        )
    for line in summary(report, arguments.size, time.monotonic() - started):
        show(line)
    for ending, sidecars in catalogue.sidecars.items():
        if sidecars.states:
            where = f"copy them to the same places in {arguments.destination} to serve these labels"
            show(f"{len(sidecars.states)} sidecars {ending} (labels) were left beside their videos: {where}")
    if arguments.json is not None:
        refused = (*report.not_looked_at, *report.unusable)
        records = [asdict(video) for video in report.videos] + [
            {"id": one.video, "reason": one.reason} for one in refused
        ]
        write_json(arguments.json, records)
    return 0 if report.complete else FAILED


def _convert(converter: Any, arguments: argparse.Namespace) -> int:
    """Prepare what is no video yet, with the module of its kind."""
    for name, default in (("list", None), ("rows", None), ("scene", "off"), ("planes", []), ("size", DEFAULT_SIZE)):
        if getattr(arguments, name) != default:
            raise UsageError(f"--{name} has no effect with --videos-kind {arguments.videos_kind}: leave it out")
    source, destination = Path(arguments.source), Path(arguments.destination)
    converted = list[Any]()
    with Progress("preparing", "recordings") as shown:
        for each in converter.convert_recordings(source, destination, arguments.workers):
            converted.append(each)
            shown(len(converted), None)
    converted.sort(key=lambda each: str(each.id))
    for line in converter.summary(converted, destination):
        show(line)
    if arguments.json is not None:
        write_json(arguments.json, [asdict(each) for each in converted])
    return FAILED if any(each.problem for each in converted) else 0


def _is_video(source: Path, root: Path) -> bool:
    return source.resolve() != root and source.suffix.lower() not in LIST_SUFFIXES


def summary(report: Report, size: str, seconds: float) -> list[str]:
    """Return lines that state what was made, what it saved, and what failed and why."""
    prepared = report.prepared
    lines = [
        f"{len(prepared)} of {len(report.videos)} videos prepared as {size} ({report.kept} of them earlier) "
        f"in {seconds:.0f} s"
    ]
    if report.looked_at:
        lines.append(f"{report.looked_at} were prepared earlier; only statistics of their scenes were added")
    if prepared:
        before, after = sum(video.source_bytes for video in prepared), sum(video.bytes for video in prepared)
        change = "saves" if after <= before else "costs"
        lines.append(
            f"{before / 1e6:.1f} MB -> {after / 1e6:.1f} MB ({after / before:.2f} of the size): "
            f"{change} {abs(before - after) / 1e6:.1f} MB"
        )
        lines.append("every frame was read back and equals the source's, bit for bit")
        if read := len(prepared) - report.kept - report.looked_at:
            lines.append(f"sources that were read whole first, and have the hash of the catalogue: {read}")
    lines += _listed("could not be prepared:", [(video.id, str(video.problem)) for video in report.failed])
    lines += _listed(
        "lack requested statistics or planes (their files stay):",
        [(problem.video, problem.reason) for problem in report.not_looked_at],
    )
    lines += _listed("cannot be used:", [(problem.video, problem.reason) for problem in report.unusable])
    return lines


def _listed(title: str, items: list[tuple[str, str]]) -> list[str]:
    if not items:
        return []
    lines = [f"{len(items)} {title}", *(f"  {id}: {why}" for id, why in items[:_SHOWN])]
    if len(items) > _SHOWN:
        lines.append(f"  ... and {len(items) - _SHOWN} more; --json FILE lists them all")
    return lines


def _size(made: int, expected: int) -> str:
    return f"{made / 1e9:.1f} of about {expected / 1e9:.1f} GB" if expected else ""


if __name__ == "__main__":
    sys.exit(main())
