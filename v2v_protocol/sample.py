"""One sample: its identity, its draw, and its provenance."""

from __future__ import annotations

import html
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import reduce
from operator import or_
from typing import Any, Literal, TypeAlias, get_args

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import UsageError
from v2v_protocol.persisted import Persisted, later
from v2v_protocol.recipe import Recipe, effect_settings
from v2v_protocol.settings import require_known, require_whole


class RefusalKind:
    """Which part refuses a video.

    UNUSABLE: the catalogue; the file cannot be opened, or is not a video.
    UNSUITED: the schedule; it gives no sequence under the recipe.
    FAILED: a worker; the file did not deliver what was catalogued, or the worker died over it.
    QUARANTINED: the quarantine, which records the sequences that brought workers down.
    """

    UNUSABLE = "unusable"
    UNSUITED = "unsuited"
    FAILED = "failed"
    QUARANTINED = "quarantined"


@dataclass(frozen=True, slots=True)
class Refusal(Persisted):
    """A video that cannot be used for a request.

    Attributes:
        video: its catalogue id.
        frame: the first unavailable frame, presentation order; None if no single frame is to blame.
        reason: one line of text.
        kind: which part refuses it.
        remedy: which setting would admit it, in words; empty if no setting would.
    """

    video: str
    frame: int | None
    reason: str
    kind: str = RefusalKind.FAILED
    remedy: str = later("")

    def __str__(self) -> str:
        where = "" if self.frame is None else f" at frame {self.frame}"
        remedy = f"; would admit it: {self.remedy}" if self.remedy else ""
        return f"{self.video}{where}: {self.reason}{remedy}"


LARGEST_SEED = 2**64 - 1
LARGEST_EPOCH = 2**32 - 1
LARGEST_INDEX = 2**48 - 1
BOX_COLUMNS = ("x0", "y0", "x1", "y1", "class", "track", "visible")
"""Columns of the array ``boxes``: corners in px of the crop, class, track, and the share of the box in the crop.

Coordinates are continuous: pixel (row, column) covers column <= x < column + 1 and row <= y < row + 1. Class and track
are whole numbers; a box without a track has -1. Rows without a box hold -1 in all columns."""
TRACK_COLUMNS = ("x", "y", "visible")
"""Columns of the array ``tracks``: the place in px of the crop, as for boxes, and 1 where the point is seen, else 0."""
ArrayShape: TypeAlias = tuple[str, tuple[int, ...]]
"""dtype and shape of an array of one sample."""
EventShape: TypeAlias = Callable[[str, int, int, int, int], ArrayShape]
"""dtype and shape, by the spec's ``voxel_dtype``, the number of voxel grids, the bins of a grid, and height and width
of the picture."""


Seconds: TypeAlias = Literal["", "if known", "must"]
EstimatedFlow: TypeAlias = Literal["", "estimated", "checked"]
"""Words of :class:`Needs`; each asks for more than the one before."""


@dataclass(frozen=True, slots=True)
class Needs:
    """What an array is made from, beside the frames.

    Attributes:
        events: the clip is simulated before the array is made.
        seconds: the time between frames. "if known": a sample of a video without a known frame rate has an empty array,
            and says so; "must": such a video gives no sample.
        levels: the levels between frames, where the spec has sub-steps; a simulation always has them.
        flow: optical flow, "estimated" or also "checked" for where it is reliable.
        colour: the colour of the delivered frames.
        sidecars: endings of the sidecars that it can be made from, files or folders beside the video: ".boxes.json" for
            ``clip.boxes.json`` beside ``clip.mp4``; with a slash at its end for a folder. One of them is enough.
    """

    events: bool = False
    seconds: Seconds = ""
    levels: bool = False
    flow: EstimatedFlow = ""
    colour: bool = False
    sidecars: tuple[str, ...] = ()

    def __or__(self, other: Needs) -> Needs:
        """Return what both need together."""
        return Needs(
            self.events or other.events,
            max(self.seconds, other.seconds, key=get_args(Seconds).index),
            self.levels or other.levels,
            max(self.flow, other.flow, key=get_args(EstimatedFlow).index),
            self.colour or other.colour,
            tuple(sorted({*self.sidecars, *other.sidecars})),
        )


