"""Optical flow: time and error of every method on pictures of known motion, and what flow adds to the cost of a sample.

    python -m bench.accuracy.flow --videos DIR --raft-small raft-small.pth --corpus CLIPS --json flow.json --plot
    flow.png

Errors are endpoint errors, the length of (estimate - truth), over all pixels, hidden ones included. ``--videos`` adds
frames of real videos to the photographs of scikit-image as textures (bench/accuracy/known_motion.py). ``128x128``
is a crop of the same pictures, estimated on the whole picture, on the crop with a margin, or on the crop alone.
``--corpus`` is a folder of clips of at least 201 frames; there the methods run on samples of the paper's recipe, pauses
and all. Times are CPU time of one thread.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from bench.accuracy.known_motion import PHOTOGRAPHS, Grey, Scene, photograph, scenes
from v2v_protocol.errors import UsageError, V2VError
from v2v_protocol.recipe import preset
from v2v_protocol.records import write_json
from v2v_protocol.sample import SampleParams
from v2v_protocol.spec import StreamSpec
from v2v_server.catalogue.catalogue import Catalogue, open_catalogue
from v2v_server.flow import FlowSettings, flow_for, flow_window, view_part
from v2v_server.flow.methods import AUTO, METHODS, Estimator, Field, choose, estimator
from v2v_server.schedule.epoch import Schedule
from v2v_server.schedule.sequences import SequenceTable
from v2v_server.simulation.clip import simulate_clip
from v2v_server.simulation.draw import draw
from v2v_server.simulation.variants import warm_up
from v2v_server.simulation.view import Window, apply_view, source_window
from v2v_server.video.decode import decode_luma
from v2v_server.video.probe import probe
from v2v_server.video.rows import Rows

HEIGHT_PX, WIDTH_PX, CROP_PX = 180, 596, 128
MARGINS_PX: dict[str, int | None] = {"whole": None, "margin 64": 64, "margin 32": 32, "crop": 0}
LARGEST_MEDIAN_PX = 0.25
"""Bar: median endpoint error of the default method on pans and zooms at 180x596."""
LARGEST_COST_RATIO = 1.5
"""Bar: CPU of an unprepared sample with flow of 20 steps, as a multiple of that without."""
_TALLEST_PX = 480
_RAFT = "raft-small"


def textures(videos: Path | None) -> dict[str, Grey]:
    """The photographs, and the middle frame of each video of a folder.

    Raises:
        UsageError: the folder is missing.
    """
    found = {name: photograph(name) for name in PHOTOGRAPHS}
    if videos is None:
        return found
    if not videos.is_dir():
        raise UsageError(f"--videos {videos}: no such folder")
    for path in sorted(videos.iterdir()):
        try:
            facts = probe(path)
            frame = decode_luma(path, facts.index, facts.frames // 2, 1).frames[0]
        except V2VError as error:
            print(f"left out: {error}", file=sys.stderr)
            continue
        scale = min(1.0, _TALLEST_PX / frame.shape[0])
        # Downscaling takes away the coder's blocks.
        found[path.name] = cv2.resize(frame, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA).astype(np.uint8)
    return found


def estimators(names: Sequence[str], raft_small: Path | None) -> dict[str, Estimator]:
    """The methods to compare, by name."""
    made = {name: _auto() if name == AUTO else estimator(name) for name in names}
    if raft_small is not None:
        made[_RAFT] = _raft(raft_small)
    return made


def _auto() -> Estimator:
    ready = {name: estimator(name) for name in METHODS}
    return lambda first, second: ready[choose(first, second)](first, second)


def _raft(weights: Path) -> Estimator:
    import torch

    from trainer.models.raft_flow import RaftFlow

    torch.set_num_threads(1)
    network = RaftFlow("small", weights)

    def estimate(first: Grey, second: Grey) -> Field:
        one, other = (torch.from_numpy(np.ascontiguousarray(picture))[None, None] for picture in (first, second))
        field: Field = network(one, other)[0].permute(1, 2, 0).numpy()
        return field

    return estimate


def accuracy(name: str, estimate: Estimator, pairs: Sequence[Scene]) -> list[dict[str, Any]]:
    """One record for 180x596, and one for the crop in every surrounding."""
    whole = _Errors()
    crops = {context: _Errors() for context in MARGINS_PX}
    for number, scene in enumerate(pairs):
        top, left = np.random.default_rng(number).integers(0, (HEIGHT_PX - CROP_PX + 1, WIDTH_PX - CROP_PX + 1))
        crop = np.s_[top : top + CROP_PX, left : left + CROP_PX]
        field, seconds = _timed(estimate, scene.earlier, scene.later)
        whole.add(field, scene, np.s_[:, :], seconds)
        crops["whole"].add(field[crop], scene, crop, seconds)
        for context, margin in MARGINS_PX.items():
            if margin is not None:
                above, before = max(0, top - margin), max(0, left - margin)
                part = np.s_[above : top + CROP_PX + margin, before : left + CROP_PX + margin]
                field, seconds = _timed(estimate, scene.earlier[part], scene.later[part])
                field = field[top - above :, left - before :][:CROP_PX, :CROP_PX]
                crops[context].add(field, scene, crop, seconds)
    records = [whole.record(name, f"{HEIGHT_PX}x{WIDTH_PX}", "whole")]
    return records + [errors.record(name, f"{CROP_PX}x{CROP_PX}", context) for context, errors in crops.items()]


def _timed(estimate: Estimator, first: Grey, second: Grey) -> tuple[Field, float]:
    first, second = np.ascontiguousarray(first), np.ascontiguousarray(second)
    started = time.process_time()
    field = estimate(first, second)
    return field, time.process_time() - started


class _Errors:
    """Endpoint errors of many pairs."""

    def __init__(self) -> None:
        self._all: list[npt.NDArray[np.float32]] = []
        self._boundary: list[npt.NDArray[np.float32]] = [np.empty(0, np.float32)]
        self._smooth: list[npt.NDArray[np.float32]] = [np.empty(0, np.float32)]
        self._seconds: list[float] = []

    def add(self, field: Field, scene: Scene, part: Any, seconds: float) -> None:
        error = np.linalg.norm(field - scene.forward[part], axis=-1)
        self._all.append(error.ravel())
        self._boundary.append(error[scene.boundary[part]])
        if scene.kind in ("pan", "zoom"):
            self._smooth.append(error.ravel())
        self._seconds.append(seconds)

    def record(self, method: str, picture: str, context: str) -> dict[str, Any]:
        error = np.concatenate(self._all)
        boundary = np.concatenate(self._boundary)
        smooth = np.concatenate(self._smooth)
        return {
            "measure": "accuracy",
            "method": method,
            "picture": picture,
            "context": context,
            "pairs": len(self._seconds),
            "cpu_seconds_per_pair": float(np.median(self._seconds)),
            "error_mean_px": float(error.mean()),
            "error_median_px": float(np.median(error)),
            "share_above_1px": float((error > 1).mean()),
            "share_above_3px": float((error > 3).mean()),
            "boundary_error_mean_px": float(boundary.mean()) if boundary.size else None,
            "pan_zoom_error_median_px": float(np.median(smooth)) if smooth.size else None,
        }


def largest_flow_of_a_still_clip() -> float:
    """px; the bar is exactly zero."""
    recipe = preset("noise-free").replace(voxels_per_clip=4, crop_height_px=64, crop_width_px=64)
    frames = np.repeat(photograph("camera")[None, :180, :300], recipe.frames_needed, axis=0)
    params = draw(recipe, seed=0, epoch=0, index=0, picture_height_px=180, picture_width_px=300, video_id="still")
    window = flow_window(params, recipe, FlowSettings().margin_px, 0, 180, 300)
    return float(np.abs(flow_for(_cut(frames, window), params, recipe, FlowSettings()).flow).max())


def _cut(frames: Grey, window: Window) -> Grey:
    top, left, height, width = window
    return frames[:, top : top + height, left : left + width]


def cost(corpus: Path, rows: str, methods: Sequence[str], samples: int) -> list[dict[str, Any]]:
    """CPU seconds of each part of a sample of the paper's recipe, medians; the parts are timed in turn on each sample.

    Raises:
        UsageError: no clip of the folder gives a sample.
    """
    warm_up()
    catalogue = open_catalogue(corpus, rows=Rows.parse(rows), processes=0)
    taken: dict[str, list[float]] = {}
    try:
        for path, catalogue_index, start, params, bounds, width in _jobs(catalogue, samples):
            for part, work in _parts(path, catalogue_index, start, params, bounds, width, methods):
                started = time.process_time()
                work()
                taken.setdefault(part, []).append(time.process_time() - started)
    finally:
        catalogue.close()
    return [
        {"measure": "cost", "part": part, "samples": samples, "cpu_seconds_per_sample": float(np.mean(seconds))}
        for part, seconds in taken.items()
    ]


def _jobs(catalogue: Catalogue, samples: int) -> Iterator[tuple[Path, Any, int, SampleParams, tuple[int, int], int]]:
    spec = StreamSpec(recipe=preset("paper"))
    schedule = Schedule.of(SequenceTable(catalogue.videos, catalogue.rows, spec), spec)
    if not schedule.count:
        raise UsageError(f"--corpus {catalogue.folder}: no clip of {spec.recipe.frames_needed} frames or more")
    for number in range(samples):
        epoch, index = divmod(number, schedule.count)
        sequence = schedule.candidate(0, epoch, index, 0)
        video = sequence.video
        top, bottom = catalogue.rows.bounds(video.height_px)
        params = draw(
            spec.recipe, seed=0, epoch=epoch, index=index, picture_height_px=bottom - top,
            picture_width_px=video.width_px, video_id=video.id,
        )  # fmt: skip
        frames = catalogue.frame_index(video.id)
        yield catalogue.path(video.id), frames, sequence.start_frame, params, (top, bottom), video.width_px


def _parts(
    path: Path,
    frames: Any,
    start: int,
    params: SampleParams,
    bounds: tuple[int, int],
    width: int,
    methods: Sequence[str],
) -> Iterator[tuple[str, Callable[[], object]]]:
    recipe = preset("paper")
    settings = FlowSettings()
    top, height = bounds[0], bounds[1] - bounds[0]
    count = int(params.source_index(recipe.steps)[-1]) + 1
    window = flow_window(params, recipe, settings.margin_px, top, height, width)

    def decoded(part: Window) -> Grey:
        return decode_luma(path, frames, start, count, part).frames

    decoded(window)  # the file is in memory now, for all parts alike
    yield "decode the crop", lambda: decoded(source_window(params, recipe, top, height, width))
    yield "decode the crop and its margin", lambda: decoded(window)
    clip = decoded(window)
    part = view_part(clip, params, recipe, settings.margin_px)
    yield "view and simulation", lambda: simulate_clip(apply_view(part, params, recipe), params, recipe, "int8", None)
    for pairs in (20, 40):
        for name in methods:
            chosen = replace(settings, method=name, first_voxel=recipe.voxels_per_clip - pairs)
            yield f"flow {pairs} {name}", partial(flow_for, clip, params, recipe, chosen)


def cost_ratio(records: Sequence[dict[str, Any]], pairs: int, method: str) -> float:
    """CPU of a sample with flow as a multiple of that without."""
    seconds = {item["part"]: item["cpu_seconds_per_sample"] for item in records if item["measure"] == "cost"}
    simulation = seconds["view and simulation"]
    return float(
        (seconds["decode the crop and its margin"] + simulation + seconds[f"flow {pairs} {method}"])
        / (seconds["decode the crop"] + simulation)
    )


def report(records: Sequence[dict[str, Any]]) -> str:
    """The records as tables."""
    columns = [
        ("ms/pair", "cpu_seconds_per_pair", 1e3, ".2f"),
        ("mean px", "error_mean_px", 1, ".3f"),
        ("median", "error_median_px", 1, ".3f"),
        ("> 1 px %", "share_above_1px", 1e2, ".1f"),
        ("> 3 px %", "share_above_3px", 1e2, ".1f"),
        ("boundary", "boundary_error_mean_px", 1, ".2f"),
        ("pan+zoom", "pan_zoom_error_median_px", 1, ".3f"),
    ]
    lines = [f"{'method':17s}{'picture':9s}{'estimated on':13s}" + "".join(f"{title:>9s}" for title, *_ in columns)]
    for item in records:
        if item["measure"] == "accuracy":
            values = [(item[key], factor, form) for _, key, factor, form in columns]
            numbers = ["-" if value is None else format(value * factor, form) for value, factor, form in values]
            lines.append(
                f"{item['method']:17s}{item['picture']:9s}{item['context']:13s}"
                + "".join(f"{number:>9s}" for number in numbers)
            )
    for item in records:
        if item["measure"] == "cost":
            lines.append(f"{item['part']:40s}{item['cpu_seconds_per_sample'] * 1e3:8.1f} ms a sample")
    return "\n".join(lines)


def plot(records: Sequence[dict[str, Any]], path: Path) -> None:
    """Error over time, one point a method, for the two sizes."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, 2, figsize=(11, 4.5), sharey=True)
    shown = ((f"{HEIGHT_PX}x{WIDTH_PX}", ("whole",)), (f"{CROP_PX}x{CROP_PX}", ("margin 64", "crop")))
    for axis, (picture, contexts) in zip(axes, shown, strict=True):
        for context, marker in zip(contexts, "os", strict=False):
            chosen = [r for r in records if r.get("picture") == picture and r["context"] == context]
            chosen = [r for r in chosen if r["method"] != "zero"]
            axis.scatter(
                [r["cpu_seconds_per_pair"] * 1e3 for r in chosen], [r["error_mean_px"] for r in chosen],
                marker=marker, label=context,
            )  # fmt: skip
            for r in chosen:
                axis.annotate(r["method"], (r["cpu_seconds_per_pair"] * 1e3, r["error_mean_px"]), fontsize=7)
        axis.set(xscale="log", yscale="log", title=picture, xlabel="CPU ms a pair")
        axis.legend(title="estimated on")
    axes[0].set_ylabel("mean endpoint error, px")
    figure.suptitle("Optical flow: error against cost")
    figure.tight_layout()
    figure.savefig(path, dpi=120)
    pyplot.close(figure)


