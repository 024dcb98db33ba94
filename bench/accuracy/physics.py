"""Measure the error of simulating from few frames, against exact events.

    python -m bench physics --video VIDEO --json physics.json --plot physics.png

Analytic scenes have events known from a formula. Photographs moved along a known path are rendered at 1200 frames a
second, and every frame is simulated event by event; so is a film of true high rate (``--video``). V2V gets every n-th
frame. Both sides start with the same residuals and are summed into the same bins.

    count error   (events of V2V - events) / events, whatever their sign
    voxel error   sum of |V2V - true| / sum of |true|, over the signed counts of common bins and pixels

With a low-pass, the events of a bin are those of its net change. The photograph "coffee" at 30 frames a second shows
how many of the events with 24 bins a frame fire with fewer bins.

A film also tells what the start of a clip costs: the voxel error of first grids of 5 frames, by start, against pixels
that have seen 60 frames before. Both sides are means of 16 draws; "floor" is what these leave.

Bars: scenes without a turn are exact at every frame rate; from all frames of the film, V2V and the event-by-event
simulation of the same frames differ in at most 60 bins of a million; its first grids are nearest with the start of
frames, then the triangular one.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from bench.frame import Column, Record, Report, beyond, panels
from tests.oracles.analytic_scenes import SECONDS, START_SHARE, analytic_scenes, moved_photograph
from tests.oracles.decoded import decode_luma
from tests.oracles.dense import bin_events, dense_events
from tests.oracles.noise import start_uniforms
from tests.oracles.rendered import GAMMA, LOG_EPS, Reals, log_levels
from v2v_protocol.command import Parser
from v2v_protocol.errors import UsageError
from v2v_protocol.recipe import FRAMES, Recipe
from v2v_server.simulation import simulate, simulate_log
from v2v_server.simulation.draw import noise_key_of_seed
from v2v_server.video.probe import probe

Records = list[dict[str, Any]]
Frames = npt.NDArray[np.uint8]

SEED = 7
RATES_HZ = (25, 50, 100, 200, 1000)
THRESHOLDS = (0.1, 0.2, 0.5, 1.0)
PHOTOGRAPHS = ("camera", "coffee", "astronaut", "rocket")
RENDERED_HZ, BIN_FRAMES, BINS = 1200, 48, 8
EVERY = (1, 2, 4, 8, 16, 48)
SPEEDS_PX = (0.005, 0.02, 0.1, 0.5)  # px per rendered frame: 6 to 600 px/s
VIDEO_EVERY, VIDEO_BIN_FRAMES, VIDEO_SIDE_PX = (1, 2, 4, 8, 16), 16, 320
LONG_RUN_IN, FIRST_GRID, MOST_STARTED, START_DRAWS = 60, 5, 600, 16
STARTED = "uniform", "triangular", FRAMES, "floor"
LARGEST_DIFFERENCE_PPM = 60.0
LOW_PASS_HZ, LOW_PASS_PX, PARTS = (30.0, 100.0, 300.0), (2.0, 6.0, 12.0), (1, 2, 3, 6, 24)


def analytic(threshold: float = 0.2) -> Iterator[dict[str, Any]]:
    """Yield one record for each analytic scene and frame rate."""
    edges = np.linspace(0.0, SECONDS, int(RATES_HZ[0] * SECONDS) + 1)
    for scene in analytic_scenes():
        true, events = scene.events(edges, threshold)
        for rate in RATES_HZ:
            frames = scene.level(np.arange(int(rate * SECONDS) + 1)[:, None] / rate)
            steps = len(frames) - 1
            fine = simulate_log(
                frames[:, None], threshold_pos=threshold, start_residual=START_SHARE * threshold, bins=steps,
                dtype="float32",
            ).voxels.reshape(steps, -1)  # fmt: skip
            yield {
                "measure": "analytic", "scene": scene.name, "monotone": scene.monotone, "threshold": threshold,
                "frame_rate_hz": rate, **errors(fine, true, events, len(edges) - 1),
            }  # fmt: skip


def errors(fine: npt.NDArray[Any], true: npt.NDArray[np.int64], events: int, bins: int) -> dict[str, float]:
    """Return count and voxel error of V2V's steps [steps, pixels] against the true bins [bins, pixels]."""
    coarse = fine.reshape(bins, -1, fine.shape[-1]).sum(axis=1, dtype=np.int64)
    made = int(np.abs(fine).sum(dtype=np.int64))
    return {
        "events_true": events,
        "events_v2v": made,
        "count_error": (made - events) / max(events, 1),
        "voxel_error": float(np.abs(coarse - true).sum() / max(np.abs(true).sum(), 1)),
        "voxel_net_true": int(np.abs(true).sum()),
        "differing_bins_ppm": float((coarse != true).mean() * 1e6),
    }