@dataclass(frozen=True, slots=True)
class ArrayForm:
    """An array that a consumer may request.

    Attributes:
        shape: dtype and shape for one sample, by the recipe and the spec's ``voxel_dtype``.
        needs: what it is made from.
        empty: value of the whole array in a sample for which it cannot be made.
        refused: why there is none under a recipe, and what to do; "" if there is.
        of_events: dtype and shape of a representation (``v2v_server/simulation/representations/``), which the kernel
            makes; None for all other arrays.
    """

    shape: Callable[[Recipe, str], ArrayShape]
    needs: Needs = Needs()
    empty: float = 0
    of_events: EventShape | None = None
    refused: Callable[[Recipe], str] = lambda _: ""


def of_events(shape: EventShape, seconds: Seconds = "", empty: float = 0) -> ArrayForm:
    """Return the form of an array that the kernel makes of the clip's events.

    Args:
        shape: its dtype and shape.
        seconds, empty: see :class:`Needs` and :class:`ArrayForm`.
    """
    return ArrayForm(
        lambda recipe, voxel_dtype: shape(voxel_dtype, recipe.voxel_grids, recipe.bins, *recipe.crop_px),
        Needs(events=True, seconds=seconds),
        empty,
        shape,
    )


_SHARP = "needs an exposure, and the recipe has none: set exposure_seconds, such as 0.01"
_NO_SHAPE = (
    "has one shape for all samples, but with voxel_seconds each has another number of frames: ask for frames, or set "
    "voxel_seconds to 0"
)
_REAL = {"float32": "float32"}
"""dtype of values that are no counts, by ``voxel_dtype``; float16 for the others."""
ARRAYS: dict[str, ArrayForm] = {
    "voxels": of_events(lambda dtype, *shape: (dtype, shape)),
    "event_counts": of_events(lambda dtype, grids, *rest: (dtype, (grids, 2, *rest))),
    "voxels_bilinear": of_events(lambda dtype, *shape: (_REAL.get(dtype, "float16"), shape)),
    "time_surface": of_events(
        lambda dtype, grids, *rest: (_REAL.get(dtype, "float16"), (grids, 2, *rest)), "if known", math.inf
    ),
    "frames": ArrayForm(lambda recipe, _: ("uint8", (recipe.delivered_frames, 1, *recipe.crop_px))),
    "frames_rgb": ArrayForm(
        lambda recipe, _: ("uint8", (recipe.delivered_frames, 3, *recipe.crop_px)), Needs(colour=True)
    ),
    "frames_blurred": ArrayForm(
        lambda recipe, _: ("uint8", (recipe.delivered_frames, 1, *recipe.crop_px)), Needs(seconds="must"),
        refused=lambda recipe: "" if any(recipe.exposure_seconds) else _SHARP,
    ),
    "frames_all": ArrayForm(
        lambda recipe, _: ("uint8", (recipe.steps + 1, 1, *recipe.crop_px)),
        refused=lambda recipe: _NO_SHAPE if recipe.is_timed else "",
    ),
    "frames_u16": ArrayForm(lambda recipe, _: ("uint16", (recipe.delivered_frames, 1, *recipe.crop_px))),
    "flow": ArrayForm(
        lambda recipe, _: ("float16", (recipe.voxels_per_clip, 2, *recipe.crop_px)), Needs(flow="estimated")
    ),
    "flow_valid": ArrayForm(
        lambda recipe, _: ("uint8", (recipe.voxels_per_clip, 1, *recipe.crop_px)), Needs(flow="checked")
    ),
    "tracks": ArrayForm(
        lambda recipe, _: ("float32", (recipe.delivered_frames, recipe.track_points, len(TRACK_COLUMNS)))
    ),
    "boxes": ArrayForm(
        lambda recipe, _: ("float32", (recipe.delivered_frames, recipe.max_boxes, len(BOX_COLUMNS))),
        Needs(sidecars=(".boxes.json", ".boxes.txt", ".boxes/")),
        empty=-1,
    ),
    "masks": ArrayForm(
        lambda recipe, _: ("uint8", (recipe.delivered_frames, 1, *recipe.crop_px)),
        Needs(sidecars=(".masks/",)),
        empty=255,
    ),
}  # fmt: skip
"""Arrays a consumer may request: dtype and shape for one sample (no batch dimension), by the recipe and the spec's
``voxel_dtype``. ``v2v_server.worker.arrays`` makes them, ``Batch.arrays`` has them. Flow is px in (x, y); flow_valid is
1 where forward and backward flow agree, and of photographs, whose flow is exact, where the point is seen at both ends.

event_counts are the negative (0) and positive (1) events of each bin: one array with an axis of polarity, because
RVT's stacked histogram and the input of a spiking network are then views of it, with one name and one buffer. Its dtype
is that of the voxels, so that ``counts[:, 1] - counts[:, 0]`` does not wrap. voxels_bilinear shares each event between
the two bins next to its time (Zhu et al. 2019). time_surface is the age of a pixel's last negative (0) and positive (1)
event at the end of each bin, seconds; infinity before its first one in the clip.

frames_rgb are the frames in colour; frames_blurred are exposed for a time (``exposure_seconds``); frames_all are all
frames that are simulated, the first included. boxes, masks and tracks belong to the frames of the same number. masks
hold classes; 255 marks a sample without labels. Masks of photographs need no sidecar: 0 is the photograph, 1 and 2 the
patches in front of it. tracks follow ``track_points`` points, and only photographs have them."""
DEFAULT_ARRAYS = ("voxels", "frames")
RECORDING_FORMAT = "v2v recording"
"""Decoder of samples whose events were recorded, not simulated."""
Layout: TypeAlias = Mapping[str, tuple[str, tuple[int, ...]]]
"""dtype and shape of each array of one sample, by name, in the order of the headers."""


