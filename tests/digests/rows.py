"""The rows of the table: streams, and their first samples made in several ways.

A row pins one preset or field. It is made from the videos, from stores of each size, through a cache that is empty and
full, and by a server that shares samples: all of them have the digests of the table.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from tests.digests.clips import write_clips, write_lossy, write_photographs, write_recordings
from v2v_protocol.sample import LARGEST_EPOCH, LARGEST_SEED, Sample
from v2v_protocol.spec import StreamSpec
from v2v_server.broker.leases import Request
from v2v_server.corpus.catalogue import Catalogue, open_catalogue
from v2v_server.kinds.registry import KINDS, VIDEOS
from v2v_server.prepare import prepare
from v2v_server.schedule import Schedule, SequenceTable
from v2v_server.store.cache import Cache, make_cache
from v2v_server.video.rows import Rows
from v2v_server.worker.job import SampleJob
from v2v_server.worker.making.make import make_sample
from v2v_server.worker.making.read import decode_for, open_sidecars
from v2v_tools.remake import lease_for

ROWS = Rows.parse("0.05:0.95")
SIZE: Mapping[str, Any] = {"voxels_per_clip": 2, "bins": 3, "crop_height_px": 16, "crop_width_px": 20}
_EVENTS = ("voxels", "event_counts", "voxels_bilinear")
_DRAWN = ("video", "start_frame", "saturated_bins", "irregular_timestamps", "left_out", "substeps", "boxes_dropped")
"""Fields of the provenance that the table has, beside the draw. The rest names files, or is printed for people."""


@dataclass(frozen=True, slots=True)
class Row:
    """A stream.

    Attributes:
        recipe: its preset, or fields beside SIZE.
        arrays: those that are pinned.
        spec: fields beside the recipe.
        count: number of samples, from index 0 on.
        seed, epoch: of these samples.
        kind: of the videos.
    """

    recipe: str | Mapping[str, Any] = field(default_factory=dict)
    arrays: tuple[str, ...] = ("voxels", "frames")
    spec: Mapping[str, Any] = field(default_factory=dict)
    count: int = 3
    seed: int = 11
    epoch: int = 0
    kind: str = "videos"

    @property
    def stream(self) -> StreamSpec:
        """Return the spec."""
        recipe = {"preset": self.recipe} if isinstance(self.recipe, str) else self.recipe
        return StreamSpec.from_dict({**self.spec, "recipe": {**SIZE, **recipe}})


STEADY = {"pause_probability": 0.0, "flip_probability": 0.0}
FINE = {"threshold": (0.1, 0.2)}
AUTO = {"scene": "auto"}
_TRUTH = ("flow", "flow_valid", "masks", "tracks")
PORTABLE: Mapping[str, Row] = {
    "paper": Row("paper"),
    "largest seed and epoch": Row("paper", seed=LARGEST_SEED, epoch=LARGEST_EPOCH),
    "paper-fixed-thresholds": Row("paper-fixed-thresholds"),
    "contrast_scale": Row({"contrast_probability": 1.0, "contrast_scale": (0.2, 0.9)}),
    "paper-contrast": Row("paper-contrast", ("voxels", "frames", "frames_u16", "frames_rgb")),
    "paper-flow": Row("paper-flow"),
    "paper-eraft": Row("paper-eraft", ("voxels", "frames", "event_counts", "frames_rgb")),
    "noise-free": Row("noise-free"),
    "clean": Row("clean"),
    "sensor": Row("sensor"),
    "davis346": Row("davis346", (*_EVENTS, "frames")),
    "davis346-running": Row("davis346-running", (*_EVENTS, "frames")),
    "davis346-measured": Row("davis346-measured", (*_EVENTS, "frames")),
    "natural-davis346": Row(spec={"preset": "natural-davis346"}, count=9),
    "balanced": Row(spec={"preset": "balanced", "sibling_spacing": 2}),
    "natural": Row(spec={"preset": "natural"}, count=9),
    "int16": Row(FINE, spec={"voxel_dtype": "int16"}),
    "float32": Row(FINE, spec={"voxel_dtype": "float32"}),
    "in order": Row(spec={"shuffle": False, "max_sequences_per_video": 2}),
    "fixed view": Row(STEADY),
    "pauses": Row({"pause_probability": 0.4, "pause_stay_probability": 0.4, "flip_probability": 1.0}, count=6),
    "frames_per_bin": Row({"frames_per_bin": 2}),
    "frame_stride": Row({"frame_stride": 2}, ("voxels", "frames", "frames_rgb")),
    "gamma and noise": Row({"gamma": 1.7, "noise_scales_with_threshold": True, "hot_pixel_share": 0.05}),
    "noise per second": Row({"noise_unit": "second", "hot_pixel_share": 0.02}),
    "grids_per_frame": Row({"grids_per_frame": 2}, (*_EVENTS, "frames")),
    "voxel_seconds": Row({"voxel_seconds": (0.05, 0.2)}, (*_EVENTS, "frames")),
    "start": Row(FINE | {"start": "triangular"}),
    "start of effects": Row(
        {"preset": "davis346", "start": "triangular", "rate_draw": "log", "shot_noise_hz": (0.1, 5.0)}, _EVENTS
    ),
    "start of frames": Row(
        FINE | {"start": "frames", "frame_stride": 2},
        ("voxels", "frames", "frames_rgb"),
        AUTO | {"substep_px": 0.5},
        count=6,
    ),
    "start of frames with alternating noise": Row(
        {
            "preset": "davis346-measured",
            "start": "frames",
            "shot_noise_hz": 0.0,
            "noise_band_share": (0.08, 0.25),
            "noise_band_hz": (15.0, 60.0),
            "threshold_mismatch_sigma": (0.1, 0.18),
        },
        (*_EVENTS, "frames"),
        count=6,
    ),
    "start of frames of photographs": Row(
        {"preset": "worlds", "start": "frames"}, ("voxels", "frames", *_TRUTH), kind="photographs"
    ),
    "start at zero": Row(FINE | {"start": "zero"}),
    "event_counts": Row(FINE, ("event_counts",)),
    "voxels_bilinear": Row(FINE, ("voxels_bilinear",)),
    "time_surface": Row(FINE, ("time_surface", "voxels")),
    "time_surface of effects": Row("davis346", ("time_surface",), {"voxel_dtype": "float32"}),
    "noise below a corner": Row(
        FINE | {"noise_band_share": (0.15, 0.3), "noise_band_hz": (15.0, 60.0), "refractory_seconds": (1e-4, 1e-3)},
        (*_EVENTS, "time_surface"),
    ),
    "frames_rgb": Row({}, ("frames_rgb",)),
    "frames_u16": Row({}, ("frames_u16",)),
    "frames_all": Row({"pause_probability": 0.2}, ("frames_all",)),
    "boxes": Row({"max_boxes": 2}, ("boxes",), count=6),
    "masks": Row({}, ("masks",), count=6),
    "light": Row({"light": "declared"}, ("voxels", "frames", "frames_u16", "frames_all"), count=6),
    "substep_px": Row(FINE, (*_EVENTS, "frames"), {"substep_px": 0.5}, count=6),
    "substep_px of deep light": Row(FINE | {"light": "declared"}, ("voxels",), {"substep_px": 0.25, **AUTO}, count=6),
    "scene": Row({}, ("voxels", "frames", "frames_rgb", "boxes"), AUTO | {"still_share": 0.5}, count=6),
    "keep_defects": Row({}, spec=AUTO | {"keep_defects": "bars,cuts,duplicates"}, count=6),
    "worlds": Row("worlds", ("voxels", "frames", *_TRUTH), count=6, kind="photographs"),
    "exposure_seconds": Row({"exposure_seconds": (0.2, 0.4)}, ("voxels", "frames", "frames_blurred"), count=6),
    "exposure_seconds of photographs": Row(
        {"preset": "worlds-fine", "exposure_seconds": (0.005, 0.05), "world_speed_px": (200.0, 600.0)},
        ("voxels", "frames_blurred", *_TRUTH),
        count=6,
        kind="photographs",
    ),
    "worlds-fine": Row(
        {"preset": "worlds-fine", "contrast_probability": 0.5},
        ("voxels", "frames_u16"),
        count=6,
        kind="photographs",
    ),
    "worlds with sub-steps": Row(
        FINE
        | {
            "preset": "worlds",
            "world_speed_px": (200.0, 600.0),
            "world_patch_px": (6.0, 16.0),
            "track_points": 8,
            "world_plain_share": 0.4,
            "resize_scale": (0.4, 1.2),
        },
        (*_EVENTS, "frames_all", *_TRUTH),
        {"substep_px": 0.5, "flow_direction": "backward"},
        count=6,
        kind="photographs",
    ),
    "recordings": Row(
        "recordings", (*_EVENTS, "time_surface", "frames", "flow", "flow_valid"), count=6, kind="recordings"
    ),
    "recordings with noise": Row(
        {
            "preset": "recordings",
            "bin_span": "events",
            "added_sigma": (0.1, 0.3),
            "added_hot_share": 0.01,
            "added_hot_sigma": (0.0, 2.0),
            "pause_probability": 0.4,
            "pause_stay_probability": 0.4,
            "grids_per_frame": 2,
            "frame_stride": 2,
        },
        (*_EVENTS, "frames_all"),
        {"voxel_dtype": "float32"},
        count=4,
        kind="recordings",
    ),
    "recordings of a duration": Row(
        {"preset": "recordings", "grids_per_frame": 0, "voxel_seconds": 0.0015, "lead_frames": 1, "lead_voxels": 1},
        (*_EVENTS, "frames"),
        count=2,
        kind="recordings",
    ),
    "quiet_share": Row({}, spec=AUTO | {"quiet_share": 0.3, "moving_share": 1.0, "substep_px": 1.0}, count=6),
}
"""The same bytes on every host: the committed table."""
OF_THIS_HOST: Mapping[str, Row] = {
    "flow": Row("paper-flow", ("flow", "flow_valid", "voxels")),
    "flow_method": Row("paper-flow", ("flow",), {"flow_method": "dis-fast"}),
    "flow backward": Row("paper-flow", ("flow",), {"flow_direction": "backward", "flow_from": 1, "flow_margin_px": 4}),
    "flow of scenes": Row("paper-flow", ("flow", "voxels"), AUTO | {"substep_px": 1.0}, count=6),
    "resize_scale": Row(
        {"resize_scale": (0.7, 1.4)}, ("voxels", "frames", "frames_rgb", "masks"), {"substep_px": 1.0}, count=6
    ),
}
"""OpenCV estimates flow and resizes: compared before and after a change, on one host."""

Arrays = Mapping[str, npt.NDArray[Any]]
Made = tuple[Arrays, list[dict[str, Any]]]
"""The arrays of some samples, one after the other, by name; their draws."""


def made(samples: Sequence[Sample]) -> Made:
    """Return what the table has of samples."""
    arrays = {name: np.stack([sample.arrays[name] for sample in samples]) for name in samples[0].arrays}
    return arrays, [_drawn(sample) for sample in samples]


def digest(array: npt.NDArray[Any]) -> str:
    """Return 32 hexadecimal digits that name an array."""
    form = repr((array.dtype.name, array.shape)).encode()
    return hashlib.sha256(form + np.ascontiguousarray(array).tobytes()).hexdigest()[:32]


def _drawn(sample: Sample) -> dict[str, Any]:
    provenance = sample.provenance
    drawn = {name: getattr(provenance, name) for name in _DRAWN}
    drawn |= {} if provenance.run_in is None else {"run_in": provenance.run_in}
    drawn |= {"saturated": dict(provenance.saturated), "grid_seconds": list(provenance.grid_seconds)}
    drawn |= {"labelled": sorted(set(sample.arrays) & {"boxes", "masks"} - set(provenance.unlabelled))}
    plain: dict[str, Any] = json.loads(json.dumps(drawn | provenance.params.to_dict()))
    return plain


class Ways:
    """The corpora, each in its own folder; a way makes the samples of a row.

    Args:
        folder: an existing folder to write to.
        lossy: add a video in MJPEG.
    """

    def __init__(self, folder: Path, *, lossy: bool = False) -> None:
        self.folder, self.videos = folder, folder / "videos"
        self.videos.mkdir()
        write_clips(self.videos)
        if lossy:
            write_lossy(self.videos / "d.avi")
        write_photographs(folder / "photographs")
        write_recordings(folder / "recordings")
        self._catalogues: dict[str, Catalogue] = {}
        self.all: Mapping[str, Callable[[Row], Made]] = {
            "video": self._plain("videos"),
            "store dense": self._plain("dense"),
            "store fast, its motion computed": self._plain("fast"),
            "store raw": self._plain("raw"),
            "cache, empty and full": self._cached,
        }

    def of(self, row: Row) -> Mapping[str, Callable[[Row], Made]]:
        """Return the ways of a row: all, or the one of a kind that is neither stored nor cached."""
        return self.all if row.kind == VIDEOS.name else {"video": self._plain(row.kind)}

    def close(self) -> None:
        """Close the catalogues."""
        for catalogue in self._catalogues.values():
            catalogue.close()

    def catalogue(self, name: str) -> Catalogue:
        """Return the catalogue of the videos, or of a store of this size, which is written first."""
        if name not in self._catalogues:
            kind = KINDS.get(name, VIDEOS)
            is_video = kind == VIDEOS
            if name not in KINDS:
                self._prepare(name)
            rows = ROWS if name == "videos" else None
            self._catalogues[name] = open_catalogue(
                self.folder / name, rows=rows, cache_dir=self.folder, processes=0, scene=is_video, kind=kind
            )
        return self._catalogues[name]

    def _prepare(self, size: str) -> None:
        planes = ("chroma",) if size == "fast" else ("motion", "chroma")
        store = self.folder / size
        prepare(self.catalogue("videos"), store, size, processes=0, scene=True, planes=planes)
        for sidecar in self.videos.glob("*.boxes.json"):
            shutil.copy(sidecar, store)
        shutil.copytree(self.videos / "a.masks", store / "a.masks", dirs_exist_ok=True)

    def _plain(self, name: str) -> Callable[[Row], Made]:
        def make(row: Row) -> Made:
            samples = samples_of(self.catalogue(name), row)
            if name not in KINDS:
                assert all(sample.provenance.decoder.endswith(", from the store") for sample in samples)
            return made(samples)

        return make

    def _cached(self, row: Row) -> Made:
        """Make the samples twice: the second time each is read from the cache."""
        with tempfile.TemporaryDirectory(dir=self.folder) as folder:
            make_cache(Path(folder))
            first, again = (
                samples_of(self.catalogue("videos"), row, Cache(Path(folder), 1 << 30, least_free_bytes=0))
                for _ in range(2)
            )
        assert all(sample.provenance.decoder.endswith(", from the cache") for sample in again)
        differences = compared(made(first), made(again))
        assert not differences, f"the cache, when it was empty: {differences[0]}"
        return made(again)


def samples_of(catalogue: Catalogue, row: Row, cache: Cache | None = None) -> list[Sample]:
    """Make the samples of a row as a worker does, those of one decode together."""
    spec, samples = row.stream, dict[int, Sample]()
    schedule = Schedule(SequenceTable(catalogue.videos, catalogue.rows, spec), spec)
    views, spacing = spec.samples_per_decode, max(1, spec.sibling_spacing)
    for index in range(row.count):
        if index in samples:
            continue
        siblings = tuple(index + spacing * more for more in range(1, views))
        sequence = schedule.candidate(row.seed, row.epoch, index, 0)
        lease = lease_for(
            Request(b"", row.epoch, index), sequence=sequence, catalogue=catalogue, spec=spec, seed=row.seed,
            arrays=row.arrays, siblings=siblings,
        )  # fmt: skip
        job = SampleJob.of(lease)
        all_decoded = decode_for(job.clip, lease.indices, catalogue.source, cache)
        with open_sidecars(job.clip, catalogue.source) as sidecars:
            for which, decoded in zip(lease.indices, all_decoded, strict=True):
                samples[which] = make_sample(replace(job, index=which), decoded, sidecars=sidecars)
    return [samples[index] for index in range(row.count)]


def compared(expected: Made, found: Made) -> list[str]:
    """Return, for each array and draw that differs, the first difference and both values."""
    differences = []
    for name, array in expected[0].items():
        other = found[0].get(name)
        if other is None or (array.dtype, array.shape) != (other.dtype, other.shape):
            was = "missing" if other is None else f"{other.dtype}{list(other.shape)}"
            differences.append(f"{name} is {was}, not {array.dtype}{list(array.shape)}")
        elif array.tobytes() != other.tobytes():
            at = tuple(int(each[0]) for each in np.nonzero(array != other))
            many = int(np.count_nonzero(array != other))
            differences.append(f"{name}{list(at)} is {other[at]}, not {array[at]} ({many} of {array.size} differ)")
    differences += [f"{name} is not in the table" for name in found[0].keys() - expected[0].keys()]
    for number, (draw, now) in enumerate(zip(expected[1], found[1], strict=True)):
        for key in sorted(draw.keys() | now.keys()):
            if draw.get(key) != now.get(key):
                differences.append(f"{key} of sample {number} is {now.get(key)}, not {draw.get(key)}")
                break
    return differences
