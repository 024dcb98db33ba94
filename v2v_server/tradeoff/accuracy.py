"""Errors of each form of the corpus against exactly decoded frames, by contrast threshold.

Both sides are the same camera: the sample's own draw and noise key, with both thresholds set to the value in question.
Hot pixels are left out: they fire alike on both sides and would make every relative error look small.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from v2v_protocol.messages import Lease
from v2v_protocol.recipe import Recipe
from v2v_protocol.sample import SampleParams
from v2v_server.corpus.catalogue import Catalogue
from v2v_server.corpus.sources.folder import Folder
from v2v_server.motion.prediction import Prediction, predict
from v2v_server.simulation.clip import simulate, simulate_clip
from v2v_server.simulation.intensity import eight_bits
from v2v_server.simulation.view import Frames, apply_view
from v2v_server.store.clips import clips_of
from v2v_server.tradeoff.errors import Tally, Voxels, compare
from v2v_server.video.collect import Cut
from v2v_server.video.luma import Signal
from v2v_server.worker.produce import decode_for, plan_sample, step_durations

THRESHOLDS = (0.05, 0.2, 0.5, 1.0, 2.0)

Tallies = dict[str, dict[float, Tally]]
"""By name, by contrast threshold."""


@dataclass(frozen=True, slots=True)
class CameraView:
    """What one camera sees.

    Attributes:
        frames: [n, H, W], after the view.
        params: the draw.
        recipe: of the draw.
        step_seconds: duration of each step; None if the recipe does not use it.
        other_params: another sample's draw, for scale.
        signal: what the levels of the frames mean.
    """

    frames: Frames
    params: SampleParams
    recipe: Recipe
    step_seconds: npt.NDArray[np.float64] | None
    other_params: SampleParams
    signal: Signal

    def voxels(self, params: SampleParams) -> Voxels:
        """Return voxels [T, B, H, W] float32 of a camera with these thresholds, noise and key."""
        return simulate_clip(self.frames, params, self.recipe, "float32", self.step_seconds, signal=self.signal).voxels


def seen(root: Path, lease: Lease) -> CameraView:
    """Return a lease's first sample before simulation, without hot pixels."""
    (decoded,) = decode_for(lease, lease.indices[:1], Folder(root))
    recipe = decoded.plan.spec.recipe
    params = dataclasses.replace(decoded.plan.params, hot_pixel_count=0)
    signal = decoded.clip.signal
    return CameraView(
        apply_view(decoded.clip.frames, params, recipe, signal),
        params,
        recipe,
        step_durations(lease, decoded),
        plan_sample(lease, lease.indices[1]).params,
        signal,
    )


def at_threshold(params: SampleParams, threshold: float) -> SampleParams:
    """Return the same camera with both thresholds at ``threshold``, rounded to float32."""
    exact = float(np.float32(threshold))
    return dataclasses.replace(params, threshold_pos=exact, threshold_neg=exact)


NOISE_ROW, DRAW_ROW = "another noise seed", "another threshold draw"


def accuracy(works: Mapping[str, tuple[Path, Sequence[Lease]]], reference: str, *, until: float) -> Tallies:
    """Return the tallies of every form, and of two rows that give the scale.

    Args:
        works: root and leases, by name; the same places in the same order.
        reference: name of the exact one.
        until: reading of ``time.monotonic`` after which no further place is compared; one is in any case.

    Returns:
        also under NOISE_ROW the reference's frames with the noise of another key, and under DRAW_ROW with the
        thresholds of another sample's draw.
    """
    names = [*works, NOISE_ROW, DRAW_ROW]
    tallies: Tallies = {name: dict.fromkeys(THRESHOLDS, Tally()) for name in names}
    for place in range(len(works[reference][1])):
        if place and time.monotonic() >= until:
            break
        views = {name: seen(root, leases[place]) for name, (root, leases) in works.items()}
        exact = views[reference]
        for threshold in THRESHOLDS:
            camera = at_threshold(exact.params, threshold)
            truth = exact.voxels(camera)
            other = exact.other_params
            scale = {
                NOISE_ROW: dataclasses.replace(camera, noise_key=other.noise_key),
                DRAW_ROW: dataclasses.replace(
                    camera, threshold_pos=other.threshold_pos, threshold_neg=other.threshold_neg
                ),
            }
            for name, view in views.items():
                tallies[name][threshold] += compare(truth if name == reference else view.voxels(camera), truth)
            for name, changed in scale.items():
                tallies[name][threshold] += compare(exact.voxels(changed), truth)
    return tallies


def predicted_loss(root: Path, leases: Sequence[Lease]) -> Prediction:
    """Predict what the first sample of each lease loses between its frames."""
    views = (seen(root, lease) for lease in leases)
    return sum((predict(eight_bits(view.frames, view.signal)) for view in views), Prediction())


def spurious(stills: Catalogue, crop_px: tuple[int, int]) -> dict[float, float]:
    """Return the events of noise-free cameras on still scenes, per pixel and frame, by contrast threshold.

    Args:
        stills: the scenes.
        crop_px: height and width of the simulated part in the middle.
    """
    events = dict.fromkeys(THRESHOLDS, 0.0)
    steps = 0
    height, width = crop_px
    for number, video in enumerate(stills.videos):
        top, bottom = stills.rows.bounds(video.height_px)
        window = (top + (bottom - top - height) // 2, (video.width_px - width) // 2, height, width)
        cuts = [Cut(video.frames, window)]
        (clip,) = clips_of(stills.path(video.id), video.fingerprint, stills.frame_index(video.id), 0, cuts, 1)
        steps += (len(clip.frames) - 1) * height * width
        for threshold in THRESHOLDS:
            made = simulate(clip.frames, threshold_pos=threshold, bins=1, seed=number, dtype="float32").voxels
            events[threshold] += float(np.abs(made).sum())
    return {threshold: count / steps for threshold, count in events.items()}
