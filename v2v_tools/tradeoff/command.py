"""The command line of `v2v-tradeoff`."""

from __future__ import annotations

import argparse
import math
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from itertools import cycle, islice
from pathlib import Path
from typing import Any

import cv2

from v2v_protocol.command import FAILED, JSON, Parser, run_command
from v2v_protocol.errors import UsageError
from v2v_protocol.spec import StreamSpec
from v2v_protocol.spec_flags import add_recipe, recipe_setting
from v2v_protocol.write_aside import write_file, write_json
from v2v_server.simulation.precision import warm_up
from v2v_server.system.process import keep_freed_memory
from v2v_server.video.rows import Rows
from v2v_tools.tradeoff.accuracy import DRAW_ROW, NOISE_ROW, Places, accuracy, parts
from v2v_tools.tradeoff.diversity import diversity
from v2v_tools.tradeoff.forms import BESIDE, DEFAULT_FORMS, SOURCE, STORES, CorpusForm, forms
from v2v_tools.tradeoff.front import best
from v2v_tools.tradeoff.report import ERROR_KEY, error_fields, name_dominated, plot, tables
from v2v_tools.tradeoff.settings import ServeSetting, axes, full_model, planes_for, settings
from v2v_tools.tradeoff.speed import leases_of, making, measure

_FORMS_SHARE, _ACCURACY_SHARE, _DIVERSITY_SHARE = 0.5, 0.7, 0.8
"""Shares of the budget at which preparing, comparing and the diversity end; timing has the rest."""