@dataclass(frozen=True, slots=True)
class SampleId(Persisted):
    """Identity of a sample. Equal identities mean equal bytes on any host, at any time.

    Attributes:
        spec_digest: digest of the :class:`v2v_protocol.spec.StreamSpec`.
        catalogue_digest: digest of the catalogue snapshot.
        numerics_version: :data:`v2v_protocol.NUMERICS_VERSION` of the maker.
        seed: 0 .. 2**64 - 1.
        epoch: 0 .. 2**32 - 1.
        index: global index in the epoch's permutation.
    """

    spec_digest: str
    catalogue_digest: str
    numerics_version: int
    seed: int
    epoch: int
    index: int

    def __post_init__(self) -> None:
        require_whole("seed", self.seed, 0, LARGEST_SEED)
        require_whole("epoch", self.epoch, 0, LARGEST_EPOCH)
        require_whole("index", self.index, 0, LARGEST_INDEX)


@dataclass(frozen=True, slots=True)
class SampleParams(Persisted):
    """One draw from a recipe.

    Attributes:
        threshold_pos, threshold_neg: contrast thresholds, log units, exactly representable in float32.
        noise_sigma: log units per frame, or per square root of a second (the recipe's ``noise_unit``).
        hot_pixel_count: number of hot pixels in the crop.
        hot_pixel_sigma: standard deviation of their drift, log units per frame or per second.
        pauses: (first, length) of each run of repeated frames; first is the position in 1 .. steps of the first repeat.
        scale: resize factor of the picture before the crop.
        crop_top_px, crop_left_px: place of the crop in the resized picture.
        flip: True mirrors left and right.
        contrast: the degrade scale s, or 0.0 when the picture is left alone.
        noise_key: four 32-bit words that key every per-pixel random number of this sample.
        effects: what the camera does beyond the paper's pixel model: the values drawn for those fields of the recipe
            that switch an effect on; empty for the paper's pixel.
        log_eps: epsilon inside the logarithm where the recipe gives a range; None where it gives one value.
        voxel_seconds: drawn duration of a voxel grid; 0 if the recipe states none.
        grid_steps: steps between frames that each grid of this duration spans; empty if the recipe states none.
        exposure_seconds: of the frames that are blurred; 0 if the recipe states none.
        added: values drawn for the noise that is added to finished bins, by field; empty without.
    """

    threshold_pos: float
    threshold_neg: float
    noise_sigma: float
    hot_pixel_count: int
    hot_pixel_sigma: float
    pauses: tuple[tuple[int, int], ...]
    scale: float
    crop_top_px: int
    crop_left_px: int
    flip: bool
    contrast: float
    noise_key: tuple[int, int, int, int]
    effects: Mapping[str, float] = later(default_factory=dict)
    log_eps: float | None = later(None)
    voxel_seconds: float = later(0.0)
    grid_steps: tuple[int, ...] = later(())
    exposure_seconds: float = later(0.0)
    added: Mapping[str, float] = later(default_factory=dict)

    def __post_init__(self) -> None:
        known = effect_settings()
        require_known(self.effects, known, "effect")
        for name, value in self.effects.items():
            known[name].check(f"effect {name}", value)

    def ends(self, recipe: Recipe) -> npt.NDArray[np.int64]:
        """Return the positions in the clip (0 .. steps) between which its spans lie, from one delivered frame to the
        next.

        Returns:
            [recipe.spans + 1] int64, from 0 to the number of steps; the delivered frames are those from
            ``recipe.first_frame`` on.
        """
        if self.grid_steps:
            return np.concatenate(([0], np.cumsum(self.grid_steps, dtype=np.int64)))
        return np.arange(0, recipe.steps + 1, recipe.steps_per_frame)

    def source_index(self, steps: int) -> npt.NDArray[np.int64]:
        """Return which decoded frame each position of the clip shows.

        Returns:
            [steps + 1] int64, starting at 0, each entry equal to the one before (paused) or one more.
        """
        advance = np.ones(steps + 1, np.int64)
        advance[0] = 0
        for first, length in self.pauses:
            advance[first : first + length] = 0
        return np.cumsum(advance)