def missed_bars(records: Sequence[dict[str, Any]], still_px: float) -> list[str]:
    """What the default method does not hold."""
    missed = []
    default = FlowSettings().method
    for item in records:
        if item.get("method") != default or item["picture"] != f"{HEIGHT_PX}x{WIDTH_PX}":
            continue
        error = item["pan_zoom_error_median_px"]
        if error is not None and error >= LARGEST_MEDIAN_PX:
            missed.append(f"median error of {default} on pans and zooms {error:.3f} px >= {LARGEST_MEDIAN_PX} px")
    if still_px != 0.0:
        missed.append(f"a still clip has flow of {still_px} px")
    if any(item["measure"] == "cost" for item in records):
        ratio = cost_ratio(records, 20, default)
        if ratio > LARGEST_COST_RATIO:
            missed.append(f"a sample with 20 steps of flow costs {ratio:.2f} times that without > {LARGEST_COST_RATIO}")
    return missed


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line. Returns 0, 1 (a bar missed) or 2 (wrong usage or input)."""
    parser = argparse.ArgumentParser(prog="python -m bench.accuracy.flow", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--videos", type=Path, metavar="DIR", help="videos that lend a frame each as texture")
    parser.add_argument("--methods", default=",".join([*METHODS, AUTO]), metavar="NAME,NAME", help="default: all")
    parser.add_argument("--raft-small", type=Path, metavar="FILE", help="weights of RAFT-small, to compare with")
    parser.add_argument("--every", type=int, default=1, metavar="N", help="only every N-th pair")
    parser.add_argument("--corpus", type=Path, metavar="DIR", help="clips to state the cost of a sample on")
    parser.add_argument("--rows", default="top:0.54", help="of the corpus (default top:0.54)")
    parser.add_argument("--samples", type=int, default=12, help="samples of the corpus (default 12)")
    parser.add_argument("--json", type=Path, metavar="FILE")
    parser.add_argument("--plot", type=Path, metavar="FILE.png")
    asked = parser.parse_args(arguments)
    names = asked.methods.split(",")
    cv2.setNumThreads(1)
    try:
        for name in names:
            StreamSpec.from_dict({"flow_method": name})
        if asked.every < 1 or asked.samples < 1:
            raise UsageError("--every and --samples: give at least 1")
        pairs = scenes(textures(asked.videos), HEIGHT_PX, WIDTH_PX, every=asked.every)
        records: list[dict[str, Any]] = []
        for name, estimate in estimators(names, asked.raft_small).items():
            print(f"{name} on {len(pairs)} pairs", file=sys.stderr, flush=True)
            records += accuracy(name, estimate, pairs)
        if asked.corpus is not None:
            default = FlowSettings().method
            listed = [default, *(name for name in names if name != default)]
            records += cost(asked.corpus, asked.rows, listed, asked.samples)
    except (V2VError, OSError) as error:
        print(f"bench.accuracy.flow: {error}", file=sys.stderr)
        return 2
    still_px = largest_flow_of_a_still_clip()
    print(report(records))
    if asked.corpus is not None:
        for number in (20, 40):
            ratio = cost_ratio(records, number, default)
            print(f"a sample with {number} steps of flow costs {ratio:.2f} times that without")
    if asked.json is not None:
        write_json(asked.json, records)
    if asked.plot is not None:
        plot(records, asked.plot)
    missed = missed_bars(records, still_px)
    for line in missed:
        print(f"bar missed: {line}", file=sys.stderr)
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
