"""What `v2v-tradeoff` says of sub-steps, beside what is true.

    python -m bench tradeoff --json tradeoff.json

A scene is rendered at any time, apart from all that the command uses (``tests/oracles/rendered.py``), and its frames of
30 Hz are encoded without loss to a clip that the command judges. The truth is the scene's own events, from levels that
are a quarter of a pixel apart and linear in between, in the same bins: signed bins of a frame, c = 0.2. Both start from
equal residuals, uniform between the thresholds as the recipe draws them. "told" is the
error of ``substep_px`` 0 and 1 that the command gives, "near" whether it is within a third of the true one or within
one point, "named" whether the better one is named, where they differ by more than two points. ``--choosing`` takes
other scenes: thresholds of the command are chosen on those, and not on these.

Bars: of what is told, eight of ten are near; of things smaller than a block nothing wrong is told; the better one is
always named.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bench.frame import Column, Report, progress
from tests.clips import write_clip
from tests.oracles.rendered import (
    GAMMA,
    LOG_EPS,
    SMALL,
    Counts,
    Errors,
    RenderedScene,
    counts_of,
    errors,
    log_levels,
    rendered_scene,
)
from v2v_protocol.command import Parser
from v2v_protocol.recipe import PRESETS
from v2v_protocol.spec import StreamSpec
from v2v_server.simulation.kernels import Carried, fill
from v2v_server.video.rows import Rows
from v2v_tools.tradeoff.measures import Leases, leases_of, seen, simulated
from v2v_tools.tradeoff.rendered import true_rates
from v2v_tools.tradeoff.report import ERROR_THRESHOLD, TRUE_RATE
from v2v_tools.tradeoff.settings import SOURCE, axes, open_forms, settings

SIDES_PX, FRAMES_PER_SECOND, STEPS = (128, 160), 30, 10
MOMENTS_PER_PX, LEAST_MOMENTS = 4, 12
NEAR_SHARE, NEAR_POINTS, APART_POINTS, LEAST_NEAR = 1 / 3, 0.01, 0.02, 0.8
RECIPE = PRESETS["noise-free"].replace(
    crop_height_px=SIDES_PX[0], crop_width_px=SIDES_PX[1], resize_scale=1.0, flip_probability=0.0, bins=1,
    voxels_per_clip=STEPS, threshold=ERROR_THRESHOLD, threshold_ratio=1.0, gamma=GAMMA, log_eps=LOG_EPS,
)  # fmt: skip


class Case(NamedTuple):
    """A scene of ``rendered_scene`` at a speed, and its photographs."""

    name: str
    px_per_frame: float
    behind: str = "camera"
    shown: str | None = None

    def scene(self) -> RenderedScene:
        """Return what is rendered."""
        return rendered_scene(
            self.name, *SIDES_PX, self.px_per_frame * FRAMES_PER_SECOND, self.behind, self.shown
        )  # fmt: skip


def cases(choosing: bool) -> list[Case]:
    """Return the scenes; those that thresholds are chosen on are none of those that are reported."""
    if choosing:
        return [
            *(Case("coins", px) for px in (1.5, 5.0, 14.0)),
            *(Case("grass", px) for px in (1.0, 6.0)),
            *(Case(name, px) for name in ("rocket", "cell", "hubble_deep_field") for px in (1.0, 6.0)),
            *(Case("zoom", px, shown="rocket") for px in (1.5, 5.0)),
            Case("rotation", 4.0, shown="rocket"),
            *(Case("occlusion", px, "grass", "coins") for px in (1.5, 7.0)),
            *(Case("discs", px, "chelsea") for px in (1.5, 4.0, 10.0)),
            *(Case(name, px, "chelsea") for name in SMALL for px in (4.0, 12.0)),
        ]
    return [
        *(Case("coffee", px) for px in (1.0, 4.0, 12.0, 40.0)),
        *(Case("astronaut", px) for px in (2.0, 8.0, 20.0)),
        *(Case("gravel", px) for px in (1.0, 3.0, 9.0)),
        *(Case("zoom", px) for px in (1.0, 3.0, 8.0)),
        *(Case("rotation", px) for px in (2.0, 6.0)),
        *(Case("occlusion", px) for px in (2.0, 5.0, 12.0)),
        *(Case("discs", px) for px in (1.0, 3.0, 6.0, 20.0)),
        *(Case(name, 4.0) for name in ("plain", "thin", "parallax")),
        *(Case(name, px) for name in SMALL for px in (3.0, 8.0, 20.0)),
    ]


def measured(case: Case) -> Iterator[dict[str, Any]]:
    """Yield one record for each setting of a scene."""
    scene = case.scene()
    compared = settings([], StreamSpec(RECIPE), axes(["samples_per_decode=1"]))
    with tempfile.TemporaryDirectory(prefix="v2v-bench-") as name:
        folder = Path(name)
        frames = scene.frames(FRAMES_PER_SECOND, STEPS + 1)
        write_clip(folder / "clips" / "a.mkv", frames, codec="ffv1", rate=FRAMES_PER_SECOND, full_range=True)
        (folder / "made").mkdir()
        with open_forms(
            folder / "clips", Rows(), compared, beside=None, most_clips=1, folder=folder / "made"
        ) as corpus:  # fmt: skip
            source, true = corpus[SOURCE], dict[int, Counts]()
            leases = {setting.spec.substep_px: leases_of(setting, source) for setting in compared}
            told, _ = true_rates(leases[0.0], dict.fromkeys(leases, ""))
            for substep_px, each in leases.items():
                wrong = true_errors(scene, case, each, true)
                signed, _, count = (told[substep_px][measure.key] for measure in TRUE_RATE)
                yield {
                    **case._asdict(), "substep_px": substep_px, "lost_share": told[substep_px]["lost_share"],
                    "told": signed, "told_count": count, "true": wrong.signed, "true_count": wrong.count,
                }  # fmt: skip


def true_errors(scene: RenderedScene, case: Case, leases: Leases, true: dict[int, Counts]) -> Errors:
    """Return how far the events of a setting are from those of the scene.

    Args:
        true: those of each first frame, which are added.
    """
    made, start = [], np.random.default_rng(0).uniform(-ERROR_THRESHOLD, ERROR_THRESHOLD, math.prod(SIDES_PX))
    for number, lease in enumerate(leases.each):
        (context,), first = seen(leases, number), lease.start_frame
        voxels = simulated(context, context.params)
        before = start.astype(voxels.real)[None]
        given = dataclasses.replace(voxels.given, carried=Carried(before, np.empty_like(before), resumes=True))
        counts = fill(given, voxels.real, {"event_counts": None})[0]["event_counts"].reshape(STEPS, 2, -1)
        made.append(Counts(*counts[:, ::-1].astype(np.int64).swapaxes(0, 1)))
        if first not in true:
            moments = max(LEAST_MOMENTS, round(MOMENTS_PER_PX * case.px_per_frame))
            seconds = (first + np.arange(STEPS * moments + 1) / moments) / FRAMES_PER_SECOND
            levels = np.stack([log_levels(scene.light(time)).ravel() for time in seconds.tolist()])
            true[first] = counts_of(levels, seconds, seconds[::moments], ERROR_THRESHOLD, start)
    pairs = made, [true[lease.start_frame] for lease in leases.each]
    return errors(*(Counts(*map(np.concatenate, zip(*each, strict=True))) for each in pairs))


def judged(records: list[dict[str, Any]]) -> tuple[list[dict[str, Any]], list[str], list[str]]:
    """Return one record a scene with both settings, lines about them all, and the bars that are missed."""
    rows = []
    for without, divided in zip(records[::2], records[1::2], strict=True):
        row = {key: without[key] for key in ("name", "px_per_frame", "lost_share")}
        row["shown"] = without["shown"] or without["behind"] if without["name"] != without["behind"] else None
        for way, record in (("without", without), ("divided", divided)):
            row |= {f"{key}_{way}": record[key] for key in ("told", "true", "true_count", "told_count")}
            if record["told"] is not None:
                row[f"near_{way}"] = abs(record["told"] - record["true"]) <= max(
                    NEAR_POINTS, NEAR_SHARE * record["true"]
                )  # fmt: skip
        apart = divided["true"] - without["true"]
        if without["told"] is not None and abs(apart) > APART_POINTS:
            row["named"] = (divided["told"] - without["told"]) * apart > 0
        rows.append(row)
    near = [row[key] for row in rows for key in ("near_without", "near_divided") if key in row]
    named = [row["named"] for row in rows if "named" in row]
    small = [
        row for row in rows if row['name'] in SMALL and not all(row.get(f"near_{way}", True) for way in ("without",
        "divided"))
    ]  # fmt: skip
    lines = [
        f"told: {len(near) // 2} of {len(rows)} scenes; near: {sum(near)} of {len(near)} errors; the better one named: "
        f"{sum(named)} of {len(named)}; wrongly told of {' and '.join(SMALL)}: {len(small)}"
    ]
    missed = []
    if sum(near) < LEAST_NEAR * len(near):
        missed.append(f"near: {sum(near)} of {len(near)}; the bar is at least {LEAST_NEAR:.0%}")
    missed += [f"{row['name']} at {row['px_per_frame']:g} px: something wrong is told" for row in small]
    missed += [
        f"{row['name']} at {row['px_per_frame']:g} px: the worse setting is named"
        for row in rows if not row.get("named", True)
    ]  # fmt: skip
    return rows, lines, missed


def add_flags(parser: Parser) -> None:
    """Add the bench's flags."""
    parser.add_argument("--choosing", action="store_true", help="the scenes that thresholds are chosen on")


def measure(asked: argparse.Namespace) -> Report:
    """Run the bench."""
    records: list[dict[str, Any]] = []
    for case in cases(asked.choosing):
        progress(f"{case.name}, {case.px_per_frame:g} px a frame")
        records += measured(case)
    rows, lines, missed = judged(records)
    columns: list[Column] = [("name", "scene", "{}", 1), ("shown", "photograph", "{}", 1)]
    columns += [("px_per_frame", "px a frame", "{:g}", 1)]
    for way, title in (("without", "substep_px 0"), ("divided", "1")):
        columns += [
            (f"told_{way}", f"{title}: told", "{:.1%}", 1), (f"true_{way}", "true", "{:.1%}", 1),
            (f"near_{way}", "near", "{}", 1), (f"told_count_{way}", "count told", "{:+.0%}", 1),
            (f"true_count_{way}", "true", "{:+.0%}", 1),
        ]  # fmt: skip
    columns += [("named", "named", "{}", 1)]
    return Report(records, [(rows, columns)], lines, missed)
