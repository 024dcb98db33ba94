"""Speed against accuracy, diversity and disk: what every knob that buys speed gains, and what it costs.

    v2v-bench tradeoff --videos CLIPS --json tradeoff.json --plot tradeoff.png
    v2v-bench tradeoff --videos CLIPS --target-rate 10 --preset-out fast.yaml

Speed is samples per second of processor time of a server worker's own work (decoding, view, simulation): the fastest of
several rounds in which all settings take turns. Errors are those of ``bench/tradeoff/errors.py``, against the same
camera with the same noise on exactly decoded frames. Disk is bytes a second of video, of the rows that are used where
a corpus is prepared. A setting is dominated when another one is at least as fast, as right, as diverse (samples per
decode) and as small, and better in one of them.

With --target-rate or --max-error the best setting is named, and written by --preset-out for ``v2v-serve --config``; the
exit status is 1 where no setting fulfils the wish.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2

from bench.records import recipe_of, say_missed, write
from bench.tradeoff.accuracy import DRAW_ROW, NOISE_ROW, accuracy, spurious
from bench.tradeoff.diversity import diversity
from bench.tradeoff.forms import DEFAULT_FORMS, ENCODINGS, SOURCE, Form, forms
from bench.tradeoff.front import best
from bench.tradeoff.knobs import EXACT, Setting, settings, write_preset
from bench.tradeoff.other import knobs
from bench.tradeoff.report import ERROR_KEY, error_fields, name_dominated, other_records, plot, print_tables
from bench.tradeoff.speed import Speed, Work, leases_of, making, measure
from v2v_protocol.errors import UsageError, V2VError
from v2v_protocol.spec import StreamSpec
from v2v_server.simulation.variants import warm_up
from v2v_server.system.process import keep_freed_memory
from v2v_server.video.rows import Rows

_SHARE_OF_SETTINGS = 0.8
"""Part of the time that is over when the other knobs' turns begin."""
_QUICK_ROUNDS = 20


def measured(corpus: Mapping[str, Form], spec: StreamSpec, places: int, until: float) -> list[dict[str, Any]]:
    """Records of all settings and of the two rows that give the scale.

    Args:
        corpus: in its forms.
        spec: the exact one.
        places: how many sequences.
        until: reading of ``time.monotonic`` at which the timing ends.
    """
    chosen = settings([name for name in corpus if name != SOURCE])
    sources = {name: (form.clips.folder, leases_of(form.clips, spec, places)) for name, form in corpus.items()}
    say(f"comparing {len(sources)} forms of the corpus")
    tallies = accuracy(sources, SOURCE)
    recipe = spec.recipe
    crop = recipe.crop_height_px, recipe.crop_width_px
    still = {name: spurious(form.stills, crop) for name, form in corpus.items()}
    say(f"timing {len(chosen)} settings")
    works: dict[str, Work] = {}
    for setting in chosen:
        root, leases = sources[setting.form]
        works[setting.name] = making(root, leases, setting.samples_per_decode)
    speeds = measure(works, until=until)
    exact = speeds[EXACT.name]
    records = [
        _record(setting, speeds[setting.name], exact, corpus)
        | error_fields(tallies[setting.form])
        | {f"events_on_still_at_{threshold:g}": rate for threshold, rate in still[setting.form].items()}
        for setting in chosen
    ]
    name_dominated(records)
    return records + [
        {"measure": "scale", "name": name, **error_fields(tallies[name])} for name in (NOISE_ROW, DRAW_ROW)
    ]


def _record(setting: Setting, speed: Speed, exact: Speed, corpus: Mapping[str, Form]) -> dict[str, Any]:
    return {
        "measure": "setting",
        "name": setting.name,
        **dataclasses.asdict(setting),
        "samples_per_core_second": 1.0 / speed.fastest,
        "cpu_seconds_per_sample": speed.fastest,
        "median_cpu_seconds_per_sample": speed.median,
        "speed_ratio": exact.fastest / speed.fastest,
        "rounds": speed.rounds,
        "bytes_ratio": corpus[setting.form].nbytes / corpus[SOURCE].nbytes,
        "bytes_per_video_second": corpus[setting.form].nbytes / corpus[setting.form].seconds,
    }


def say(text: str) -> None:
    """Progress, for whoever waits."""
    print(text, file=sys.stderr, flush=True)


