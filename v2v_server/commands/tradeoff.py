"""The command line of `v2v-tradeoff`."""

from __future__ import annotations

import argparse
import dataclasses
import math
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from itertools import cycle, islice
from pathlib import Path
from typing import Any

import cv2

from v2v_protocol.command import FAILED, Parser, run_command
from v2v_protocol.errors import UsageError
from v2v_protocol.records import write_json
from v2v_protocol.spec import StreamSpec
from v2v_server.config import recipe_setting
from v2v_server.motion.prediction import SUBSTEP_PX, Prediction
from v2v_server.simulation.variants import warm_up
from v2v_server.system.process import keep_freed_memory
from v2v_server.tradeoff.accuracy import DRAW_ROW, NOISE_ROW, accuracy, predicted_loss, spurious
from v2v_server.tradeoff.diversity import diversity
from v2v_server.tradeoff.forms import DEFAULT_FORMS, ENCODINGS, SOURCE, CorpusForm, forms
from v2v_server.tradeoff.front import best
from v2v_server.tradeoff.report import ERROR_KEY, error_fields, name_dominated, plot, tables
from v2v_server.tradeoff.settings import EXACT, ServeSetting, settings, write_preset
from v2v_server.tradeoff.speed import Speed, TimedWork, leases_of, making, measure
from v2v_server.video.rows import Rows

_FORMS_SHARE, _ACCURACY_SHARE, _DIVERSITY_SHARE = 0.5, 0.7, 0.8
"""Shares of the budget at which preparing, comparing and the diversity end; timing has the rest."""


def _parser() -> Parser:
    parser = Parser(
        "v2v-tradeoff", "--videos DIR [flags]",
        "Measure on your clips what each way to serve them costs: processor time of a sample, disk space, voxel error "
        "and diversity, for the source, lossless stores and H.264, with 1, 2 or 4 samples a decode. A setting is "
        "dominated when another one is at least as good in all four and better in one. Name the best setting for a "
        "wish, and write it for v2v-serve --config.",
        [
            "v2v-tradeoff --videos clips/ --json tradeoff.json --plot tradeoff.png",
            "v2v-tradeoff --videos clips/ --target-rate 20 --most-samples-per-decode 2 --preset-out chosen.yaml",
        ],
        "Exit status: 1 where no setting fulfils --target-rate or --max-error.",
    )  # fmt: skip
    videos = parser.group("Videos")
    videos.add_argument("--videos", required=True, type=Path, metavar="DIR", help="a corpus that is not prepared")
    videos.add_argument("--rows", default="top:0.54", help="rows to use (default top:0.54, as for WebVid)")
    videos.add_argument("--clips", type=int, default=4, metavar="N", help="different clips to take (default 4)")
    videos.add_argument("--places", type=int, default=8, metavar="N", help="sequences to sample (default 8)")
    videos.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="change one recipe field")
    videos.add_argument(
        "--vary", action="append", default=[], metavar="KEY=VALUE,VALUE",
        help="also time samples with other values of one recipe field or of tolerance, for example "
        "voxel_seconds=0.02,0.1",
    )  # fmt: skip
    work = parser.group("Work")
    work.add_argument(
        "--forms", default=",".join(DEFAULT_FORMS), metavar="FORM,FORM",
        help=f"ways to prepare the clips, of {', '.join(ENCODINGS)} (default {', '.join(DEFAULT_FORMS)})",
    )  # fmt: skip
    work.add_argument(
        "--budget-minutes", type=float, default=8.0, metavar="X",
        help="time for everything (default 8): forms that do not fit are left out, then places, then rounds; "
        "the source, one place and one round are always measured",
    )  # fmt: skip
    wishes = parser.group("Wish")
    wish = wishes.add_mutually_exclusive_group()
    wish.add_argument("--target-rate", type=float, metavar="X", help="samples a core second to reach")
    wish.add_argument("--max-error", type=float, metavar="X", help="largest voxel error, for example 0.05")
    wishes.add_argument(
        "--most-samples-per-decode", type=int, default=4, choices=(1, 2, 4), help="at most this K (default 4)"
    )
    out = parser.group("Output")
    out.add_argument("--preset-out", type=Path, metavar="FILE.yaml", help="write the best setting for v2v-serve")
    out.add_argument("--json", type=Path, metavar="FILE", help="write the records")
    out.add_argument("--plot", type=Path, metavar="FILE.png", help="draw speed against error (needs matplotlib)")
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
        if name not in ENCODINGS:
            raise UsageError(f"--forms {name!r}: choose of {', '.join(ENCODINGS)}")