def true_bins(levels: Reals, bin_frames: int, threshold: float) -> tuple[npt.NDArray[np.int64], int]:
    """Return the signed bins [bins, pixels] and the number of events of [n, pixels] levels, one second a frame.

    The residuals start as those of ``simulate`` under SEED.
    """
    n, pixels = levels.shape
    start = (2.0 * start_uniforms(noise_key_of_seed(SEED), pixels).astype(np.float64) - 1.0) * threshold
    events = dense_events(levels, np.arange(n, dtype=np.float64), start, threshold, threshold)
    return bin_events(events, np.arange(0.0, n, bin_frames), pixels), len(events.seconds)


def v2v_steps(frames: Frames, threshold: float) -> npt.NDArray[Any]:
    """Return V2V's signed counts of every step: [steps, pixels]."""
    steps = len(frames) - 1
    return simulate(
        frames, threshold_pos=threshold, gamma=GAMMA, log_eps=LOG_EPS, bins=steps, seed=SEED, dtype="int16"
    ).voxels.reshape(steps, -1)


def moved_photographs() -> Records:
    """Return means over the moved photographs, against rendered frames in float64."""
    cells: dict[tuple[Any, ...], list[dict[str, float]]] = {}
    for name in PHOTOGRAPHS:
        for speed in SPEEDS_PX:
            light = moved_photograph(name, BIN_FRAMES * BINS + 1, 96, 128, speed)
            frames = np.rint(light * 255.0).astype(np.uint8)
            for threshold in THRESHOLDS:
                true, events = true_bins(log_levels(light).reshape(len(light), -1), BIN_FRAMES, threshold)
                for every in EVERY:
                    found = errors(v2v_steps(frames[::every], threshold), true, events, BINS)
                    cells.setdefault((threshold, speed, every), []).append(found)
    return [
        {"measure": "moved photographs", "threshold": threshold, "every": every,
         "frame_rate_hz": RENDERED_HZ / every, "motion_px_per_frame": speed * every}
        | {key: float(np.mean([each[key] for each in found])) for key in found[0]}
        for (threshold, speed, every), found in cells.items()
    ]  # fmt: skip


def low_passed() -> Iterator[dict[str, Any]]:
    """Yield the events of each number of bins a frame, as shares of those with most, by low-pass and motion."""
    for px in LOW_PASS_PX:
        frames = np.rint(255.0 * moved_photograph("coffee", 31, 64, 64, px)).astype(np.uint8)
        for hertz in LOW_PASS_HZ:
            made = {
                parts: simulate(
                    frames, threshold_pos=0.2, bins=parts, grids_per_frame=1, frames_per_second=30.0,
                    photoreceptor_hz=hertz, seed=SEED, dtype="int16",
                ).array("event_counts").sum(dtype=np.int64)
                for parts in PARTS
            }  # fmt: skip
            shares = {f"share_{parts}": float(made[parts] / made[PARTS[-1]]) for parts in PARTS}
            yield {"measure": "low-pass", "motion_px_per_frame": px, "photoreceptor_hz": hertz, **shares}