def work(asked: argparse.Namespace) -> int:
    """Measures, prints, writes; returns the exit status.

    Raises:
        V2VError: wrong usage or input.
    """
    wishes = [wish for wish in (asked.target_rate, asked.max_error) if wish is not None]
    if asked.preset_out is not None and not wishes:
        raise UsageError("--preset-out writes the best setting: say for what, with --target-rate or --max-error")
    if not 0 < asked.budget_minutes < math.inf or min(asked.places, asked.clips) < 1:
        raise UsageError("--budget-minutes, --places and --clips: give more than 0")
    if any(not 0 <= wish < math.inf for wish in wishes):
        raise UsageError("--target-rate and --max-error: give a number from 0 on")
    for name in asked.forms:
        if name not in ENCODINGS:
            raise UsageError(f"--forms {name!r}: choose of {', '.join(ENCODINGS)}")
    begun, budget = time.monotonic(), 60.0 * asked.budget_minutes
    spec = StreamSpec(recipe=recipe_of(asked.changes))
    cv2.setNumThreads(1)
    keep_freed_memory()
    warm_up()
    rows = Rows.parse(asked.rows)
    with tempfile.TemporaryDirectory(prefix="v2v-tradeoff-") as folder, forms(
        asked.videos, rows, spec, asked.forms, most_clips=asked.clips, folder=Path(folder)
    ) as corpus:  # fmt: skip
        records = measured(corpus, spec, asked.places, begun + _SHARE_OF_SETTINGS * budget)
        source = corpus[SOURCE].clips
        say("measuring diversity and the other knobs")
        records += diversity(source.folder, leases_of(source, spec, asked.places))
        others = knobs(source, spec, -(-asked.places // 3))
        slow, quick = (
            {n: knob.work for n, knob in others.items() if knob.quick == is_quick} for is_quick in (False, True)
        )
        speeds = measure(slow, until=begun + budget) | measure(quick, until=0.0, least_rounds=_QUICK_ROUNDS)
        records += other_records(others, speeds)
    print_tables(records)
    write(records, asked.json)
    if asked.plot is not None:
        plot(records, asked.plot)
    return choose(records, asked) if wishes else 0


def choose(records: Sequence[Mapping[str, Any]], asked: argparse.Namespace) -> int:
    """Names the best setting, and writes it where that was asked for; returns 1 where no setting fulfils the wish."""
    fit = [
        record
        for record in records
        if record["measure"] == "setting" and record["samples_per_decode"] <= asked.most_samples_per_decode
    ]
    try:
        record = best(fit, error_key=ERROR_KEY, target_rate=asked.target_rate, max_error=asked.max_error)
    except UsageError as error:
        return say_missed([str(error)])
    why = f"{record['samples_per_core_second']:.3g} samples a core second, {ERROR_KEY} {record[ERROR_KEY]:.3g}"
    print(f"best: {record['name']}: {why}")
    if asked.preset_out is not None:
        write_preset(asked.preset_out, record, asked.rows, why)
    return 0


def parser() -> argparse.ArgumentParser:
    """The flags."""
    first, _, rest = (__doc__ or "").partition("\n\n")
    made = argparse.ArgumentParser(
        prog="python -m bench.tradeoff.tradeoff", description=first, epilog=rest,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    made.add_argument("--videos", required=True, type=Path, metavar="DIR", help="a corpus that is not prepared")
    made.add_argument("--rows", default="top:0.54", help="of the pictures (default top:0.54)")
    made.add_argument("--clips", type=int, default=4, metavar="N", help="different clips to take (default 4)")
    made.add_argument("--places", type=int, default=8, metavar="N", help="sequences to sample (default 8)")
    made.add_argument(
        "--forms", default=list(DEFAULT_FORMS), type=lambda text: [part.strip() for part in text.split(",")],
        metavar="FORM,FORM", help=f"how to prepare, of {', '.join(ENCODINGS)} (default {', '.join(DEFAULT_FORMS)})",
    )  # fmt: skip
    made.add_argument(
        "--budget-minutes", type=float, default=8.0, metavar="N",
        help="preparing and two rounds come first, whatever they take; then rounds until so long after the start (8)",
    )  # fmt: skip
    made.add_argument("--set", dest="changes", action="append", default=[], metavar="KEY=VALUE", help="recipe field")
    wish = made.add_mutually_exclusive_group()
    wish.add_argument("--target-rate", type=float, metavar="R", help="samples a core second to reach")
    wish.add_argument("--max-error", type=float, metavar="E", help=f"largest {ERROR_KEY}, for instance 0.05")
    made.add_argument(
        "--most-samples-per-decode", type=int, default=4, choices=(1, 2, 4), help="of the best setting (default 4)"
    )
    made.add_argument("--preset-out", type=Path, metavar="FILE.yaml", help="the best setting, for v2v-serve --config")
    made.add_argument("--json", type=Path, metavar="FILE", help="write the records there")
    made.add_argument("--plot", type=Path, metavar="FILE.png", help="draw them")
    return made


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; returns the exit status."""
    asked = parser().parse_args(arguments)
    try:
        return work(asked)
    except (V2VError, OSError) as error:
        print(f"tradeoff: {' '.join(str(error).split())}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