@dataclass(frozen=True, slots=True)
class Provenance(Persisted):
    """Origin of a sample: enough to make it again and to explain it. Deterministic: no clock, no host.

    Attributes:
        id: the sample's identity.
        video: catalogue id (relative POSIX path) of the source.
        fingerprint: size and hash of the source file.
        start_frame: first frame of the sequence, presentation order.
        candidate: number of the candidate of the index; 0 unless the sample is a substitute.
        refusals: refusals of the candidates before it, in their order.
        params: the draw.
        saturated_bins: voxel bins whose count did not fit the dtype and were clipped.
        irregular_timestamps: steps whose time stamps were missing or not increasing (noise per second used the
            average rate there).
        decoder: codec name, and whether its decoding is bit-exact on every host.
        quarantine: number of the quarantine snapshot it was made under.
        scene: decisions from the statistics of its scene, and the figures behind them; empty with scene "off".
        saturated: as ``saturated_bins``, for other arrays by name; only those that have any.
        sidecars: fingerprints of the sidecars that its arrays were made from, by ending.
        unlabelled: reason by array, for each requested array that could not be made from the video or its sidecars.
        boxes_dropped: boxes that ``max_boxes`` left out, in all frames of the sample.
        grid_seconds: actual duration of each voxel grid, where the recipe states ``voxel_seconds``.
        left_out: effects of the draw that were not simulated; only samples of earlier releases have any.
        substeps: parts that the clip's steps were divided into, undivided steps included; 0: the spec divides none
            (``substep_px``, ``world_change_share``).
        remark: what of the video is not served, or served with wrong grey levels or times; empty for most.
        dropped: as ``boxes_dropped``, for other labels by name; only those that have any.
        run_in: frames before the clip that its pixels start from; 0: there were too few, so they start by the
            triangular law; None: the recipe asks for none (``start``).
    """

    id: SampleId
    video: str
    fingerprint: str
    start_frame: int
    candidate: int
    refusals: tuple[Refusal, ...]
    params: SampleParams
    saturated_bins: int
    irregular_timestamps: int
    decoder: str
    quarantine: int = 0
    scene: str = later("")
    saturated: Mapping[str, int] = later(default_factory=dict)
    sidecars: Mapping[str, str] = later(default_factory=dict)
    unlabelled: Mapping[str, str] = later(default_factory=dict)
    boxes_dropped: int = later(0)
    grid_seconds: tuple[float, ...] = later(())
    left_out: tuple[str, ...] = later(())
    substeps: int = later(0)
    remark: str = later("")
    dropped: Mapping[str, int] = later(default_factory=dict)
    run_in: int | None = later(None)

    @property
    def is_recorded(self) -> bool:
        """Return whether the events are those of a camera, so that thresholds and noise of the draw were not used."""
        return self.decoder.startswith(RECORDING_FORMAT)

    @property
    def labelled(self) -> bool:
        """Return whether all requested arrays could be made."""
        return not self.unlabelled

    def __repr__(self) -> str:
        where = f"seed {self.id.seed}, epoch {self.id.epoch}, index {self.id.index}"
        return f"Provenance({self.video!r} from frame {self.start_frame}, {where})"

    def _repr_html_(self) -> str:
        rows = self.to_dict()
        rows |= {f"id: {name}": value for name, value in rows.pop("id").items()}
        rows |= {f"drawn: {name}": value for name, value in rows.pop("params").items()}
        return html_table(f"{self.video}, from frame {self.start_frame}", rows)