def filmed(path: Path) -> Iterator[dict[str, Any]]:
    """Yield one record for each threshold and n of a film of high rate, on the square that changes most.

    Raises:
        V2VError: the video cannot be read, or is too short or too small.
    """
    facts = probe(path)
    count = (facts.frames - 1) // VIDEO_BIN_FRAMES * VIDEO_BIN_FRAMES + 1
    if count <= VIDEO_BIN_FRAMES:
        raise UsageError(f"--video {path}: {facts.frames} frames; give more than {VIDEO_BIN_FRAMES}")
    frames = liveliest(decode_luma(path, facts.index, 0, count).frames, VIDEO_SIDE_PX)
    levels = log_levels(frames.reshape(count, -1) / 255.0)
    for threshold in THRESHOLDS:
        true, events = true_bins(levels, VIDEO_BIN_FRAMES, threshold)
        for every in VIDEO_EVERY:
            found = errors(v2v_steps(frames[::every], threshold), true, events, count // VIDEO_BIN_FRAMES)
            yield {
                "measure": "film", "video": path.name, "threshold": threshold, "every": every,
                "frame_rate_hz": facts.frames_per_second / every, **found,
            }  # fmt: skip


def started(path: Path) -> Iterator[dict[str, Any]]:
    """Yield one record for each threshold: the error of first grids by start, on the square that changes most."""
    facts = probe(path)
    frames = liveliest(decode_luma(path, facts.index, 0, min(facts.frames, MOST_STARTED)).frames, VIDEO_SIDE_PX)
    run_in = int(Recipe(start=FRAMES).run_in_at(facts.frames_per_second))
    ways = (0, "uniform"), (0, "triangular"), (run_in, "triangular"), (LONG_RUN_IN, "triangular")
    for threshold in THRESHOLDS[1:3]:
        wrong, events = np.zeros(len(ways)), 0.0
        for at in range(LONG_RUN_IN, len(frames) - FIRST_GRID, LONG_RUN_IN):
            true = first_grid(frames, at, *ways[-1], threshold, SEED + START_DRAWS)
            wrong += [np.abs(first_grid(frames, at, *way, threshold) - true).sum() for way in ways]
            events += np.abs(true).sum()
        errors_of = dict(zip(STARTED, (wrong / max(events, 1.0)).tolist(), strict=True))
        yield {"measure": "start", "video": path.name, "threshold": threshold, "run_in": run_in, **errors_of}


def first_grid(frames: Frames, at: int, run_in: int, start: str, threshold: float, seed: int = SEED) -> Reals:
    """Return V2V's signed counts from frame ``at`` on, after ``run_in`` frames before it, in the mean of the draws of
    the start: [FIRST_GRID, H, W].
    """
    seen = frames[at - run_in : at + FIRST_GRID + 1]
    made = np.zeros((FIRST_GRID, *frames.shape[1:]))
    for drawn in range(seed, seed + START_DRAWS):
        made += simulate(
            seen, threshold_pos=threshold, gamma=GAMMA, log_eps=LOG_EPS, bins=1, seed=drawn, dtype="int16", start=start
        ).voxels[run_in:, 0]
    return made / START_DRAWS


def liveliest(frames: Frames, side: int) -> Frames:
    """Return the square of that side whose grey levels change most."""
    if min(frames.shape[1:]) < side:
        raise UsageError(f"--video: {frames.shape[2]}x{frames.shape[1]} pixels; give at least {side}x{side}")
    change = np.abs(np.diff(frames[::8].astype(np.int16), axis=0)).sum(axis=0, dtype=np.float64)
    activity = cv2.boxFilter(change, -1, (side, side), anchor=(0, 0), normalize=False)
    places = activity[: frames.shape[1] - side + 1, : frames.shape[2] - side + 1]
    top, left = (int(place) for place in np.unravel_index(np.argmax(places), places.shape))
    return np.ascontiguousarray(frames[:, top : top + side, left : left + side])


def missed(records: Sequence[Record]) -> list[str]:
    """Return the bars that these records miss."""
    texts = []
    for r in records:
        if r.get("monotone"):
            none = {"count_error": 0.0, "voxel_error": 0.0}
            texts += beyond(f"{r['scene']} at {r['frame_rate_hz']} Hz", r, least=none, most=none)
        if r["measure"] == "film" and r["every"] == 1:
            texts += beyond(f"film at c = {r['threshold']:g}", r, most={"differing_bins_ppm": LARGEST_DIFFERENCE_PPM})
        if r["measure"] == "start" and not r[FRAMES] < r["triangular"] < r["uniform"]:
            texts.append(f"first grids of {r['video']} at c = {r['threshold']:g} are not in order")
    return texts


def pivot(records: Sequence[Record], down: dict[str, str], across: str, unit: str) -> tuple[Records, list[Column]]:
    """Return a table of "count error / voxel error" cells: a row for each value of ``down``, columns by ``across``."""
    rows: dict[tuple[Any, ...], dict[str, Any]] = {}
    for r in records:
        row = rows.setdefault(tuple(r[key] for key in down), {key: r[key] for key in down})
        # Without true events in any bin there is no relative voxel error.
        voxel_error = f"{r['voxel_error']:.1%}" if r["voxel_net_true"] else "-"
        row[f"{r[across]:g}"] = f"{r['count_error']:.1%} / {voxel_error}"
    columns: list[Column] = [(key, title, "{}", 1) for key, title in down.items()]
    ends = sorted({r[across] for r in records})
    return list(rows.values()), columns + [(f"{end:g}", f"{unit} {end:g}", "{}", 1) for end in ends]


def add_flags(parser: Parser) -> None:
    """Add the bench's flags."""
    parser.add_argument("--video", type=Path, metavar="FILE", help="a film of high frame rate")


def measure(asked: argparse.Namespace) -> Report:
    """Run the bench."""
    cv2.setNumThreads(1)
    scenes, photographs = list(analytic()), moved_photographs()
    film, starts = ([], []) if asked.video is None else (list(filmed(asked.video)), list(started(asked.video)))
    title = "photographs against light: px a frame"
    tables = [
        pivot(scenes, {"scene": "count / voxel error at c = 0.2", "events_true": "events"}, "frame_rate_hz", "Hz"),
        pivot(photographs, {"motion_px_per_frame": title, "frame_rate_hz": "Hz"}, "threshold", "c ="),
    ]
    low_pass = list(low_passed())
    columns: list[Column] = [("photoreceptor_hz", "low-pass, Hz", "{:g}", 1)]
    columns += [("motion_px_per_frame", "px a frame", "{:g}", 1)]
    columns += [(f"share_{parts}", f"bins {parts}", "{:.1%}", 1) for parts in PARTS]
    tables.append((low_pass, columns))
    if film:
        tables.append(pivot(film, {"every": "film, every n-th frame", "frame_rate_hz": "Hz"}, "threshold", "c ="))
        tables.append((starts, [("video", "first grids of", "{}", 1), ("threshold", "c", "{:g}", 1), *(
            (law, law, "{:.2f}", 1) for law in STARTED
        )]))  # fmt: skip
    records = [*scenes, *photographs, *low_pass, *film, *starts]
    return Report(records, tables, missed=missed(records))


def plot(records: Sequence[Record], file: Path) -> None:
    """Draw the voxel error against frame rate and motion."""
    scenes = [r for r in records if r["measure"] == "analytic" and not r["monotone"] and r["voxel_net_true"]]
    moved = [r for r in records if r["measure"] == "moved photographs" and r["every"] == EVERY[-1]]
    film = [r for r in records if r["measure"] == "film" and r["every"] > 1]
    groups = (
        ("formulas, c = 0.2", scenes, "scene", "frame_rate_hz", "frames a second"),
        ("photographs at 25 frames a second", moved, "threshold", "motion_px_per_frame", "motion, px a frame"),
        ("film", film, "threshold", "frame_rate_hz", "frames a second"),
    )
    with panels(file, 3, title="Voxel error of frames against an exact sensor") as axes:
        for axis, (title, chosen, line, along, label) in zip(axes, groups, strict=True):
            for name in dict.fromkeys(r[line] for r in chosen):
                points = [(r[along], r["voxel_error"]) for r in chosen if r[line] == name]
                axis.plot(
                    *zip(*sorted(points), strict=True), "o-", ms=3, label=name if line == "scene" else f"c = {name:g}"
                )
            axis.set(title=title, xlabel=label, ylabel="voxel error", xscale="log", yscale="log", ylim=(1e-4, 3))
            axis.grid(alpha=0.3)
            if chosen:
                axis.legend(fontsize=6)
