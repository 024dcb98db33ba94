"""One simulated clip as its virtual camera saw it: a description, its activity over time, its pauses."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import UsageError
from v2v_protocol.recipe import Recipe
from v2v_protocol.sample import Provenance

_SETTLED_SHARE = 0.1
"""Moments are chosen behind this share of a clip: at its beginning every pixel still waits for its first event."""
_MOSTLY = 0.5
_EVENTS = frozenset(("voxels", "event_counts", "voxels_bilinear"))
_FEWEST_EVENTS = 1e-3
"""Events a pixel and voxel grid below which a camera without noise counts as blind: 16 of a crop of 128 x 128."""
_STILL_QUANTILE, _STILL_LEVELS = 0.995, 8
"""Grey levels that a codec changes by itself where nothing moves."""


def check_drawable(arrays: Collection[str]) -> None:
    """Check that a picture can be made of these arrays.

    Raises:
        UsageError: frames are missing, or all of voxels, event_counts and voxels_bilinear.
    """
    if "frames" not in arrays or _EVENTS.isdisjoint(arrays):
        raise UsageError("a picture needs both arrays: voxels,frames (or event_counts or voxels_bilinear for voxels)")


def signed_counts(arrays: Mapping[str, npt.NDArray[Any]]) -> npt.NDArray[Any]:
    """Return signed events, [T, bins, H, W], from the first of voxels, event_counts and voxels_bilinear."""
    if "voxels" not in arrays and "event_counts" in arrays:
        counts = np.asarray(arrays["event_counts"])
        return np.asarray(np.subtract(counts[:, 1], counts[:, 0], dtype=np.float32))
    return np.asarray(arrays["voxels"] if "voxels" in arrays else arrays["voxels_bilinear"])


@dataclass(frozen=True, slots=True)
class Camera:
    """A clip and its camera.

    Attributes:
        voxels: [T, bins, H, W], signed event counts; with ``grids_per_frame``, the bins of all grids of a frame.
        frames: [T, H, W] uint8; frame t closes voxel grid t.
        flow: [T, 2, H, W], px, or None.
        title: written beside the camera, for instance the recipe's name.
        provenance: where the clip came from, and the draw.
        steps_per_frame: of the recipe, unless the draw has ``grid_steps``; a pause is a run of repeated frames.
        lead_voxels: voxel grids of the clip in front of the first one here.
        whole: [rows, columns] uint8, the video's picture that the camera's crop was taken from, or None.
        quiet: as ``rates``, of the same draw without noise, or None: not measured.
        boxes: [T, n, 7], see ``v2v_protocol.sample.BOX_COLUMNS``, or None.
        masks: [T, H, W] uint8, classes, or None.
        tracks: [T, N, 3], see ``v2v_protocol.sample.TRACK_COLUMNS``, or None.
        blurred: [T, H, W] uint8, the frames exposed for a time, or None.
        step_seconds: time between two frames that the pixels see; 0 or NaN where it is unknown.
    """

    voxels: npt.NDArray[Any]
    frames: npt.NDArray[np.uint8]
    flow: npt.NDArray[Any] | None
    title: str
    provenance: Provenance
    steps_per_frame: int
    lead_voxels: int = 0
    whole: npt.NDArray[np.uint8] | None = None
    quiet: npt.NDArray[np.float64] | None = None
    boxes: npt.NDArray[Any] | None = None
    masks: npt.NDArray[np.uint8] | None = None
    tracks: npt.NDArray[Any] | None = None
    blurred: npt.NDArray[np.uint8] | None = None
    step_seconds: float = 0.0

    @classmethod
    def of(
        cls,
        arrays: Mapping[str, npt.NDArray[Any]],
        provenance: Provenance,
        title: str,
        recipe: Recipe | None = None,
        whole: npt.NDArray[np.uint8] | None = None,
    ) -> Camera:
        """Create a camera from the arrays of one sample, without lead frames and lead voxels.

        Args:
            arrays: see ``v2v_protocol.sample.ARRAYS``.
            recipe: of the sample; None: every bin is a step.
            whole: [rows, columns], the picture that the crop was taken from, or None.

        Raises:
            UsageError: see :func:`check_drawable`.
        """
        check_drawable(arrays)
        voxels, frames, flow = signed_counts(arrays), arrays["frames"][:, 0], arrays.get("flow")
        steps_per_frame = voxels.shape[1] if recipe is None else recipe.steps_per_frame
        if recipe is not None and recipe.grids_per_frame:
            voxels = voxels.reshape(-1, recipe.grids_per_frame * recipe.bins, *voxels.shape[2:])
        count = min(len(array) for array in (voxels, frames, flow) if array is not None)
        boxes, masks, tracks, blurred = (arrays.get(name) for name in ("boxes", "masks", "tracks", "frames_blurred"))
        return cls(
            voxels[len(voxels) - count :],
            np.asarray(frames[len(frames) - count :]),
            None if flow is None else np.asarray(flow[len(flow) - count :]),
            title,
            provenance,
            steps_per_frame,
            len(voxels) - count,
            whole,
            boxes=None if boxes is None else np.asarray(boxes[len(boxes) - count :]),
            masks=None if masks is None else np.asarray(masks[len(masks) - count :, 0]),
            tracks=None if tracks is None else np.asarray(tracks[len(tracks) - count :]),
            blurred=None if blurred is None else np.asarray(blurred[len(blurred) - count :, 0]),
        )

    def picture(self, grid: int) -> npt.NDArray[np.uint8]:
        """Return the frame of a voxel grid, [H, W]; if it is known exposed too, that as its right half."""
        picture: npt.NDArray[np.uint8] = self.frames[grid].copy()
        if self.blurred is not None:
            half = picture.shape[1] // 2
            picture[:, half:] = self.blurred[grid, :, half:]
        return picture

    @property
    def crop(self) -> tuple[float, float, float, float]:
        """Left, top, right and bottom of the crop, px of the whole picture."""
        params = self.provenance.params
        height, width = self.frames.shape[1:]
        left, top, scale = params.crop_left_px, params.crop_top_px, params.scale
        return left / scale, top / scale, (left + width) / scale, (top + height) / scale

    @property
    def rates(self) -> npt.NDArray[np.float64]:
        """[2, T * bins] float64: brighter and darker events a pixel of each bin, from the signed counts."""
        flat = self.voxels.reshape(-1, *self.voxels.shape[2:])
        brighter = [np.maximum(each, 0).mean(dtype=np.float64) for each in flat]
        darker = [np.maximum(-each.astype(np.float32), 0).mean(dtype=np.float64) for each in flat]
        return np.array([brighter, darker])

    @property
    def paused(self) -> npt.NDArray[np.bool_]:
        """[T * bins] bool: True where every frame of the bin repeats the one before."""
        grids, bins = self.voxels.shape[:2]
        params = self.provenance.params
        ends = np.cumsum(params.grid_steps or (self.steps_per_frame,) * (self.lead_voxels + grids))
        still = np.zeros(ends[-1], np.bool_)
        for first, length in params.pauses:
            still[first - 1 : first - 1 + length] = True  # positions count from 1
        # A bin holds several steps, or a step several bins.
        parts = [np.repeat(steps, bins).reshape(bins, -1).all(axis=1) for steps in np.split(still, ends[:-1])]
        return np.concatenate(parts)[self.lead_voxels * bins :]

    @property
    def timing(self) -> str:
        """Duration of the clip, frame rate, and mean duration of a bin, in words; "" where they are unknown."""
        if not self.step_seconds > 0.0:
            return ""
        grids, bins = self.voxels.shape[:2]
        steps = self.provenance.params.grid_steps[-grids:] or (self.steps_per_frame,) * grids
        seconds = sum(steps) * self.step_seconds
        return f"{seconds:.2g} s, {1 / self.step_seconds:.3g} frames/s, {1e3 * seconds / (grids * bins):.2g} ms a bin"

    def moments(self, count: int) -> list[int]:
        """Choose voxel grids to show: the most active one of each of ``count`` equal stretches of time.

        Noise does not count where it is known, paused bins never do. The most active bin of a grid does not count
        either, because a cut of the film is a flash of one bin.

        Returns:
            At most ``count`` numbers of voxel grids, ascending.
        """
        bins = self.voxels.shape[1]
        moving = ~self.paused.reshape(-1, bins)
        each = (self.rates if self.quiet is None else self.quiet).sum(axis=0).reshape(-1, bins) * moving
        activity = (each.sum(axis=1) - (each.max(axis=1) if bins > 1 else 0.0)) * moving.mean(axis=1)
        first = min(round(len(activity) * _SETTLED_SHARE), len(activity) - 1)
        edges = np.linspace(first, len(activity), min(count, len(activity) - first) + 1).round().astype(int)
        return [int(start + np.argmax(activity[start:end])) for start, end in pairwise(edges)]

    def noise_share(self, grids: Sequence[int]) -> float | None:
        """Return which share of the events of these voxel grids is noise: 0 to 1, or None where it is not known."""
        if self.quiet is None:
            return None
        events, quiet = (self._in_grids(rates, grids) for rates in (self.rates, self.quiet))
        return max(0.0, 1.0 - quiet / events) if events else 0.0

    def warning(self, grids: Sequence[int]) -> str:
        """Return a warning with the reason if most events come from something other than motion, else ""."""
        share = self.noise_share(grids)
        if self.quiet is None or share is None:
            return ""
        if self._in_grids(self.quiet, grids) / len(grids) < _FEWEST_EVENTS:
            why = "nothing moves here" if self._is_still(grids) else "no motion reaches the thresholds"
            return f"{why}: all events are noise" if share > _MOSTLY else why
        return f"mostly noise: {share:.0%} of the events" if share > _MOSTLY else ""

    def _in_grids(self, rates: npt.NDArray[np.float64], grids: Sequence[int]) -> float:
        return float(rates.sum(axis=0).reshape(len(self.voxels), -1)[list(grids)].sum())

    def _is_still(self, grids: Sequence[int]) -> bool:
        """Return whether no frame differs from the one of the voxel grid before it."""
        for grid in grids:
            before, now = self.frames[max(0, grid - 1)].astype(np.int16), self.frames[grid]
            if np.quantile(np.abs(now - before), _STILL_QUANTILE) > _STILL_LEVELS:
                return False
        return True

    def describe(self) -> str:
        """Return the draw in one line, without what is zero."""
        params = self.provenance.params
        parts = [f"threshold +{params.threshold_pos:.2f} / -{params.threshold_neg:.2f}"]
        if self.provenance.is_recorded:
            parts = ["recorded", *(_with_unit(name, value) for name, value in params.added.items() if value)]
        if params.noise_sigma:
            parts.append(f"noise {params.noise_sigma:.3f}")
        if params.hot_pixel_count:
            parts.append(f"{params.hot_pixel_count} hot pixels")
        if params.log_eps is not None:
            parts.append(f"dark floor {params.log_eps:.3f}")
        if params.scale != 1.0:
            parts.append(f"resized by {params.scale:.2f}")
        if params.flip:
            parts.append("mirrored")
        if params.contrast:
            parts.append(f"contrast {params.contrast:.2f}")
        if params.voxel_seconds:
            parts.append(f"grids of {1e3 * params.voxel_seconds:.3g} ms")
        effects = params.to_dict().get("effects", {})
        parts += [_with_unit(name, value) for name, value in effects.items() if value]
        return "   ".join(parts)

    @property
    def source(self) -> str:
        """Video and first frame."""
        return f"{self.provenance.video}, from frame {self.provenance.start_frame}"


_UNITS = {"_hz": (1.0, " Hz"), "_seconds": (1e3, " ms"), "_share": (100.0, " %"), "_sigma": (1.0, "")}


def _with_unit(name: str, value: float) -> str:
    """Write ``shot_noise_hz`` 1.26 as "shot noise 1.26 Hz"."""
    for ending, (factor, unit) in _UNITS.items():
        if name.endswith(ending):
            shown = f"{factor * value:.0f}" if factor * value >= 100 else f"{factor * value:.2g}"
            return f"{name.removesuffix(ending).replace('_', ' ')} {shown}{unit}"
    return f"{name.replace('_', ' ')} {value:.3g}"
