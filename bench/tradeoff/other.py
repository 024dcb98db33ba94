"""The knobs that change something else than the decoded pixels: the grid, the kernel, flow, compression.

Each is a piece of work that is timed beside an exact sample, and a few figures about what it costs in accuracy:

    grid          frame stride (with half the voxel grids, so that a sample spans the same frames) and resize (with half
                  the crop, so that it shows the same scene): noise-free, events summed into common bins. A pixel of the
                  resized picture stands for four, and so do its events
    noise         the sum of 8 bytes for the normal transform, at the recipe's draws: rates and polarity only
    float width   float64 for float32, the same noise
    voxel dtype   int16 and float32 for int8; the row of the exact sample says what int8 clips, hot pixels included
    flow          the methods, with the error on known motions (``bench.accuracy.flow``, 128x128 with margin)
    compression   of a sample's bytes as they would be sent
"""

from __future__ import annotations

import dataclasses
import importlib
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from bench.accuracy import flow, known_motion
from bench.tradeoff.accuracy import THRESHOLDS, Seen, at_threshold, seen
from bench.tradeoff.errors import Tally, common_bins, compare
from bench.tradeoff.noise import cheap_kernel, run_kernel
from bench.tradeoff.speed import Work, leases_of, make, making
from v2v_protocol.sample import DEFAULT_ARRAYS, Sample
from v2v_protocol.spec import FlowMethod, StreamSpec
from v2v_server.catalogue.catalogue import Catalogue
from v2v_server.simulation.clip import simulate, simulate_clip
from v2v_server.simulation.pixel import simulate_pixels
from v2v_server.simulation.view import apply_view

BASE, KERNEL = "exact sample", "kernel"
FLOW_METHODS: tuple[FlowMethod, ...] = ("auto", "dis-fast-1")
_EVERY_PAIR = 5

Compressor = Callable[[bytes], bytes]


@dataclass(frozen=True, slots=True)
class Knob:
    """One of them.

    Attributes:
        work: what is timed.
        beside: the name of the work it replaces; "" where it comes on top of a sample.
        errors: by contrast threshold, where that applies.
        figures: others, flat, for the record.
    """

    work: Work
    beside: str = BASE
    errors: Mapping[float, Tally] = field(default_factory=dict)
    figures: Mapping[str, Any] = field(default_factory=dict)

    @property
    def quick(self) -> bool:
        """Whether it does not decode, so that many rounds cost little."""
        return self.beside != BASE


def knobs(catalogue: Catalogue, spec: StreamSpec, places: int) -> dict[str, Knob]:
    """All of them, and BASE and KERNEL themselves, by name.

    Args:
        catalogue: the source.
        spec: the exact one.
        places: how many to time and to compare.
    """
    root = catalogue.folder
    leases = leases_of(catalogue, spec, places)
    views = [seen(root, lease) for lease in leases]
    samples = [make(lease, lease.indices[:1], root)[0] for lease in leases]
    clipped = {"bins_clipped_share": _clipped_share(samples)}
    made = {
        BASE: Knob(making(root, leases), figures=clipped),
        KERNEL: Knob(_kernel_work(simulate_pixels, views), KERNEL),
    }
    made |= _grid(catalogue, spec, places)
    made |= _noise(views) | _widths(views) | _dtypes(views)
    made |= _flows(catalogue, spec, places)
    return made | _compressions(samples)


def _kernel_work(kernel: Any, views: Sequence[Seen]) -> Work:
    def do(place: int) -> object:
        view = views[place]
        return run_kernel(kernel, view.frames, view.params, view.recipe)

    return Work(do, len(views))


