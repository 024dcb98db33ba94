"""The command line of `v2v-prepare`: arguments -> settings -> call.

Exit status: 0 every video file of the source was prepared; 1 some were not, fall below a floor or lack requested
statistics; 2 wrong usage or input; 130 interrupted. Errors are one line on stderr; `--debug` shows the traceback.
"""

from __future__ import annotations

import argparse
import contextlib
import statistics
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from v2v_protocol.command import FAILED, JSON, Parser, run_command
from v2v_protocol.errors import UsageError, V2VError
from v2v_protocol.programs import show
from v2v_protocol.progress import Progress
from v2v_protocol.spec import SCENES
from v2v_protocol.write_aside import write_json
from v2v_server.corpus.catalogue import open_catalogue
from v2v_server.corpus.sources.listfile import LIST_SUFFIXES
from v2v_server.prepare import prepare
from v2v_server.prepare.report import Report
from v2v_server.store.chroma import CHROMA
from v2v_server.store.encoding import DEFAULT_GOP, DEFAULT_QUALITY, DEFAULT_SIZE, H264, LOSSLESS, Encoding
from v2v_server.store.motion import MADE_PLANES
from v2v_server.store.packing import SIZES
from v2v_server.system.process import usable_cores
from v2v_server.video.rows import Rows

_SHOWN = 20


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    parser = Parser(
        "v2v-prepare", "SRC DST [flags]",
        "Decode a corpus once, and store its luma bit for bit in blocks that read fast, or as small H.264 files.",
        [
            "v2v-prepare webvid10k/ store/ --rows top:0.54",
            "v2v-prepare clips/ store/ --size fast --scene auto",
        ],
        "Exit status: 1 if some videos were not prepared, fall below a floor or lack requested statistics.",
    )  # fmt: skip
    videos = parser.group("Videos")
    videos.add_argument("source", metavar="SRC", help="folder of videos, a video, or a list file; never written to")
    videos.add_argument("destination", metavar="DST", help="folder to create, or to continue after an interruption")
    videos.add_argument(
        "--rows", default="full", metavar="ROWS", help="rows to keep: full (default), top:0.54 (WebVid)"
    )
    videos.add_argument("--list", metavar="FILE", help="list file (path frames c+ c-) that restricts SRC")
    videos.add_argument(
        "--scene",
        choices=SCENES,
        default="off",
        help="auto: also compute the statistics that v2v-serve --scene auto uses",
    )
    videos.add_argument("--cache-dir", metavar="DIR", help="folder of the catalogue index (default: the user's cache)")
    encoding = parser.group("Encoding")
    encoding.add_argument(
        "--codec", choices=(LOSSLESS, H264), default=LOSSLESS,
        help="lossless (default): the same samples as SRC, about 9 times its size; h264: smaller than SRC, but lossy",
    )  # fmt: skip
    encoding.add_argument(
        "--size",
        choices=tuple(SIZES),
        help=f"lossless: {DEFAULT_SIZE} (default), fast: a third larger, reads faster, or raw: "
        "not compressed, reads fastest from memory",
    )
    encoding.add_argument(
        "--planes", choices=(*MADE_PLANES, CHROMA), action="append", default=[],
        help="lossless: also store the motion between frames, which streams with substep_px then need not find, or "
        "chroma, for frames_rgb; a video prepared without it is prepared again",
    )  # fmt: skip
    encoding.add_argument(
        "--quality", type=int, metavar="Q", help=f"h264: rate factor, lower is better and larger ({DEFAULT_QUALITY})"
    )
    encoding.add_argument("--gop", type=int, metavar="N", help=f"h264: distance of keyframes ({DEFAULT_GOP})")
    run = parser.group("Run")
    run.add_argument(
        "--workers", type=int, default=usable_cores(), metavar="N",
        help="number of processes (default: one per available core)",
    )  # fmt: skip
    run.add_argument(
        "--floor", type=float, default=prepare.DEFAULT_FLOOR_DB, metavar="DB",
        help=f"report clips with a lower PSNR, dB, and exit with status 1 (default {prepare.DEFAULT_FLOOR_DB:g})",
    )  # fmt: skip
    run.add_argument(
        "--frame-floor", type=float, metavar="DB",
        help="the same for the worst frame of a clip, dB "
        f"(default: {prepare.DEFAULT_FRAME_FLOOR_BELOW_DB:g} below --floor)",
    )  # fmt: skip
    parser.add_output("Run", "--json", JSON, "also write a record of each video")
    interrupted = "interrupted; run the same command to continue"
    return run_command(parser, _run, argv, failures=(V2VError,), interrupted=interrupted)


