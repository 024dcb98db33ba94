"""Where something moves in a video: its whole picture simulated without noise, and the cameras that look there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from v2v_pictures.camera import Camera
from v2v_protocol.errors import VideoError
from v2v_protocol.recipe import FRAMES, Recipe, effect_settings
from v2v_protocol.sample import SampleParams
from v2v_protocol.spec import StreamSpec
from v2v_server.corpus.catalogue import Catalogue
from v2v_server.corpus.scenes.picture_check import CHANGES, Defect, hides_motion
from v2v_server.motion.measure import MeasuredMotion, measure
from v2v_server.simulation.effects import NOISE
from v2v_server.simulation.intensity import eight_bits
from v2v_server.simulation.view import apply_view, without_margin
from v2v_server.store.pixels import signal_of
from v2v_server.system.compile_cache import cv2
from v2v_server.video.decode import ClipRequest, Cut, DecodedClip
from v2v_server.video.picture import SDR
from v2v_server.video.rows import Rows
from v2v_server.worker.job import ClipJob, SampleJob
from v2v_server.worker.making.make import make_sample
from v2v_server.worker.making.plan import plan_sample
from v2v_server.worker.making.read import Decoded
from v2v_tools.remake import RemadeSample, Remaker

LONGEST_SIDE_PX = 384
"""The whole picture is simulated at this size: a clip of 201 frames of 1920 x 1080 would take 400 MiB."""
THRESHOLD = 0.2
CANDIDATES = 64
"""Seeds that are looked at, at least."""
_MOST_CLIPS = 4
"""Clips that are decoded for it."""
_ENOUGH = 0.25
"""A camera is worth showing that has this share of the events of the best one."""
MOST_LOST = 0.2
"""Share of the changed pixels that no block follows, above which sub-steps do not help."""
JUDGE = "v2v-tradeoff --videos DIR --rows full --vary substep_px=0,1"
_NOISE = ("noise_sigma", "hot_pixel_share", *NOISE)


def noise_free(recipe: Recipe) -> Recipe:
    """Return the recipe without what fires where nothing moves."""
    return recipe.replace(**dict.fromkeys(_NOISE, (0.0, 0.0)))


def quiet_voxels(made: RemadeSample, start: str = "") -> npt.NDArray[Any]:
    """Simulate a sample's frames again, with the same draw but without noise.

    Args:
        start: how residuals start; "" as the recipe says.

    Returns:
        [lead voxels + T, bins, H, W], signed event counts.
    """
    plan, clip = made.decoded.plan, made.job.clip
    recipe = noise_free(clip.spec.recipe.replace(start=start or clip.spec.recipe.start))
    spec = StreamSpec.from_dict({**clip.spec.to_dict(), "recipe": recipe})
    job = replace(made.job, clip=replace(clip, spec=spec, arrays=("voxels",)))
    params = replace(
        plan.params,
        noise_sigma=0.0,
        hot_pixel_count=0,
        effects={name: value for name, value in plan.params.effects.items() if name not in _NOISE},
    )
    quiet = replace(made.decoded, plan=replace(plan, params=params, flow=None))
    return make_sample(job, quiet).arrays["voxels"]


def start_events(made: RemadeSample) -> npt.NDArray[np.float64]:
    """Count the events of a sample without noise: [2], with its start, and if each pixel had just fired then."""
    return np.array([np.abs(quiet_voxels(made, start), dtype=np.float64).sum() for start in ("", "zero")])


def describe_start(events: npt.NDArray[np.float64]) -> str:
    """Return one line for the user about the events that starts make, from the sum of :func:`start_events`, [2]."""
    share = max(0.0, events[0] - events[1]) / max(events[0], 1.0)
    return f"the start of a clip makes {share:.0%} of its events without noise"


def measured_motion(made: RemadeSample) -> MeasuredMotion:
    """Measure what moves in the frames of a sample; nothing where they are rendered."""
    if made.decoded.clip.is_view:
        return MeasuredMotion()
    plan, recipe = made.decoded.plan, made.job.clip.spec.recipe
    frames = eight_bits(made.decoded.clip.frames, made.decoded.clip.signal)
    return measure(apply_view(without_margin(frames, plan.params, recipe, plan.margin_px), plan.params, recipe))


def describe_motion(found: MeasuredMotion, defects: Sequence[Defect] = ()) -> tuple[str, str]:
    """Return one line for the user about what moves between frames, and what to do; "" where nothing is to be done.

    Args:
        defects: of the videos. Where they are what changes, motion is not.
    """
    turned = found.turned / max(found.paired, 1)
    lost, uncovered = (each / max(found.changed, 1) for each in (found.lost, found.uncovered))
    if hides_motion(defects, lost <= MOST_LOST):
        causes = dict.fromkeys(f"{each.text}: {CHANGES[each.kind]}" for each in defects if each.kind in CHANGES)
        return f"changes that motion does not explain: {'; '.join(causes)}", ""
    median, fast = (found.px_per_frame(share) for share in (0.5, 0.9))
    text = (
        f"{median:g} px a frame where something moves ({fast:g} px and more in the fastest tenth), {turned:.0%} of it "
        f"turns back from frame to frame; of the pixels that change, {uncovered:.0%} are uncovered background, and no "
        f"block follows {lost:.0%}"
    )
    if lost > MOST_LOST:
        return text, "something small or fast moves, or flickers, or is noise: sub-steps do not help"
    return text, f"{JUDGE} tells the error without and with sub-steps" if fast > 1.0 else ""


@dataclass(frozen=True, slots=True)
class CropEstimate:
    """What the camera of a seed is estimated to see.

    Attributes:
        clip: video and first frame.
        box: left, top, width and height of its crop, px of the whole picture.
        motion, noise: events a pixel and frame that each makes.
    """

    clip: tuple[str, int]
    box: tuple[float, float, float, float]
    motion: float
    noise: float

    @property
    def moves(self) -> bool:
        """Return whether motion makes more events than noise."""
        return self.motion > self.noise

    def overlaps(self, other: CropEstimate) -> bool:
        """Return whether a camera of the same clip sees the same place."""
        (left, top, width, height), (x, y, *_) = self.box, other.box
        return self.clip == other.clip and abs(left - x) < width and abs(top - y) < height


def step_seconds(clip: ClipJob) -> float:
    """Return the time between two frames that the pixels see; 0 where it is not known."""
    return clip.spec.recipe.frame_stride / clip.frames_per_second if clip.frames_per_second else 0.0


class WholePictures:
    """Simulates whole pictures, each once: one threshold, no noise, no pauses.

    Args:
        catalogue: the corpus of the clips.
    """

    def __init__(self, catalogue: Catalogue) -> None:
        self._catalogue = catalogue
        self._made: dict[tuple[str, int], Camera] = {}

    def camera(self, job: SampleJob) -> Camera:
        """Return the whole picture of a job's clip as a camera sees it that has no noise.

        Raises:
            VideoError: the video cannot be read, or not simulated.
        """
        key = job.clip.video, job.clip.start_frame
        if key not in self._made:
            self._made[key] = self._simulated(job)
        return self._made[key]

    def _simulated(self, job: SampleJob) -> Camera:
        catalogue, clip = self._catalogue, job.clip
        top, bottom = clip.rows.bounds(clip.height_px)
        scale = min(1.0, LONGEST_SIDE_PX / max(bottom - top, clip.width_px))
        height, width = (max(1, round(side * scale)) for side in (bottom - top, clip.width_px))
        recipe = clip.spec.recipe
        recipe = noise_free(recipe).replace(
            crop_height_px=height, crop_width_px=width, resize_scale=(1.0, 1.0), flip_probability=0.0,
            pause_probability=0.0, contrast_probability=0.0, threshold=(THRESHOLD, THRESHOLD),
            threshold_ratio=(1.0, 1.0), threshold_source="sample", lead_frames=0, lead_voxels=0,
            voxel_seconds=recipe.voxel_seconds[1],
            start="triangular" if recipe.start == FRAMES else recipe.start,
            **dict.fromkeys(effect_settings(), (0.0, 0.0)),
        )  # fmt: skip
        index, stride = catalogue.frame_index(clip.video), recipe.frame_stride
        whole = replace(
            clip, spec=StreamSpec(recipe=recipe), seed=0, arrays=("voxels", "frames"), rows=Rows(), height_px=height,
            width_px=width, thresholds=None, index_bytes=index.to_bytes(),
        )  # fmt: skip
        plan = plan_sample(whole, 0)
        frames = np.empty((len(plan.source), height, width), np.uint8)
        count = (len(frames) - 1) * stride + 1
        cut = Cut(len(frames), (top, 0, bottom - top, clip.width_px))
        with catalogue.source.open_pixels(clip.video, clip.fingerprint) as pixels:
            signal = SDR if recipe.light == "sdr" else signal_of(pixels, index)._replace(bits=8)
            taken = pixels.pictures(ClipRequest(index, clip.start_frame, (cut,), stride))
            for frame, picture in zip(frames, taken, strict=True):
                cv2.resize(picture.grey, (width, height), frame, interpolation=cv2.INTER_AREA)
        seconds = index.seconds(clip.start_frame, count)[::stride]
        decoded = DecodedClip(frames, seconds, codec="", bit_exact=False, signal=signal)
        sample = make_sample(replace(job, clip=whole), Decoded(plan, decoded))
        camera = Camera.of(sample.arrays, sample.provenance, f"threshold {THRESHOLD:g}, no noise", recipe)
        return replace(camera, step_seconds=step_seconds(clip))

    def estimate(self, job: SampleJob) -> CropEstimate:
        """Estimate what the camera of a job sees of its clip.

        Raises:
            VideoError: see :meth:`camera`.
        """
        clip, recipe = job.clip, job.clip.spec.recipe
        plan = plan_sample(replace(clip, thresholds=None), job.index)
        params = plan.params
        left, top = params.crop_left_px / params.scale, params.crop_top_px / params.scale
        width, height = recipe.crop_width_px / params.scale, recipe.crop_height_px / params.scale
        whole = self.camera(job)
        bins = whole.voxels.reshape(-1, *whole.voxels.shape[2:])
        steps = sum(params.grid_steps[recipe.lead_voxels :]) or recipe.voxels_per_clip * recipe.steps_per_frame
        shown = whole.provenance.params.ends(recipe)[-1] if recipe.is_timed else steps
        seen = int(plan.source[-1]) * len(bins) // int(shown)  # pauses leave the rest out
        scale = bins.shape[-1] / clip.width_px
        rows, columns = (
            slice(int(at * scale), int((at + size) * scale)) for at, size in ((top, height), (left, width))
        )
        crop = bins[:, rows, columns]
        events = float(np.abs(crop[:seen], dtype=np.float32).sum()) / (crop[0].size * steps)
        return CropEstimate(
            (clip.video, clip.start_frame),
            (left, top, width, height),
            events * THRESHOLD / max(params.threshold_pos, params.threshold_neg),
            noise_rate(params, step_seconds(clip)),
        )


def moving_seeds(remaker: Remaker, wholes: WholePictures, count: int) -> tuple[list[int], int]:
    """Choose seeds whose cameras look where something moves, among the first ones, and apart from each other.

    Motion and noise are estimated from the draw, so that no candidate is simulated.

    Args:
        remaker: of the stream that the cameras are drawn from.
        wholes: of the same corpus.
        count: seeds wanted.

    Returns:
        ``count`` different seeds, ascending, the first ones of all where no video can be read; and how many of them
        are estimated to see more motion than noise.
    """
    views: dict[int, CropEstimate] = {}
    clips: dict[tuple[str, int], bool] = {}
    for seed in range(max(CANDIDATES, 2 * count)):
        job = remaker.job(seed, 0, 0)
        clip = job.clip.video, job.clip.start_frame
        if not clips.get(clip, len(clips) < _MOST_CLIPS):
            continue
        try:
            views[seed] = wholes.estimate(job)
        except VideoError:
            clips[clip] = False
        else:
            clips[clip] = True
    best = max((view.motion for view in views.values() if view.moves), default=0.0)
    lively = [seed for seed, view in views.items() if view.moves and view.motion >= _ENOUGH * best]
    apart: list[int] = []
    for seed in lively:
        if not any(views[seed].overlaps(views[other]) for other in apart):
            apart.append(seed)
    rest = sorted(views, key=lambda seed: (not views[seed].moves, -views[seed].motion))
    chosen = list(dict.fromkeys([*apart, *rest, *range(count)]))[:count]
    return sorted(chosen), sum(seed in views and views[seed].moves for seed in chosen)


def noise_rate(params: SampleParams, step_seconds: float) -> float:
    """Estimate how often a pixel fires where nothing moves.

    Args:
        params: the draw.
        step_seconds: time between two frames; 0 where it is not known.

    Returns:
        Events a pixel and frame. Gaussian noise is a random walk of the residual, which leaves a threshold after
        (threshold / sigma) ** 2 steps on average.
    """
    share = params.noise_sigma / min(params.threshold_pos, params.threshold_neg)
    known = effect_settings()
    hertz = sum(float(params.effects.get(name, 0.0)) for name in NOISE if known[name].unit == "Hz")
    return share**2 / (1.0 + share) + hertz * step_seconds
