"""Optical flow between the target frames of a clip, estimated by classic methods on the CPU.

A field f on the grid of picture A states where each pixel of A is in picture B: B(x + f(x)) = A(x), in pixels, (x, y),
x to the right and y down. Forward flow lies on the grid of the earlier picture, backward flow on that of the later one.

Order: resize the picture, estimate on the crop with its margin, crop, flip. The contrast of a degraded view is left
out: it moves nothing, and clips values that are needed for matching.

Methods. All of them are zero or dense inverse search (Kroeger et al., "Fast Optical Flow using Dense Inverse Search",
ECCV 2016) by OpenCV: patches are matched from coarse to fine down to a finest scale, whose field is then enlarged.
Scale 2 is a quarter of the picture's size; scale 1 takes two to three times as long and resolves motion that scale 2
blurs.

``auto`` chooses for each pair of pictures by a quick estimate of the motion:

- Still: no block of 8 x 8 pixels changes its mean by more than 1.5 grey levels. A coder's noise averages out in a
  block, a moving edge does not. The flow is zero.
- Slow: 95 % of the picture moves less than half a pixel. Dense inverse search without refinement is then as accurate as
  with it, in half the time.
- Otherwise with refinement. Of the methods whose median error on pans and zooms is below a quarter of a pixel it is the
  cheapest that also works on frames with little texture (docs/flow.md).

The quick estimate takes about a third of the time of the costliest choice: dense inverse search on the picture at a
quarter of its size.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import UsageError
from v2v_protocol.recipe import Recipe
from v2v_protocol.sample import SampleParams
from v2v_protocol.spec import StreamSpec
from v2v_server.simulation.draw import resized_size
from v2v_server.simulation.view import FrameArray, Window, crop_place, crop_region, resized
from v2v_server.system.compile_cache import cv2

GreyPicture = npt.NDArray[np.uint8]
"""[h, w] uint8, C-contiguous."""
Field = npt.NDArray[np.float32]
"""[h, w, 2] float32, (x, y), px."""
Estimator = Callable[[GreyPicture, GreyPicture], Field]
"""estimate(A, B): the field on the grid of A that leads to B. The result does not depend on earlier calls. It holds
buffers, so each thread needs its own."""

DIS_ULTRAFAST, DIS_FAST = range(2)
"""OpenCV's numbers, DISOPTICAL_FLOW_PRESET_*; using its names would import it."""
_SMALLEST_SIDE_PX = 64
"""OpenCV refuses pictures below 12 pixels, and reads outside its buffers on some larger ones: 16x300, 24x600."""

AUTO, STILL_METHOD, SLOW_METHOD, MOVING_METHOD = "auto", "zero", "dis-ultrafast", "dis-fast"
_BLOCK_PX = 8
STILL_GREY_LEVELS = 1.5
_SHRINK = 4
SLOW_PX = 0.5
_MOST_OF_THE_PICTURE = 0.95


def zero() -> Estimator:
    """Return an estimator that always gives zero flow."""
    return lambda first, second: np.zeros((*first.shape, 2), np.float32)


def dis(preset: int, finest_scale: int, refinements: int | None = None) -> Estimator:
    """Return a guarded estimator: dense inverse search with a preset's number of iterations and patch stride.

    Args:
        preset: DIS_ULTRAFAST or DIS_FAST.
        finest_scale: the pyramid level that matching ends at; 0 is the full picture.
        refinements: iterations of the variational refinement; None: the preset's, 5 (ultrafast: 0).
    """
    search = cv2.DISOpticalFlow.create(preset)
    if refinements is not None:
        search.setVariationalRefinementIterations(refinements)

    def estimate(first: GreyPicture, second: GreyPicture) -> Field:
        # A small picture makes OpenCV lower the finest scale, also for the pictures that follow.
        search.setFinestScale(finest_scale)
        field: Field = search.calc(first, second, None)  # type: ignore[call-overload]
        return field

    return guarded(estimate, _SMALLEST_SIDE_PX)


METHODS: Mapping[str, Callable[[], Estimator]] = MappingProxyType(
    {
        STILL_METHOD: zero,
        SLOW_METHOD: partial(dis, DIS_ULTRAFAST, 2),
        MOVING_METHOD: partial(dis, DIS_FAST, 2),
        "dis-fast-lean": partial(dis, DIS_FAST, 2, 3),
        "dis-fast-1": partial(dis, DIS_FAST, 1),
    }
)
"""Constructors of the estimators. "lean" refines three times, not five; "1" is the finest scale."""


def estimator(name: str) -> Estimator:
    """Return a new estimator of that method.

    Raises:
        UsageError: there is no such method; the message lists them.
    """
    if name not in METHODS:
        raise UsageError(f"flow method {name!r}: choose one of {', '.join(METHODS)}")
    return METHODS[name]()