def _run(asked: argparse.Namespace) -> int:
    begun = time.monotonic()
    _check(asked)
    budget = 60.0 * asked.budget_minutes
    rows = Rows.parse(asked.rows)
    spec = StreamSpec.from_dict({"recipe": recipe_setting("paper", asked.set)})
    varied = dict(each for text in asked.vary for each in _varied(spec, text))
    cv2.setNumThreads(1)
    keep_freed_memory()
    warm_up()
    with tempfile.TemporaryDirectory(prefix="v2v-tradeoff-") as folder, forms(
        asked.videos, rows, spec, asked.forms, most_clips=asked.clips, folder=Path(folder),
        until=begun + _FORMS_SHARE * budget, tell=_tell,
    ) as corpus:  # fmt: skip
        records = _measured(corpus, spec, varied, asked.places, begun, budget)
    print(tables(records))
    print(f"{(time.monotonic() - begun) / 60:.1f} minutes; the budget was {asked.budget_minutes:g}")
    if asked.json is not None:
        write_json(asked.json, records)
    if asked.plot is not None:
        plot(records, asked.plot)
    return 0 if asked.target_rate is asked.max_error is None else choose(records, asked)


def _varied(spec: StreamSpec, text: str) -> Iterator[tuple[str, StreamSpec]]:
    """Yield the streams of one ``--vary``, by name.

    Raises:
        UsageError: it is not KEY=VALUE,VALUE, or a value is wrong.
    """
    key, equals, values = text.partition("=")
    if not equals:
        raise UsageError(f"--vary {text}: write KEY=VALUE,VALUE, for instance --vary voxel_seconds=0.02,0.1")
    for value in values.split(","):
        if key == "tolerance":
            yield f"{key} = {value}", StreamSpec.from_dict({key: value}, spec)
        else:
            changed = recipe_setting(None, [f"{key}={value}"], spec.recipe.to_dict())
            yield f"{key} = {value}", dataclasses.replace(spec, recipe=changed)


def _measured(
    corpus: Mapping[str, CorpusForm], spec: StreamSpec, varied: Mapping[str, StreamSpec], places: int, begun: float,
    budget: float,
) -> list[dict[str, Any]]:  # fmt: skip
    """Return the records of all settings, of the varied streams, of the two rows that give the scale, and of the
    diversity.
    """
    chosen = settings([name for name in corpus if name != SOURCE])
    sources = {name: (form.clips.folder, leases_of(form.clips, spec, places)) for name, form in corpus.items()}
    _tell(f"comparing {len(sources)} forms of the corpus")
    tallies = accuracy(sources, SOURCE, until=begun + _ACCURACY_SHARE * budget)
    crop = spec.recipe.crop_height_px, spec.recipe.crop_width_px
    still = {name: spurious(form.stills, crop) for name, form in corpus.items()}
    _tell("measuring diversity")
    alike = diversity(*sources[SOURCE], until=begun + _DIVERSITY_SHARE * budget)
    _tell(f"timing {len(chosen)} settings")
    works: dict[str, TimedWork] = {}
    for setting in chosen:
        root, leases = sources[setting.form]
        works[setting.name] = making(root, leases, setting.samples_per_decode)
    with_substeps = dataclasses.replace(spec, substep_px=SUBSTEP_PX)
    for name, form in corpus.items():
        works[_substeps_name(name, SUBSTEP_PX)] = making(
            form.clips.folder, leases_of(form.clips, with_substeps, places)
        )
    count = len(sources[SOURCE][1])
    for name, stream in varied.items():
        leases = leases_of(corpus[SOURCE].clips, stream, places)  # longer grids may give fewer places
        if not leases:
            raise UsageError(f"--vary {name}: none of the clips is long enough for a sequence")
        works[name] = making(corpus[SOURCE].clips.folder, list(islice(cycle(leases), count)))
    speeds = measure(works, until=begun + budget)
    records = [
        _record(setting, speeds[setting.name], speeds[EXACT.name], corpus)
        | error_fields(tallies[setting.form])
        | {f"events_on_still_at_{threshold:g}": rate for threshold, rate in still[setting.form].items()}
        for setting in chosen
    ]
    name_dominated(records)
    scale = [{"measure": "scale", "name": name, **error_fields(tallies[name])} for name in (NOISE_ROW, DRAW_ROW)]
    between = _substeps(corpus, speeds, predicted_loss(*sources[SOURCE]))
    others = [
        {
            "measure": "varied", "name": name, "samples_per_core_second": 1.0 / speeds[name].fastest,
            "cpu_seconds_per_sample": speeds[name].fastest,
            "speed_ratio": speeds[EXACT.name].fastest / speeds[name].fastest,
        }
        for name in varied
    ]  # fmt: skip
    return records + others + between + scale + alike


