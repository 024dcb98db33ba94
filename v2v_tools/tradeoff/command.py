"""The command line of `v2v-tradeoff`."""

from __future__ import annotations

import argparse
import math
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2

from v2v_protocol.command import FAILED, Parser, run_command
from v2v_protocol.errors import UsageError
from v2v_protocol.programs import show
from v2v_protocol.spec import StreamSpec
from v2v_protocol.spec_flags import add_recipe, recipe_setting
from v2v_protocol.write_aside import JSON, write_file, write_json
from v2v_server.corpus.catalogue import Catalogue
from v2v_server.simulation.forms import warm_up
from v2v_server.system.process import keep_freed_memory
from v2v_server.video.rows import Rows
from v2v_tools.tradeoff.measures import (
    DRAW_ROW,
    NOISE_ROW,
    accuracy,
    cpu_seconds,
    diversity,
    leases_of,
    making,
)
from v2v_tools.tradeoff.rendered import true_rates
from v2v_tools.tradeoff.report import best, error_fields, error_of, name_dominated, reasons, tables
from v2v_tools.tradeoff.settings import BESIDE, SOURCE, STORES, ServeSetting, axes, open_forms, settings

_DEFAULT_FORMS = ("lossless dense", "lossless fast")


def _parser() -> Parser:
    parser = Parser(
        "v2v-tradeoff", "--videos DIR [flags]",
        "Measure on your clips what each way to serve them costs: processor time, disk space, the error of its form "
        "against exactly decoded frames, the error of its frames and sub-steps against what the clips show at the true "
        "rate, rendered, and diversity, for the source, stores and another encoding, with all combinations of the "
        "values of some fields. A setting is dominated when another one is at least as good in everything and better "
        "in one thing. Name the best setting for a wish, and write it for v2v-serve --config.",
        [
            "v2v-tradeoff --videos clips/ --json tradeoff.json",
            "v2v-tradeoff --videos clips/ --target-rate 20 --vary samples_per_decode=1,2 --preset-out chosen.yaml",
            "v2v-tradeoff --videos clips/ --beside smaller/ --forms 'lossless dense'",
            "v2v-tradeoff --videos clips/ --recipe my_camera.yaml --vary substep_px=0,0.5,1 --max-error 0.02",
        ],
        "Exit status: 1 where no setting fulfils --target-rate or --max-error.",
    )  # fmt: skip
    videos = parser.group("Videos")
    videos.add_argument("--videos", required=True, type=Path, metavar="DIR", help="a corpus that is not prepared")
    videos.add_argument(
        "--beside", type=Path, metavar="DIR",
        help="also compare the videos of this folder, with the same names and frames in another encoding",
    )  # fmt: skip
    videos.add_argument("--rows", default="top:0.54", help="rows to use (default top:0.54, as for WebVid)")
    videos.add_argument(
        "--clips", type=int, default=4, metavar="N",
        help="different clips to take, two sequences of each (default 4); the time that everything takes grows with it",
    )  # fmt: skip
    add_recipe(parser, "Videos")
    work = parser.group("Work")
    work.add_argument(
        "--vary", action="append", default=[], metavar="KEY=VALUE,VALUE",
        help="values to compare of samples_per_decode (default 1,2,4), substep_px (default 0,1), or a field of the "
        "recipe such as voxel_seconds; may be repeated",
    )  # fmt: skip
    work.add_argument(
        "--forms", default=",".join(_DEFAULT_FORMS), metavar="FORM,FORM",
        help=f"ways to prepare the clips, from {', '.join(STORES)} (default {', '.join(_DEFAULT_FORMS)})",
    )  # fmt: skip
    wishes = parser.group("Wish")
    wish = wishes.add_mutually_exclusive_group()
    wish.add_argument("--target-rate", type=float, metavar="X", help="least number of samples a second of one core")
    wish.add_argument("--max-error", type=float, metavar="X", help="largest of both errors, a share: 0.05 is 5 %%")
    parser.add_output("Output", "--preset-out", (".yaml", ".yml"), "write the best setting for v2v-serve --config")
    parser.add_output("Output", "--json", JSON, "write the records")
    return parser


def _check(asked: argparse.Namespace) -> None:
    wishes = [wish for wish in (asked.target_rate, asked.max_error) if wish is not None]
    if asked.preset_out is not None and not wishes:
        raise UsageError("--preset-out without a wish: give --target-rate or --max-error too")
    if asked.clips < 1:
        raise UsageError(f"--clips {asked.clips}: give 1 or more")
    for wish in wishes:
        if not 0 <= wish < math.inf:
            raise UsageError(f"{wish:g}: --target-rate and --max-error are finite numbers from 0 on")
    asked.forms = [name.strip() for name in asked.forms.split(",")]
    for name in asked.forms:
        if name not in STORES:
            raise UsageError(f"--forms {name!r}: choose from {', '.join(STORES)}")


