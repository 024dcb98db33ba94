"""`v2v-doctor`: arguments -> call."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from v2v_protocol.command import FAILED, Parser, run_command
from v2v_protocol.errors import UsageError, V2VError
from v2v_protocol.programs import show
from v2v_server.store.pixels import PIXEL_KINDS, VideosKind
from v2v_tools.doctor.machine import BAD, NOTE, look_around


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    parser = Parser(
        "v2v-doctor", "[--videos DIR] [flags]",
        "Check this machine, this installation and a corpus, and say what to change.",
        ["v2v-doctor --videos webvid10k/", "v2v-doctor --videos webvid10k/ --recipe davis346 --port 6000"],
        "Exit status: 0 no problems found, 1 problems found.",
    )  # fmt: skip
    what = parser.group("What to check")
    what.add_argument("--videos", metavar="DIR", help="also check a folder of videos, a video or a list file")
    what.add_argument(
        "--recipe", metavar="NAME", default="paper", help="recipe to check the videos against (default paper)"
    )
    what.add_argument("--port", type=int, default=5555, metavar="N", help="port that a server would use (default 5555)")
    what.add_argument("--rows", default="full", metavar="ROWS", help="rows to use: full (default), top:0.54 (WebVid)")
    what.add_argument("--videos-kind", choices=PIXEL_KINDS, help="what a video is, as for v2v-serve (default videos)")
    what.add_argument("--rate", type=float, metavar="N", help="rate of picture sequences, or of photographs, Hz")
    what.add_argument("--photograph-seconds", type=float, metavar="S", help="time for which each photograph is shown")
    what.add_argument("--cache-dir", metavar="DIR", help="folder of the catalogue index (default: the user's cache)")
    return run_command(parser, _run, argv, failures=(V2VError,))


def _run(arguments: argparse.Namespace) -> int:
    if not 1 <= arguments.port <= 65535:
        raise UsageError(f"--port {arguments.port}: give 1 to 65535")
    found_bad = has_defects = False
    for finding in look_around(
        arguments.port, arguments.videos, arguments.recipe, arguments.rows, arguments.cache_dir,
        VideosKind.of(vars(arguments)),
    ):  # fmt: skip
        found_bad = found_bad or finding.level == BAD
        has_defects = has_defects or (finding.level, finding.about) == (NOTE, "pictures")
        show(f"{finding.level:4}  {finding.about:12}  {finding.text}")
        if finding.change:
            show(f"{'':20}-> {finding.change}")
    if found_bad:
        show("problems found: see the lines that begin with bad")
    elif has_defects:
        show("the videos can be served, but their pictures have defects: see the notes about pictures")
    else:
        show("no problems found")
    return FAILED if found_bad else 0


if __name__ == "__main__":
    sys.exit(main())