def _run(arguments: argparse.Namespace) -> int:
    encoding = Encoding.of(arguments.codec, arguments.size, arguments.quality, arguments.gop)
    if arguments.workers < 1:
        raise UsageError(f"--workers {arguments.workers}: give at least 1")
    started = time.monotonic()
    with Progress("probing videos") as probing:
        catalogue = open_catalogue(
            arguments.source,
            list_file=arguments.list,
            rows=Rows.parse(arguments.rows),
            cache_dir=arguments.cache_dir,
            processes=arguments.workers,
            progress=probing,
            notice=probing.notice,
        )
    with contextlib.closing(catalogue), Progress("preparing", "frames") as shown:
        report = prepare.prepare(
            catalogue,
            arguments.destination,
            encoding,
            processes=arguments.workers,
            floor_db=arguments.floor,
            frame_floor_db=arguments.frame_floor,
            scene=arguments.scene != "off",
            planes=tuple(dict.fromkeys(arguments.planes)),
            single=_is_video(Path(arguments.source)),
            progress=lambda done, total, made, expected: shown(done, total, _size(made, expected)),
        )
    for line in summary(report, encoding, time.monotonic() - started):
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


def _is_video(source: Path) -> bool:
    return source.is_file() and source.suffix.lower() not in LIST_SUFFIXES


def summary(report: Report, encoding: Encoding, seconds: float) -> list[str]:
    """Return lines that state what was made, what it saved, and what failed and why."""
    prepared = report.prepared
    lines = [
        f"{len(prepared)} of {len(report.videos)} videos prepared as {encoding} ({report.kept} of them earlier) "
        f"in {seconds:.0f} s"
    ]
    if report.looked_at:
        lines.append(f"{report.looked_at} were prepared earlier; only statistics of their scenes were added")
    if report.aside:
        lines.append(
            f"{report.aside} others that were prepared earlier are set aside: not served, and not prepared again if a "
            "later run includes them"
        )
    if prepared:
        before, after = report.source_bytes, report.prepared_bytes
        change = "saves" if after <= before else "costs"
        lines.append(
            f"{before / 1e6:.1f} MB -> {after / 1e6:.1f} MB ({after / before:.2f} of the size): "
            f"{change} {abs(before - after) / 1e6:.1f} MB"
        )
        if encoding.is_lossless:
            lines.append("every frame was read back and equals the source's, bit for bit")
    if prepared and not encoding.is_lossless:
        quality = {video.id: video.psnr_db or 0.0 for video in prepared}
        worst = min(quality, key=lambda id: quality[id])
        lines.append(
            f"PSNR of a clip to its source: median {statistics.median(quality.values()):.1f} dB, "
            f"lowest {quality[worst]:.1f} dB ({worst})"
        )
        frames = {video.id: video.worst_psnr_db or 0.0 for video in prepared}
        worst = min(frames, key=lambda id: frames[id])
        lines.append(
            f"PSNR of the worst frame: {frames[worst]:.1f} dB ({worst}); the floors are {report.floor_db:g} dB for a "
            f"clip and {report.frame_floor_db:g} dB for a frame"
        )
    lines += _listed(
        f"below the floor of {report.floor_db:g} dB, or a frame below {report.frame_floor_db:g} dB (kept; a lower "
        "--quality improves them):",
        [
            (video.id, f"{video.psnr_db:.1f} dB, worst frame {video.worst_psnr_db:.1f} dB")
            for video in report.below_floor
        ],
    )
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
