"""The command line of `v2v-preview`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from v2v_protocol.command import Parser, run_command
from v2v_protocol.errors import UsageError, V2VError
from v2v_protocol.spec_flags import add_spec, asked_recipe, recipe_setting, spec_fields
from v2v_server.config import ServeConfig
from v2v_server.store.pixels import VideosKind
from v2v_tools.preview.preview import PICTURE_SUFFIXES, Shot, preview

_MOST_CAMERAS = 32


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    parser = Parser(
        "v2v-preview", "VIDEO|DIR [VIDEO ...] --out FILE [flags]",
        "Show the effect of a recipe on your videos: frames, events, flow, activity.",
        [
            "v2v-preview clips/ --out sheet.png --recipe davis346",
            "v2v-preview clip.mp4 --out compared.html --compare paper clean davis346",
        ],
    )  # fmt: skip
    cameras = parser.group("Virtual cameras")
    cameras.add_argument("--seeds", type=int, metavar="N", help="virtual cameras to draw (default 4)")
    cameras.add_argument(
        "--seed", type=int, metavar="S",
        help="seed of the first camera; the others have the next seeds (default: seeds whose crops show motion)",
    )  # fmt: skip
    cameras.add_argument(
        "--compare", nargs="+", metavar="NAME", help="show the same clip under these recipes instead, one camera each"
    )
    videos = parser.group("Videos")
    videos.add_argument(
        "sources", nargs="+", metavar="VIDEO|DIR",
        help="a video, a folder of videos, or a list file; with several, each gets a FILE-NAME of its own",
    )  # fmt: skip
    parser.add_settings(ServeConfig, "list", "rows", "videos_kind", "rate", "photograph_seconds", "cache_dir")
    out = parser.group("Output")
    parser.add_output(
        "Output", "--out", PICTURE_SUFFIXES, f"picture, film or page: {', '.join(PICTURE_SUFFIXES)}", required=True
    )
    out.add_argument(
        "--moments", type=int, default=1, metavar="N", help="number of voxel grids of each camera (default 1)"
    )
    out.add_argument("--no-flow", action="store_true", help="leave optical flow out")
    add_spec(parser)
    return run_command(parser, _run, argv, failures=(V2VError,), interrupted="interrupted; nothing was written")


def _run(arguments: argparse.Namespace) -> None:
    count = 4 if arguments.seeds is None else arguments.seeds
    for flag, value in (("--seeds", count), ("--moments", arguments.moments)):
        if not 1 <= value <= _MOST_CAMERAS:
            raise UsageError(f"{flag} {value}: give 1 to {_MOST_CAMERAS}")
    first = arguments.seed or 0
    if arguments.compare:
        if arguments.recipe is not None:
            raise UsageError("--compare names the recipes: leave --recipe out")
        if arguments.seeds is not None:
            raise UsageError("--compare shows each recipe with one seed: leave --seeds out")
        looks = [Shot(Path(name).stem, recipe_setting(name, arguments.set), first) for name in arguments.compare]
        what = "the same clip under " + ", ".join(look.title for look in looks)
    else:
        name = asked_recipe(arguments) or "paper"
        recipe = recipe_setting(name, arguments.set)
        looks = [Shot("", recipe, seed) for seed in range(first, first + count)]
        what = f'virtual cameras drawn from the recipe "{Path(name).stem}"'
    kind = VideosKind.of(vars(arguments))
    if arguments.seed is None and not kind.is_rendered:
        what += ", chosen where something moves"
    stem, names = arguments.out.stem, [Path(source).stem for source in arguments.sources]
    named = {
        arguments.out.with_stem(f"{stem}-{name}"): source for name, source in zip(names, arguments.sources, strict=True)
    }
    if len(named) < len(names):
        raise UsageError(f"two of the videos are named {max(names, key=names.count)}: preview them one at a time")
    for path, source in named.items():
        preview(
            source,
            path if len(named) > 1 else arguments.out,
            looks,
            # Recipes are compared on one clip, so the order must not depend on how many sequences each admits.
            spec_fields(arguments) | ({"shuffle": False} if arguments.compare else {}),
            title=f"{Path(source).name}: {what}",
            find_motion=arguments.seed is None,
            list_file=arguments.list,
            rows=arguments.rows or "full",
            with_flow=not arguments.no_flow,
            moments=arguments.moments,
            cache_dir=arguments.cache_dir,
            kind=kind,
        )


if __name__ == "__main__":
    sys.exit(main())