def _run(asked: argparse.Namespace) -> int:
    _check(asked)
    rows = Rows.parse(asked.rows)
    spec = StreamSpec.from_dict({"recipe": recipe_setting(asked.recipe or "paper", asked.set)})
    spec.recipe.warn()
    named = asked.forms if asked.beside is None else [BESIDE, *asked.forms]
    compared = settings(named, spec, axes(asked.vary))
    cv2.setNumThreads(1)
    keep_freed_memory()
    warm_up()
    with tempfile.TemporaryDirectory(prefix="v2v-tradeoff-") as folder, open_forms(
        asked.videos, rows, compared, beside=asked.beside, most_clips=asked.clips, folder=Path(folder),
    ) as corpus:  # fmt: skip
        records = _measured(corpus, compared)
    print(tables(records))
    if asked.json is not None:
        write_json(asked.json, records)
    return 0 if asked.target_rate is asked.max_error is None else choose(records, compared, asked)


def _measured(corpus: Mapping[str, Catalogue], compared: Sequence[ServeSetting]) -> list[dict[str, Any]]:
    """Return the records of all settings, of the two rows that give the scale, and of the diversity."""
    leases = {
        setting: leases_of(setting, corpus[setting.form])
        for setting in dict.fromkeys((*(each.single for each in compared), *(each.exact for each in compared)))
    }
    show(f"timing {len(compared)} settings", sys.stderr)
    works = {each.name: making(leases[each.single], each.spec.samples_per_decode) for each in compared}
    seconds = cpu_seconds(works, max(len(each.each) for each in leases.values()))
    records, others, rates = list[dict[str, Any]](), list[dict[str, Any]](), dict[ServeSetting, dict[str, Any]]()
    for recipe in dict.fromkeys(each.spec.recipe for each in compared):
        mine = list(dict.fromkeys(each.exact for each in compared if each.spec.recipe == recipe))
        show(f"rendering what the clips show: {', '.join(each.way for each in mine)}", sys.stderr)
        found, by_speed = true_rates(leases[mine[0]], {each.spec.substep_px: each.way for each in mine})
        rates |= {each: found[each.spec.substep_px] for each in mine}
        others += by_speed
    for exact in dict.fromkeys(each.exact for each in compared):
        mine = [setting for setting in compared if setting.exact == exact]
        show(f"comparing {len(mine)} settings with {exact.way}", sys.stderr)
        sums = accuracy(leases[exact], {setting.way: leases[setting.single] for setting in mine})
        for setting in mine:
            spec, clips, source = setting.spec, corpus[setting.form], corpus[SOURCE]
            taken = seconds[setting.name]
            records.append({
                "measure": "setting", "name": setting.name, "way": setting.way, "form": setting.form,
                "samples_per_decode": spec.samples_per_decode, "substep_px": spec.substep_px,
                "bytes_ratio": _nbytes(clips) / _nbytes(source),
                "bytes_per_video_second": _nbytes(clips) / _seconds(source),
                "samples_per_core_second": 1.0 / taken, "cpu_seconds_per_sample": taken,
                "speed_ratio": seconds[compared[0].name] / taken, **error_fields(sums[setting.way]), **rates[exact],
            })  # fmt: skip
        if exact == compared[0].exact:
            others += ({"measure": "scale", "way": row, **error_fields(sums[row])} for row in (NOISE_ROW, DRAW_ROW))
    for recipe in dict.fromkeys(each.spec.recipe for each in compared):
        names = {each.name for each in compared if each.spec.recipe == recipe}
        name_dominated([record for record in records if record["name"] in names])
    show("measuring diversity", sys.stderr)
    return records + others + diversity(leases[compared[0].single])


def _nbytes(clips: Catalogue) -> int:
    return sum(clips.path(video.id).stat().st_size for video in clips.videos)


def _seconds(clips: Catalogue) -> float:
    return sum(video.frames / video.frames_per_second for video in clips.videos if video.frames_per_second)


def choose(records: Sequence[Mapping[str, Any]], compared: Sequence[ServeSetting], asked: argparse.Namespace) -> int:
    """Print the best setting and write it to ``--preset-out``; return 1 where no setting fulfils the wish."""
    fit = [record for record in records if record["measure"] == "setting"]
    try:
        record = best(fit, target_rate=asked.target_rate, max_error=asked.max_error)
    except UsageError as error:
        show(f"v2v-tradeoff: {error}", sys.stderr)
        return FAILED
    rate, worst = record["samples_per_core_second"], error_of(record)
    print(f"best: {record['name']}: {rate:.3g} samples a core second, error {worst:.3g}")
    if asked.preset_out is not None:
        (chosen,) = (setting for setting in compared if setting.name == record["name"])
        write_file(asked.preset_out, chosen.yaml(asked.rows, reasons(record)), "--preset-out")
    return 0


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    return run_command(_parser(), _run, argv)


if __name__ == "__main__":
    sys.exit(main())