def array_layout(recipe: Recipe, voxel_dtype: str, arrays: tuple[str, ...]) -> Layout:
    """Return dtype and shape of each requested array of one sample, as :data:`ARRAYS` states them.

    Raises:
        UsageError: an unknown array, one requested twice, an empty request, or one that a recipe does not have.
    """
    if not arrays or len(set(arrays)) != len(arrays):
        raise UsageError(f"arrays = {list(arrays)}: ask for one or more of {', '.join(ARRAYS)}, each once")
    for name in arrays:
        if name not in ARRAYS:
            raise UsageError(f"arrays: unknown array {name!r}; known: {', '.join(ARRAYS)}")
        if why := ARRAYS[name].refused(recipe):
            raise UsageError(f"arrays: {name} {why}")
    return {name: ARRAYS[name].shape(recipe, voxel_dtype) for name in arrays}


def needs_of(arrays: Iterable[str]) -> Needs:
    """Return what these arrays need together; unknown ones need nothing."""
    return reduce(or_, (ARRAYS[name].needs for name in arrays if name in ARRAYS), Needs())


def sidecar_endings(arrays: Iterable[str]) -> tuple[str, ...]:
    """Return the endings of the sidecars that these arrays are made from, sorted."""
    return needs_of(arrays).sidecars


def layout_bytes(layout: Layout) -> int:
    """Return the bytes of one sample of that layout."""
    return sum(np.dtype(dtype).itemsize * math.prod(shape) for dtype, shape in layout.values())


def new_arrays(layout: Layout) -> dict[str, npt.NDArray[Any]]:
    """Allocate arrays for one sample, such as voxels [T, bins, H, W], with unspecified content."""
    return {name: np.empty(shape, dtype) for name, (dtype, shape) in layout.items()}


@dataclass(frozen=True, slots=True)
class Form:
    """Expected form of a sample's arrays.

    Attributes:
        names, dtypes, shapes: as a SampleHeader states them.
        sizes: bytes of each array.
    """

    names: tuple[str, ...]
    dtypes: tuple[str, ...]
    shapes: tuple[int, ...]
    sizes: tuple[int, ...]

    @classmethod
    def of(cls, layout: Layout) -> Form:
        """Return the form of samples whose arrays have these dtypes and shapes (``array_layout``)."""
        return cls(
            names=tuple(layout),
            dtypes=tuple(dtype for dtype, _ in layout.values()),
            shapes=tuple(extent for _, shape in layout.values() for extent in (len(shape), *shape)),
            sizes=tuple(layout_bytes({name: layout[name]}) for name in layout),
        )


@dataclass(frozen=True, slots=True)
class Sample:
    """One simulated clip.

    Attributes:
        arrays: by name, in the shapes of :func:`array_layout`.
        provenance: origin of the sample.
    """

    arrays: Mapping[str, npt.NDArray[Any]]
    provenance: Provenance

    def __repr__(self) -> str:
        shapes = ", ".join(f"{name}: {array.dtype}{list(array.shape)}" for name, array in self.arrays.items())
        return f"Sample({shapes}, {self.provenance.video}@{self.provenance.start_frame})"

    def _repr_html_(self) -> str:
        rows = {name: f"{array.dtype} {list(array.shape)}" for name, array in self.arrays.items()}
        return html_table("Sample", rows) + self.provenance._repr_html_()


def html_table(title: str, rows: Mapping[str, Any]) -> str:
    """Return a heading and one line for each row. Names and values are escaped: file names come from untrusted
    sources.
    """
    lines = "".join(
        f'<tr><th style="text-align:left">{html.escape(str(name))}</th>'
        f'<td style="text-align:left">{html.escape(str(value))}</td></tr>'
        for name, value in rows.items()
    )
    return f"<b>{html.escape(title)}</b><table>{lines}</table>"
