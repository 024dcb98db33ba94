"""Measure error and time of the optical flow methods on pictures of known motion.

    python -m bench flow --videos DIR --json flow.json
    python -m bench flow --worlds 60 --json flow.json

Textures are the photographs of scikit-image and, with ``--videos``, one frame of each video
(`tests/oracles/known_motion.py`). Errors are endpoint errors over all pixels, hidden ones included. A 128x128 crop is
estimated on the whole picture, on the crop with a margin, and on the crop alone. Times are CPU times of one thread.

``--worlds`` measures the methods on that many drawn worlds instead (``v2v_server/worlds``): the pictures at both ends
of a grid of the recipe `worlds`, estimated with the stream's margin of 64 px, beside the exact flow, by its length, and
where something is hidden within 8 px.

Bar: the default method's median error on pans and zooms of whole pictures is below 0.25 px.
"""

from __future__ import annotations

import argparse
import itertools
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from bench.frame import Column, Record, Report, add_whole, progress
from tests.oracles.decoded import decode_luma
from tests.oracles.known_motion import PHOTOGRAPHS, Grey, Scene, photograph, scenes
from v2v_protocol.command import Parser
from v2v_protocol.errors import V2VError
from v2v_protocol.recipe import preset
from v2v_server.flow import AUTO, METHODS, Estimator, choose, estimator
from v2v_server.simulation.draw import draw
from v2v_server.video.probe import probe
from v2v_server.worlds.render import flow_of, pyramid_of, render
from v2v_server.worlds.world import draw_world

HEIGHT_PX, WIDTH_PX, CROP_PX = 180, 596, 128
MARGINS_PX = (64, 32, 0)
WHOLE, CROP = f"{HEIGHT_PX}x{WIDTH_PX}", f"{CROP_PX}x{CROP_PX}"
LARGEST_MEDIAN_PX = 0.25
_TALLEST_PX = 480
_COLUMNS: tuple[Column, ...] = (
    ("method", "method", "{}", 1),
    ("picture", "picture", "{}", 1),
    ("context", "estimated on", "{}", 1),
    ("cpu_seconds_per_pair", "ms/pair", "{:.2f}", 1e3),
    ("error_mean_px", "mean px", "{:.3f}", 1),
    ("error_median_px", "median", "{:.3f}", 1),
    ("share_above_1px", "> 1 px", "{:.1%}", 1),
    ("share_above_3px", "> 3 px", "{:.1%}", 1),
    ("boundary_error_mean_px", "boundary", "{:.2f}", 1),
    ("pan_zoom_error_median_px", "pan+zoom", "{:.3f}", 1),
)

LENGTHS_PX = (0.0, 0.5, 2.0, 8.0, 32.0, np.inf)
HIDDEN_PX = 8
FRAMES_PER_SECOND = 60.0
WORLD_COLUMNS: tuple[Column, ...] = (
    ("method", "method", "{}", 1),
    ("where", "exact flow", "{}", 1),
    ("share", "pixels", "{:.1%}", 1),
    ("error_mean_px", "mean px", "{:.2f}", 1),
    ("error_median_px", "median", "{:.2f}", 1),
    ("share_above_1px", "> 1 px", "{:.1%}", 1),
    ("share_above_3px", "> 3 px", "{:.1%}", 1),
)