def _grid(catalogue: Catalogue, spec: StreamSpec, places: int) -> dict[str, Knob]:
    recipe = spec.recipe
    still_standing = dataclasses.replace(spec, recipe=recipe.replace(pause_probability=0.0))
    views = [seen(catalogue.folder, lease) for lease in leases_of(catalogue, still_standing, places)]
    strided = recipe.replace(frame_stride=2, voxels_per_clip=recipe.voxels_per_clip // 2)
    half = recipe.replace(
        resize_scale=(0.5, 0.5), crop_height_px=recipe.crop_height_px // 2, crop_width_px=recipe.crop_width_px // 2
    )
    errors = {name: dict.fromkeys(THRESHOLDS, Tally()) for name in ("stride 2", "resize 0.5")}
    for view in views:
        smaller = apply_view(view.frames, dataclasses.replace(view.params, scale=0.5, crop_top_px=0, crop_left_px=0,
                                                              flip=False, contrast=0.0), half)  # fmt: skip
        for threshold in THRESHOLDS:
            run = partial(simulate, threshold_pos=threshold, start_residual=0.0, bins=1, dtype="float32")
            truth = run(view.frames).voxels
            errors["stride 2"][threshold] += compare(common_bins(run(view.frames[::2]).voxels), common_bins(truth, 2))
            resized = 4.0 * common_bins(run(smaller).voxels)
            errors["resize 0.5"][threshold] += compare(resized, common_bins(truth, side_px=2))
    made = {}
    for name, changed in (("stride 2", strided), ("resize 0.5", half)):
        leases = leases_of(catalogue, dataclasses.replace(spec, recipe=changed), places)
        made[name] = Knob(making(catalogue.folder, leases), errors=errors[name])
    return made


def _noise(views: Sequence[Seen]) -> dict[str, Knob]:
    cheap = cheap_kernel()
    errors = dict.fromkeys(THRESHOLDS, Tally())
    for view in views:
        for threshold in THRESHOLDS:
            camera = at_threshold(view.params, threshold)
            errors[threshold] += compare(run_kernel(cheap, view.frames, camera, view.recipe), view.voxels(camera))
    silent = [dataclasses.replace(view, params=dataclasses.replace(view.params, noise_sigma=0.0)) for view in views]
    return {
        "noise: sum of 8 bytes": Knob(_kernel_work(cheap, views), KERNEL, errors, {"only_rates_compare": True}),
        "no noise": Knob(_kernel_work(simulate_pixels, silent), KERNEL),
    }


def _widths(views: Sequence[Seen]) -> dict[str, Knob]:
    def run(view: Seen, threshold: float, precision: str) -> npt.NDArray[Any]:
        shown = view.frames[view.params.source_index(view.recipe.steps)]
        return simulate(
            shown, threshold_pos=threshold, noise_sigma=view.params.noise_sigma, bins=view.recipe.bins,
            frames_per_bin=view.recipe.frames_per_bin, seed=1, dtype="float32", precision=precision,
        ).voxels  # fmt: skip

    errors = dict.fromkeys(THRESHOLDS, Tally())
    for view in views:
        for threshold in THRESHOLDS:
            errors[threshold] += compare(run(view, threshold, "float32"), run(view, threshold, "float64"))
    single, double = (
        Work(lambda place: run(views[place], 0.2, "float32"), len(views)),
        Work(lambda place: run(views[place], 0.2, "float64"), len(views)),
    )
    return {
        "float32 arithmetic": Knob(single, "float64 arithmetic", errors),
        "float64 arithmetic": Knob(double, "float32 arithmetic"),
    }


def _dtypes(views: Sequence[Seen]) -> dict[str, Knob]:
    def work(dtype: str) -> Work:
        def do(place: int) -> object:
            view = views[place]
            return simulate_clip(view.frames, view.params, view.recipe, dtype)

        return Work(do, len(views))

    return {
        f"{dtype} voxels": Knob(work(dtype), f"{other} voxels")
        for dtype, other in (("int8", "float32"), ("int16", "int8"), ("float32", "int8"))
    }


def _clipped_share(samples: Sequence[Sample]) -> float:
    bins = sum(sample.arrays["voxels"].size for sample in samples)
    return sum(sample.provenance.saturated_bins for sample in samples) / bins


def _flows(catalogue: Catalogue, spec: StreamSpec, places: int) -> dict[str, Knob]:
    every = known_motion.scenes(flow.textures(None), flow.HEIGHT_PX, flow.WIDTH_PX, every=_EVERY_PAIR)
    made = {}
    estimators = flow.estimators(FLOW_METHODS, None)
    for name in FLOW_METHODS:
        records = flow.accuracy(name, estimators[name], every)
        error = next(record["error_mean_px"] for record in records if record["context"] == "margin 64")
        leases = leases_of(catalogue, dataclasses.replace(spec, flow_method=name), places, (*DEFAULT_ARRAYS, "flow"))
        made[f"flow {name}"] = Knob(making(catalogue.folder, leases), figures={"endpoint_error_px": error})
    return made


def compressors() -> dict[str, Compressor]:
    """Those of the standard library, and of packages that happen to be installed."""
    found: dict[str, Compressor] = {"zlib 1": partial(zlib.compress, level=1)}
    for name, module, call in (
        ("lz4", "lz4.frame", lambda module: module.compress),
        ("zstd 1", "backports.zstd", lambda module: partial(module.compress, level=1)),
    ):
        try:
            found[name] = call(importlib.import_module(module))
        except ModuleNotFoundError:
            continue
    return found


def _compressions(samples: Sequence[Sample]) -> dict[str, Knob]:
    payloads = [[np.ascontiguousarray(array).tobytes() for array in sample.arrays.values()] for sample in samples]
    total = sum(len(part) for parts in payloads for part in parts)
    made = {}
    for name, compress in compressors().items():
        packed = sum(len(compress(part)) for parts in payloads for part in parts)

        def do(place: int, compress: Compressor = compress) -> None:
            for part in payloads[place]:
                compress(part)

        made[f"compression {name}"] = Knob(Work(do, len(payloads)), "", figures={"size_ratio": packed / total})
    return made