def choose(first: GreyPicture, second: GreyPicture) -> str:
    """Return the method that "auto" uses for a pair of [h, w] uint8 pictures."""
    change = cv2.subtract(first, second, dtype=cv2.CV_32F)
    if float(np.abs(_shrunk(change, _BLOCK_PX)).max()) <= STILL_GREY_LEVELS:
        return STILL_METHOD
    field = dis(DIS_ULTRAFAST, 1)(_shrunk(first, _SHRINK), _shrunk(second, _SHRINK))
    pace = np.quantile(np.hypot(field[..., 0], field[..., 1]), _MOST_OF_THE_PICTURE) * _SHRINK
    return SLOW_METHOD if pace < SLOW_PX else MOVING_METHOD


def _shrunk(picture: npt.NDArray[Any], factor: int) -> npt.NDArray[Any]:
    height, width = picture.shape
    size = (max(1, width // factor), max(1, height // factor))
    return cv2.resize(picture, size, interpolation=cv2.INTER_AREA)


def guarded(estimate: Estimator, smallest_side_px: int) -> Estimator:
    """Return a safe form of an estimator.

    Equal pictures have exactly zero flow, whatever the method returns. A picture with a side below ``smallest_side_px``
    is enlarged by repeating its border: methods fail on smaller ones, some with a segmentation fault.
    """

    def safe(first: GreyPicture, second: GreyPicture) -> Field:
        height, width = first.shape
        if np.array_equal(first, second):
            return np.zeros((height, width, 2), np.float32)
        below, right = max(0, smallest_side_px - height), max(0, smallest_side_px - width)
        if below or right:
            first, second = (
                cv2.copyMakeBorder(picture, 0, below, 0, right, cv2.BORDER_REPLICATE).astype(np.uint8, copy=False)
                for picture in (first, second)
            )
        return estimate(first, second)[:height, :width]

    return safe


@contextmanager
def one_thread() -> Iterator[None]:
    """Limit OpenCV to one thread: a server worker uses one core, and dividing a picture among threads must not change a
    result.
    """
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


SKIPPED = "skipped"
PAUSED = "paused"
_CONSISTENT_SHARE, _CONSISTENT_PX2 = 0.01, 0.5


@dataclass(frozen=True, slots=True)
class FlowSettings:
    """Settings of the flow of a clip: the flow fields of a ``StreamSpec``, which checks them.

    Attributes:
        method: a name of :data:`v2v_server.flow.METHODS`, or "auto": chosen for each pair by its motion.
        direction: "forward", on the grid of the earlier frame, or "backward", on that of the later one.
        first_voxel: index of the first voxel with computed flow; earlier flow is zero (20: the half rule of the
            temporal consistency loss).
        margin_px: margin around the crop in which flow is also estimated; None: the whole picture.
    """

    method: str = AUTO
    direction: str = "forward"
    first_voxel: int = 0
    margin_px: int | None = 64

    @classmethod
    def of(cls, spec: StreamSpec) -> FlowSettings:
        """Return the settings that a stream's spec states."""
        margin_px = None if spec.flow_margin_px < 0 else spec.flow_margin_px
        return cls(spec.flow_method, spec.flow_direction, spec.flow_from, margin_px)


@dataclass(frozen=True, slots=True)
class FlowClip:
    """Flow of one sample.

    Attributes:
        flow: [T, 2, H, W] float16, (x, y), px; flow[t] belongs to voxel t of the target sequence.
        valid: [T, 1, H, W] uint8, 1 where the forward-backward check holds; None if it was not requested.
        methods: method of each flow[t]: its name, "paused" or "skipped".
    """

    flow: npt.NDArray[np.float16]
    valid: npt.NDArray[np.uint8] | None
    methods: tuple[str, ...]


def flow_for(
    frames: FrameArray,
    params: SampleParams,
    recipe: Recipe,
    settings: FlowSettings,
    *,
    validity: bool = False,
    plan: Sequence[str] = (),
) -> FlowClip:
    """Estimate flow between the ends of each voxel of one drawn sample.

    A voxel whose two ends are the same frame of the video (the camera pauses) has exactly zero flow.

    Args:
        frames: [n, h, w] uint8, the decoded frames in the ``source_window`` of the view with the settings' margin.
        params, recipe: the draw and its recipe.
        settings: method, direction, first voxel and margin.
        validity: also compute the mask, which takes a second estimate of each pair.
        plan: the method of each voxel, instead of that of the settings; "zero" reads no pixel.

    Raises:
        UsageError: the frames do not hold the crop or the frames that the draw shows, or ``first_voxel`` is out of
            range.
    """
    count, height, width = recipe.voxels_per_clip, recipe.crop_height_px, recipe.crop_width_px
    if settings.first_voxel > count:
        raise UsageError(f"flow from voxel {settings.first_voxel}: the clip has {count} voxels")
    positions = params.ends(recipe)
    source = params.source_index(int(positions[-1]))
    ends = source[positions[recipe.lead_voxels :]].tolist()
    pictures = _Pictures(frames, params, recipe, settings.margin_px, int(source[-1]) + 1)
    flow = np.zeros((count, 2, height, width), np.float16)
    valid = np.zeros((count, 1, height, width), np.uint8) if validity else None
    methods = [SKIPPED] * settings.first_voxel
    estimators: dict[str, Estimator] = {}
    with one_thread():
        for voxel in range(settings.first_voxel, count):
            start, end = ends[voxel : voxel + 2]
            planned = plan[voxel] if plan else settings.method
            if start == end or (plan and planned == STILL_METHOD):
                methods.append(PAUSED if start == end else STILL_METHOD)
                if valid is not None:
                    valid[voxel] = 1
                continue
            earlier, later = pictures.pair(start, end)
            first, second = (earlier, later) if settings.direction == "forward" else (later, earlier)
            name = choose(first, second) if planned == AUTO else planned
            methods.append(name)
            if name not in estimators:
                estimators[name] = estimator(name)
            estimate = estimators[name]
            field = estimate(first, second)
            flow[voxel] = pictures.crop(field, params.flip).transpose(2, 0, 1)
            if params.flip:
                np.negative(flow[voxel, 0], out=flow[voxel, 0])
            if valid is not None:
                valid[voxel, 0] = pictures.crop(consistent(field, estimate(second, first)), params.flip)
    return FlowClip(flow, valid, tuple(methods))


def consistent(field: Field, opposite: Field) -> npt.NDArray[np.bool_]:
    """Return where following a field and then its opposite leads back to the start:

        |f(x) + g(x + f(x))|^2 < 0.01 (|f(x)|^2 + |g(x + f(x))|^2) + 0.5

    (Sundaram, Brox and Keutzer, "Dense Point Trajectories by GPU-Accelerated Large Displacement Optical Flow", ECCV
    2010, equation 5). It fails where a pixel is hidden in the other picture; a pixel that leaves the picture is invalid
    too.

    Args:
        field: f, [h, w, 2] float32, px.
        opposite: g, on the grid of the other picture.

    Returns:
        [h, w] bool.
    """
    height, width = field.shape[:2]
    x = field[..., 0] + np.arange(width, dtype=np.float32)
    y = field[..., 1] + np.arange(height, dtype=np.float32)[:, None]
    inside = (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
    back = cv2.remap(opposite, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    gap = ((field + back) ** 2).sum(axis=-1)
    length = (field**2).sum(axis=-1) + (back**2).sum(axis=-1)
    agree: npt.NDArray[np.bool_] = inside & (gap < _CONSISTENT_SHARE * length + _CONSISTENT_PX2)
    return agree


class _Pictures:
    """The pictures that flow is estimated on, computed on first use."""

    def __init__(
        self, frames: FrameArray, params: SampleParams, recipe: Recipe, margin_px: int | None, needed: int
    ) -> None:
        if frames.ndim != 3 or frames.dtype != np.uint8 or len(frames) < needed:
            raise UsageError(f"frames {frames.dtype}{list(frames.shape)}: this draw shows {needed}, uint8 [n, h, w]")
        self._frames = frames
        self._scale = params.scale
        self._size: tuple[int, int] = (frames.shape[1], frames.shape[2])
        self._top, self._left = crop_place(params, margin_px)
        self._height, self._width = recipe.crop_height_px, recipe.crop_width_px
        self._region = Window(0, 0, self._size[0], self._size[1])
        if params.scale != 1.0:
            self._size = resized_size(self._size[0], self._size[1], params.scale)
            self._region = crop_region(params, recipe, self._size[0], self._size[1], margin_px)
        self._made: dict[int, GreyPicture] = {}
        if self._region.height_px < self._top + self._height or self._region.width_px < self._left + self._width:
            raise UsageError(
                f"frames of {frames.shape[2]}x{frames.shape[1]} pixels at scale {params.scale} do not hold a crop of "
                f"{self._width}x{self._height} with its margin: decode the window that source_window() names"
            )

    def pair(self, earlier: int, later: int) -> tuple[GreyPicture, GreyPicture]:
        # The later picture of a pair is usually the earlier picture of the next; older ones are not needed again.
        self._made = {number: self._made[number] if number in self._made else self._make(self._frames[number])
                      for number in (earlier, later)}  # fmt: skip
        return self._made[earlier], self._made[later]

    def _make(self, frame: GreyPicture) -> GreyPicture:
        if self._scale == 1.0:
            return np.ascontiguousarray(frame)
        whole = resized(frame, self._size, self._scale)
        top, left, height, width = self._region
        return np.ascontiguousarray(whole[top : top + height, left : left + width])

    def crop(self, field: npt.NDArray[Any], flip: bool) -> npt.NDArray[Any]:
        """Return the crop's part of an array on the grid of the pictures, mirrored if the view is; values are
        unchanged.
        """
        part = field[self._top : self._top + self._height, self._left : self._left + self._width]
        return part[:, ::-1] if flip else part