def textures(videos: Path | None) -> dict[str, Grey]:
    """Return the photographs, and the middle frame of each video of a folder; leave out what does not decode."""
    found = {name: photograph(name) for name in PHOTOGRAPHS}
    for path in () if videos is None else sorted(videos.iterdir()):
        try:
            facts = probe(path)
            frame = decode_luma(path, facts.index, facts.frames // 2, 1).frames[0]
        except V2VError as error:
            progress(f"left out: {error}")
            continue
        scale = min(1.0, _TALLEST_PX / frame.shape[0])
        # Downscaling removes the blocks of the video codec.
        found[path.name] = cv2.resize(frame, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA).astype(np.uint8)
    return found


def estimator_of(name: str) -> Estimator:
    """Return the estimator of a method, ``auto`` included."""
    if name != AUTO:
        return estimator(name)
    ready = {method: estimator(method) for method in METHODS}
    return lambda first, second: ready[choose(first, second)](first, second)


def accuracy(name: str, pairs: Sequence[Scene]) -> list[dict[str, Any]]:
    """Return one record for whole pictures, and one for the crop in each context."""
    estimate = estimator_of(name)
    errors: dict[tuple[str, str], list[tuple[npt.NDArray[np.float32], Scene, Any]]] = {}
    seconds: dict[tuple[str, str], list[float]] = {}

    def add(scene: Scene, part: Any, shown: dict[tuple[str, str], Any]) -> None:
        """Estimate on one part of the pictures; add the errors of a part of that for each picture and context."""
        first, second = np.ascontiguousarray(scene.earlier[part]), np.ascontiguousarray(scene.later[part])
        started = time.process_time()
        field = estimate(first, second)
        spent = time.process_time() - started
        error = np.full(scene.earlier.shape, np.nan, np.float32)
        error[part] = np.linalg.norm(field - scene.forward[part], axis=-1)
        for key, place in shown.items():
            errors.setdefault(key, []).append((error[place], scene, place))
            seconds.setdefault(key, []).append(spent)

    for number, scene in enumerate(pairs):
        top, left = np.random.default_rng(number).integers(0, (HEIGHT_PX - CROP_PX + 1, WIDTH_PX - CROP_PX + 1))
        crop, everything = np.s_[top : top + CROP_PX, left : left + CROP_PX], np.s_[:, :]
        add(scene, everything, {(WHOLE, "whole"): everything, (CROP, "whole"): crop})
        for margin in MARGINS_PX:
            rows = slice(max(0, top - margin), top + CROP_PX + margin)
            columns = slice(max(0, left - margin), left + CROP_PX + margin)
            add(scene, (rows, columns), {(CROP, f"margin {margin}"): crop})
    return [
        {"method": name, "picture": picture, "context": context}
        | {"pairs": len(pairs), "cpu_seconds_per_pair": float(np.median(seconds[picture, context]))}
        | _error_fields(errors[picture, context])
        for picture, context in errors
    ]


def _error_fields(found: Sequence[tuple[npt.NDArray[np.float32], Scene, Any]]) -> dict[str, float | None]:
    error = np.concatenate([each.ravel() for each, _, _ in found])
    boundary = np.concatenate([each[scene.boundary[shown]] for each, scene, shown in found])
    smooth = [each.ravel() for each, scene, _ in found if scene.kind in ("pan", "zoom")]
    return {
        **_figures(error),
        "boundary_error_mean_px": float(boundary.mean()) if boundary.size else None,
        "pan_zoom_error_median_px": float(np.median(np.concatenate(smooth))) if smooth else None,
    }


def beside_worlds(names: Sequence[str], count: int) -> list[dict[str, Any]]:
    """Return one record for each method and length of the exact flow, and for places beside what is hidden."""
    side, inner = CROP_PX + 2 * MARGINS_PX[0], slice(MARGINS_PX[0], MARGINS_PX[0] + CROP_PX)
    recipe = preset("worlds").replace(crop_height_px=side, crop_width_px=side, flip_probability=0.0)
    estimators, photographs = {name: estimator_of(name) for name in names}, [photograph(name) for name in PHOTOGRAPHS]
    moments = np.arange(2) * recipe.bins * recipe.frames_per_bin / FRAMES_PER_SECOND
    lengths, beside, errors = [], [], dict[str, list[Any]]({name: [] for name in names})
    for number in range(count):
        grey = photographs[number % len(photographs)]
        params = draw(recipe, seed=1, epoch=0, index=number, picture_height_px=grey.shape[0],
                      picture_width_px=grey.shape[1], video_id="")  # fmt: skip
        world = draw_world(recipe, params, seed=1, epoch=0, index=number, picture_px=grey.shape, seconds=(-1.0, 1.0))
        first, second = (render(pyramid_of(grey), world, moments) * (255.0 / 4095.0)).round().astype(np.uint8)
        exact, valid = flow_of(world, *moments.tolist())
        hidden = cv2.dilate(1 - valid[0], np.ones((2 * HIDDEN_PX + 1,) * 2, np.uint8))
        lengths.append(np.hypot(*exact)[inner, inner])
        beside.append(hidden[inner, inner] > 0)
        for name, estimate in estimators.items():
            error = np.linalg.norm(estimate(first, second) - exact.transpose(1, 2, 0), axis=-1)
            errors[name].append(error[inner, inner])
    near = np.stack(beside)
    stacked = {name: np.stack(found) for name, found in errors.items()}
    return by_length(stacked, np.stack(lengths), ~near, {"beside what is hidden": near})


def by_length(
    errors: Mapping[str, npt.NDArray[Any]],
    length: npt.NDArray[Any],
    counted: npt.NDArray[np.bool_],
    more: Mapping[str, npt.NDArray[np.bool_]],
) -> list[dict[str, Any]]:
    """Return one record for each method and length of the exact flow, of the pixels that count, and for more places.

    Args:
        errors: endpoint errors of each method, px.
        length, counted: of the exact flow, px, and which pixels count; of the shape of an error, as are ``more``.
    """
    places = {f"{low:g} to {high:g} px": counted & (low <= length) & (length < high)
              for low, high in itertools.pairwise(LENGTHS_PX)}  # fmt: skip
    return [
        {"method": name, "where": where, "share": float(chosen.mean()), **_figures(error[chosen])}
        for name, error in errors.items()
        for where, chosen in {**places, **more}.items()
        if chosen.any()
    ]


def _figures(error: npt.NDArray[np.floating[Any]]) -> dict[str, float]:
    return {
        "error_mean_px": float(error.mean()),
        "error_median_px": float(np.median(error)),
        "share_above_1px": float((error > 1).mean()),
        "share_above_3px": float((error > 3).mean()),
    }


def missed(records: Sequence[Record]) -> list[str]:
    """Return the bar that the default method misses."""
    return [
        f"median error of {AUTO} on pans and zooms {error:.3f} px; the bar is below {LARGEST_MEDIAN_PX} px"
        for record in records
        if (record["method"], record["picture"]) == (AUTO, WHOLE)
        and (error := record["pan_zoom_error_median_px"] or 0.0) >= LARGEST_MEDIAN_PX
    ]


def add_flags(parser: Parser) -> None:
    """Add the bench's flags."""
    parser.add_argument("--videos", type=Path, metavar="DIR", help="videos that give one frame each as texture")
    add_whole(parser, "--every", 1, "take every N-th pair")
    parser.add_argument("--worlds", type=int, default=0, metavar="N", help="measure on N worlds, and on nothing else")


def measure(asked: argparse.Namespace) -> Report:
    """Run the bench.

    Raises:
        UsageError: an unknown method.
        OSError: the folder cannot be read.
    """
    cv2.setNumThreads(1)
    if asked.worlds:
        found = beside_worlds((*METHODS, AUTO), asked.worlds)
        return Report(found, [(found, WORLD_COLUMNS)])
    pairs = scenes(textures(asked.videos), HEIGHT_PX, WIDTH_PX, every=asked.every)
    records: list[dict[str, Any]] = []
    for name in (*METHODS, AUTO):
        progress(f"{name} on {len(pairs)} pairs")
        records += accuracy(name, pairs)
    return Report(records, [(records, _COLUMNS)], missed=missed(records))