def _substeps_name(form: str, substep_px: float) -> str:
    return f"{form}, substep_px = {substep_px:g}"


def _substeps(corpus: Mapping[str, CorpusForm], speeds: Mapping[str, Speed], loss: Prediction) -> list[dict[str, Any]]:
    """Return the cost of each form without and with sub-steps, one sample a decode, beside the predicted errors."""
    records: list[dict[str, Any]] = []
    for form in corpus:
        for substep_px, key in ((0.0, "linear"), (SUBSTEP_PX, "divided")):
            name = _substeps_name(form, substep_px)
            seconds = speeds[name if substep_px else ServeSetting(form).name].fastest
            records.append(
                {
                    "measure": "substeps", "name": name, "form": form, "substep_px": substep_px,
                    "samples_per_core_second": 1.0 / seconds, "cpu_seconds_per_sample": seconds,
                    "px_per_frame": loss.px_per_frame,
                }
                | {
                    f"predicted_{error}": share if loss.can_be_followed or loss.is_slow else None
                    for error, share in loss.errors(key)._asdict().items()
                }
            )  # fmt: skip
    return records


def _record(setting: ServeSetting, speed: Speed, exact: Speed, corpus: Mapping[str, CorpusForm]) -> dict[str, Any]:
    form, source = corpus[setting.form], corpus[SOURCE]
    return {
        "measure": "setting",
        "name": setting.name,
        **dataclasses.asdict(setting),
        "samples_per_core_second": 1.0 / speed.fastest,
        "cpu_seconds_per_sample": speed.fastest,
        "median_cpu_seconds_per_sample": speed.median,
        "speed_ratio": exact.fastest / speed.fastest,
        "rounds": speed.rounds,
        "bytes_ratio": form.nbytes / source.nbytes,
        "bytes_per_video_second": form.nbytes / form.seconds,
    }


def _tell(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def choose(records: Sequence[Mapping[str, Any]], asked: argparse.Namespace) -> int:
    """Print the best setting and write it to ``--preset-out``; return 1 where no setting fulfils the wish."""
    fit = [
        record
        for record in records
        if record["measure"] == "setting" and record["samples_per_decode"] <= asked.most_samples_per_decode
    ]
    try:
        record = best(fit, error_key=ERROR_KEY, target_rate=asked.target_rate, max_error=asked.max_error)
    except UsageError as error:
        _tell(f"v2v-tradeoff: {error}")
        return FAILED
    why = f"{record['samples_per_core_second']:.3g} samples a core second, {ERROR_KEY} {record[ERROR_KEY]:.3g}"
    print(f"best: {record['name']}: {why}")
    if asked.preset_out is not None:
        write_preset(asked.preset_out, record, asked.rows, why)
    return 0


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    return run_command(_parser(), _run, argv)


if __name__ == "__main__":
    sys.exit(main())
