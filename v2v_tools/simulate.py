"""`v2v-simulate`: arguments -> call."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from v2v_protocol.command import Parser, run_command
from v2v_protocol.errors import V2VError
from v2v_protocol.sample import ARRAYS, DEFAULT_ARRAYS
from v2v_protocol.spec_flags import add_spec, asked_recipe, recipe_setting, spec_fields
from v2v_server.config import ServeConfig
from v2v_server.store.pixels import VideosKind
from v2v_tools.event_files import EVENT_WRITERS
from v2v_tools.remake import simulate_to_file


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    parser = Parser(
        "v2v-simulate", "VIDEO --out FILE.npz [flags]",
        "Make one sample in this process: the same bytes a server would stream.",
        [
            "v2v-simulate clip.mp4 --out sample.npz --picture sample.png --events events.h5",
            "v2v-simulate webvid10k/ --rows top:0.54 --seed 3 --epoch 2 --index 4711 --out sample.npz",
        ],
    )  # fmt: skip
    which = parser.group("Which sample")
    which.add_argument("video", metavar="VIDEO", help="a video; or a folder or list file, to remake a streamed sample")
    which.add_argument("--seed", type=int, default=0, metavar="N", help="seed of the stream (default 0)")
    which.add_argument("--epoch", type=int, default=0, metavar="N", help="default 0")
    which.add_argument("--index", type=int, default=0, metavar="N", help="global index in the epoch (default 0)")
    which.add_argument(
        "--quarantine",
        type=int,
        default=0,
        metavar="N",
        help="number of the quarantine snapshot in the sample's provenance",
    )
    parser.add_settings(ServeConfig, "list", "rows", "videos_kind", "rate", "photograph_seconds", "cache_dir")
    out = parser.group("Output")
    parser.add_output(
        "Output", "--out", (".npz",), "output file for the arrays and the provenance (JSON)", required=True
    )
    parser.add_output("Output", "--picture", (".png",), "also write a picture of frames and voxels")
    parser.add_output(
        "Output",
        "--events",
        tuple(EVENT_WRITERS),
        f"also write the events with their times: {', '.join(EVENT_WRITERS)}",
    )
    out.add_argument(
        "--arrays", default=",".join(DEFAULT_ARRAYS), metavar="NAME,NAME",
        help=f"of {', '.join(ARRAYS)} (default {','.join(DEFAULT_ARRAYS)})",
    )  # fmt: skip
    add_spec(parser)
    return run_command(
        parser, _run, argv, failures=(V2VError,), interrupted="interrupted before all files were written"
    )


def _run(arguments: argparse.Namespace) -> None:
    simulate_to_file(
        arguments.video,
        out=arguments.out,
        picture=arguments.picture,
        events=arguments.events,
        list_file=arguments.list,
        rows=arguments.rows or "full",
        spec=spec_fields(arguments) | {"recipe": recipe_setting(asked_recipe(arguments), arguments.set)},
        arrays=tuple(arguments.arrays.split(",")),
        seed=arguments.seed,
        epoch=arguments.epoch,
        index=arguments.index,
        snapshot=arguments.quarantine,
        cache_dir=arguments.cache_dir,
        kind=VideosKind.of(vars(arguments)),
    )


if __name__ == "__main__":
    sys.exit(main())