def _parser() -> Parser:
    parser = Parser(
        "v2v-tradeoff", "--videos DIR [flags]",
        "Measure on your clips what each way to serve them costs: processor time, disk space, voxel error against the "
        "recipe's own full model, and diversity, for the source, stores and another encoding, with all combinations of "
        "the values of some fields. A setting is dominated when another one is at least as good in everything and "
        "better in one thing. Name the best setting for a wish, and write it for v2v-serve --config.",
        [
            "v2v-tradeoff --videos clips/ --json tradeoff.json --plot tradeoff.png",
            "v2v-tradeoff --videos clips/ --target-rate 20 --vary samples_per_decode=1,2 --preset-out chosen.yaml",
            "v2v-tradeoff --videos clips/ --beside smaller/ --forms 'lossless dense'",
            "v2v-tradeoff --videos clips/ --recipe my_camera.yaml --vary tolerance=0,0.01 --max-error 0.02",
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
    videos.add_argument("--clips", type=int, default=4, metavar="N", help="different clips to take (default 4)")
    videos.add_argument("--places", type=int, default=8, metavar="N", help="sequences to sample (default 8)")
    add_recipe(parser, "Videos")
    work = parser.group("Work")
    work.add_argument(
        "--vary", action="append", default=[], metavar="KEY=VALUE,VALUE",
        help="values to compare of samples_per_decode (default 1,2,4), substep_px (default 0,1), tolerance, or a field "
        "of the recipe such as voxel_seconds; may be repeated",
    )  # fmt: skip
    work.add_argument(
        "--forms", default=",".join(DEFAULT_FORMS), metavar="FORM,FORM",
        help=f"ways to prepare the clips, from {', '.join(STORES)} (default {', '.join(DEFAULT_FORMS)})",
    )  # fmt: skip
    work.add_argument(
        "--budget-minutes", type=float, default=8.0, metavar="X",
        help="minutes for everything (default 8): forms that do not fit are left out, then places, then rounds; "
        "the source, one place and one round are always measured",
    )  # fmt: skip
    wishes = parser.group("Wish")
    wish = wishes.add_mutually_exclusive_group()
    wish.add_argument("--target-rate", type=float, metavar="X", help="least number of samples a second of one core")
    wish.add_argument("--max-error", type=float, metavar="X", help="largest voxel error, as a share: 0.05 is 5 %%")
    parser.add_output("Output", "--preset-out", (".yaml", ".yml"), "write the best setting for v2v-serve (.yaml)")
    parser.add_output("Output", "--json", JSON, "write the records")
    parser.add_output("Output", "--plot", (".png", ".pdf", ".svg"), "draw speed against error (needs matplotlib)")
    return parser


def _check(asked: argparse.Namespace) -> None:
    wishes = [wish for wish in (asked.target_rate, asked.max_error) if wish is not None]
    if asked.preset_out is not None and not wishes:
        raise UsageError("--preset-out without a wish: give --target-rate or --max-error too")
    if not 0 < asked.budget_minutes < math.inf:
        raise UsageError(f"--budget-minutes {asked.budget_minutes:g}: give a finite number above 0")
    for flag, value in (("--places", asked.places), ("--clips", asked.clips)):
        if value < 1:
            raise UsageError(f"{flag} {value}: give 1 or more")
    for wish in wishes:
        if not 0 <= wish < math.inf:
            raise UsageError(f"{wish:g}: --target-rate and --max-error are finite numbers from 0 on")
    asked.forms = [name.strip() for name in asked.forms.split(",")]
    for name in asked.forms:
        if name not in STORES:
            raise UsageError(f"--forms {name!r}: choose from {', '.join(STORES)}")


def _run(asked: argparse.Namespace) -> int:
    begun = time.monotonic()
    _check(asked)
    budget = 60.0 * asked.budget_minutes
    rows = Rows.parse(asked.rows)
    spec = StreamSpec.from_dict({"recipe": recipe_setting(asked.recipe or "paper", asked.set)})
    named = asked.forms if asked.beside is None else [BESIDE, *asked.forms]
    compared = settings(named, spec, axes(asked.vary))
    cv2.setNumThreads(1)
    keep_freed_memory()
    warm_up()
    with tempfile.TemporaryDirectory(prefix="v2v-tradeoff-") as folder, forms(
        asked.videos, rows, spec, asked.forms, beside=asked.beside,
        planes=planes_for(setting.spec for setting in compared), most_clips=asked.clips, folder=Path(folder),
        until=begun + _FORMS_SHARE * budget, tell=_tell,
    ) as corpus:  # fmt: skip
        compared = [setting for setting in compared if setting.form in corpus]
        records = _measured(corpus, compared, asked.places, begun, budget)
    print(tables(records))
    print(f"{(time.monotonic() - begun) / 60:.1f} minutes; the budget was {asked.budget_minutes:g}")
    if asked.json is not None:
        write_json(asked.json, records)
    if asked.plot is not None:
        plot(records, asked.plot)
    return 0 if asked.target_rate is asked.max_error is None else choose(records, compared, asked)


def _measured(
    corpus: Mapping[str, CorpusForm], compared: Sequence[ServeSetting], places: int, begun: float, budget: float
) -> list[dict[str, Any]]:
    """Return the records of all settings, of the two rows that give the scale, of the parts, and of the diversity."""
    models = {setting: full_model(setting, compared) for setting in compared}
    sources = {
        setting: Places(corpus[setting.form].clips.folder, leases_of(corpus[setting.form].clips, setting.spec, places))
        for setting in dict.fromkeys((*(setting.single for setting in compared), *models.values()))
    }
    for setting, source in sources.items():  # longer grids may give fewer places
        if not source.leases:
            raise UsageError(f"{setting.name}: none of the clips is long enough for a sequence")
    records, scale = [], []
    for number, model in enumerate(dict.fromkeys(models.values())):
        mine = [setting for setting in compared if models[setting] == model]
        singles = {setting.single.name: sources[setting.single] for setting in mine}
        _tell(f"comparing {len(singles)} ways to make samples")
        tallies = accuracy(sources[model], singles, until=begun + _ACCURACY_SHARE * budget)
        for setting in mine:
            records.append(_record(setting, corpus) | error_fields(tallies[setting.single.name]))
        if not number:
            scale = [{"measure": "scale", "way": name, **error_fields(tallies[name])} for name in (NOISE_ROW, DRAW_ROW)]
    _tell("measuring diversity and the parts of a sample")
    first = sources[compared[0].single]
    alike = diversity(first, until=begun + _DIVERSITY_SHARE * budget)
    taken = [
        {"measure": "parts", "way": setting.way} | parts(source, until=begun + _DIVERSITY_SHARE * budget)
        for setting, source in sources.items()
        if setting.form == SOURCE and setting in {each.single for each in compared}
    ]
    _tell(f"timing {len(compared)} settings")
    count = max(len(source.leases) for source in sources.values())
    works = {}
    for setting in compared:
        root, leases = sources[setting.single]
        works[setting.name] = making(root, list(islice(cycle(leases), count)), setting.spec.samples_per_decode)
    speeds = measure(works, until=begun + budget)
    for record in records:
        speed, exact = speeds[record["name"]], speeds[compared[0].name]
        record |= {
            "samples_per_core_second": 1.0 / speed.fastest, "cpu_seconds_per_sample": speed.fastest,
            "median_cpu_seconds_per_sample": speed.median, "speed_ratio": exact.fastest / speed.fastest,
            "rounds": speed.rounds,
        }  # fmt: skip
    for recipe in {setting.spec.recipe for setting in compared}:
        same = {setting.name for setting in compared if setting.spec.recipe == recipe}
        name_dominated([record for record in records if record["name"] in same])
    return records + scale + taken + alike


def _record(setting: ServeSetting, corpus: Mapping[str, CorpusForm]) -> dict[str, Any]:
    form, spec = corpus[setting.form], setting.spec
    return {
        "measure": "setting", "name": setting.name, "way": setting.way, "form": setting.form,
        "samples_per_decode": spec.samples_per_decode, "substep_px": spec.substep_px, "tolerance": spec.tolerance,
        "bytes_ratio": form.nbytes / corpus[SOURCE].nbytes, "bytes_per_video_second": form.nbytes / form.seconds,
    }  # fmt: skip


def _tell(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def choose(records: Sequence[Mapping[str, Any]], compared: Sequence[ServeSetting], asked: argparse.Namespace) -> int:
    """Print the best setting and write it to ``--preset-out``; return 1 where no setting fulfils the wish."""
    fit = [record for record in records if record["measure"] == "setting"]
    try:
        record = best(fit, error_key=ERROR_KEY, target_rate=asked.target_rate, max_error=asked.max_error)
    except UsageError as error:
        _tell(f"v2v-tradeoff: {error}")
        return FAILED
    why = f"{record['samples_per_core_second']:.3g} samples a core second, {ERROR_KEY} {record[ERROR_KEY]:.3g}"
    print(f"best: {record['name']}: {why}")
    if asked.preset_out is not None:
        (chosen,) = (setting for setting in compared if setting.name == record["name"])
        write_file(asked.preset_out, chosen.yaml(asked.rows, why), "--preset-out")
    return 0


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    return run_command(_parser(), _run, argv)


if __name__ == "__main__":
    sys.exit(main())
