"""Simulators of event cameras beside the product's own, as functions over recordings, and how alike two recordings are.

The equations of the paper and of ESIM are simulated event by event in float64. A peer is the published package of its
authors: its source has to be importable. It runs on the processor, and its clock starts at the first frame.
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable
from functools import partial
from importlib import import_module
from importlib.util import find_spec, module_from_spec
from itertools import pairwise
from types import ModuleType
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from tests.oracles.cameras import FRAMES_PER_SECOND
from tests.oracles.dense import dense_events
from v2v_protocol.recipe import Recipe
from v2v_protocol.spec_flags import recipe_setting
from v2v_recordings.items import Light
from v2v_server.simulation.draw import draw
from v2v_server.simulation.effects import NOISE
from v2v_tools.fit.increments import BRIGHTEST_GREY, intervals_us
from v2v_tools.fit.interval import SIDE, Doubles, Estimate, bootstrap, sums_by_block, unknown
from v2v_tools.fit.recording import Recorded, recorded
from v2v_tools.fit.regression import summit
from v2v_tools.fit.statistics import INTERVAL_EDGES_US, simulate_recording

OFFSETS_US = np.arange(-15_000, 15_001, 1000)
_WIDEST_OFFSET_SECONDS = 0.004
_MOST_STEPS, _MOST_COUNT, _DARK = 32, 5, 0.03
ROWS = 16
"""Peers get the pixels as pictures of this height: the number of pixels is a multiple of it."""
_STILL_PX, _STILL_GREYS = 9, 2
GAPS = len(INTERVAL_EDGES_US) - 1
SUMS = 4 * 6 + 4 + 3 + 2 * GAPS
"""Six sums for each of four pairs of maps: pixels, both sums, both sums of squares, products. Then pixels of which the
sensor's activity is missed, that it has active, whose activity is invented, that the simulation has active. Then the
seconds of pixels whose frames are still, and their events, simulated and recorded. Then intervals between events by
their length, simulated and recorded.
"""
SIMULATED, RECORDED = [7, 13], [8, 14]
"""Sums of the darker and of the brighter events, simulated and recorded."""
FIGURES = (
    "correlation", "darker", "brighter", "mirrored", "log_ratio", "ratio", "intervals", "missed", "invented",
    "still_hz", "sensor_still_hz",
)  # fmt: skip
"""Correlations of signed, darker and brighter events, and of signed events with the sensor's mirrored; |log ratio| of
the numbers of events, its sign kept; distance of the distributions of intervals; shares of active pixels; events a
second of a pixel whose frames are still, simulated and recorded.
"""
Simulator = Callable[[Recorded, float, int], Recorded]
"""From a recording, a threshold (0: the camera's own) and a seed to its simulation."""


def drawn(recipe: Recipe, seed: int) -> dict[str, float]:
    """Draw a camera; noise and drift of a frame are converted to those of a second."""
    made = draw(recipe, seed=seed, epoch=0, index=0, picture_height_px=512, picture_width_px=512, video_id="")
    hz = float(FRAMES_PER_SECOND) if recipe.noise_unit == "frame" else 1.0
    return {
        "threshold_pos": made.threshold_pos, "threshold_neg": made.threshold_neg, **made.effects,
        "log_eps": recipe.log_eps[0] if made.log_eps is None else made.log_eps,
        "noise_sigma": made.noise_sigma * hz**0.5, "hot_pixel_sigma": made.hot_pixel_sigma * hz,
        "hot_pixel_share": made.hot_pixel_count / (recipe.crop_height_px * recipe.crop_width_px),
    }  # fmt: skip


def part_of(recording: Recorded, chosen: npt.NDArray[np.bool_]) -> Recorded:
    """Return the recording of some of the pixels, chosen by a mask [P]."""
    lengths = np.diff(recording.first)
    events, frames = np.repeat(chosen, lengths), np.ascontiguousarray(recording.frames[:, chosen])
    return dataclasses.replace(
        recording, pixels=recording.pixels[chosen], first=np.concatenate([[0], np.cumsum(lengths[chosen])]),
        t_us=recording.t_us[events], p=recording.p[events], frames=frames,
    )  # fmt: skip


def of_recipe(name: str, *, noisy: bool = True) -> Simulator:
    """Return the product's own simulation of a recipe, or of a recipe without its noise."""
    recipe = recipe_setting(name, [])
    if not noisy:
        quiet = ("noise_sigma", "hot_pixel_share", *NOISE)
        recipe = recipe.replace(**dict.fromkeys(quiet, (0.0, 0.0)))

    def simulated(given: Recorded, threshold: float, seed: int) -> Recorded:
        mine = recipe.replace(threshold=(threshold,) * 2, threshold_ratio=(1.0, 1.0)) if threshold else recipe
        return simulate_recording(given, drawn(mine, seed), seed, mine.start)

    return simulated


def equations(given: Recorded, threshold: float, seed: int) -> Recorded:
    """Simulate the paper's equations: no noise, residuals uniform, events linear in time between frames."""
    random = np.random.default_rng(seed)
    own = random.uniform(0.05, 2.0) * np.array([1.0, random.uniform(1.0, 1.5)])[:: random.choice((-1, 1))]
    positive, negative = (threshold, threshold) if threshold else own
    levels = np.log(1e-3 + given.known_light.of(given.frames))
    start = np.asarray(random.uniform(-negative, positive, levels.shape[1]))
    events = dense_events(levels, given.frame_us.astype(np.float64), start, positive, negative)
    return of_events(given, events.seconds, events.pixel, events.polarity > 0)


def esim(given: Recorded, threshold: float, seed: int) -> Recorded:
    """Simulate ESIM's equations with its authors' defaults: no noise, and a pixel starts as if it had just fired."""
    positive = negative = threshold or 0.2
    levels = np.log(1e-3 + given.known_light.of(given.frames))
    events = dense_events(levels, given.frame_us.astype(np.float64), np.zeros(levels.shape[1]), positive, negative)
    return of_events(given, events.seconds, events.pixel, events.polarity > 0)


def v2e(given: Recorded, threshold: float, seed: int, params: str = "") -> Recorded:
    """Simulate with v2e's EventEmulator; without a threshold its defaults, or the named set of its parameters."""
    emulator_class: Any = import_module("v2ecore.emulator").EventEmulator
    asked: dict[str, Any] = {"pos_thres": threshold, "neg_thres": threshold} if threshold else {}
    emulator, found = emulator_class(seed=seed + 1, output_folder=None, device="cpu", **asked), []
    if params:
        emulator.set_dvs_params(params)
        for name, value in asked.items():
            setattr(emulator, name, value)
    for light, us in zip(given.known_light.of(given.frames), _since_first(given), strict=True):
        made = emulator.generate_events(255.0 * light.reshape(ROWS, -1), us * 1e-6)
        found += [] if made is None else [np.asarray(made, np.float64)]
    t, x, y, p = np.concatenate(found).T if found else np.empty((4, 0))
    # The last events of a step have the time of its frame, with which the next step begins here.
    us = given.frame_us[0] + np.maximum(1e6 * t - 1, 0)
    return of_events(given, us, y * (len(given.pixels) // ROWS) + x, p > 0)


def openeb(given: Recorded, threshold: float, seed: int) -> Recorded:
    """Simulate with OpenEB's EventSimulator, which takes grey levels as light; without a threshold those of its
    sample.
    """
    width, positive = len(given.pixels) // ROWS, threshold or 0.11
    simulator_class: Any = _openeb_module().EventSimulator
    made = simulator_class(ROWS, width, positive, threshold or 0.1, 1)
    for light, us in zip(given.known_light.of(given.frames), _since_first(given), strict=True):
        made.image_callback(np.rint(255 * light.reshape(ROWS, width)).astype(np.uint8), int(us))
    events = made.get_events()
    return of_events(given, given.frame_us[0] + events["t"], events["y"] * width + events["x"], events["p"] > 0)


def _openeb_module() -> Any:
    """Import OpenEB's simulator without its compiled library, of which it takes the type of an event alone."""
    package, library = "metavision_core_ml.video_to_event", "metavision_sdk_base"
    found = find_spec(package)
    if package not in sys.modules and found is not None:
        sys.modules[package] = module_from_spec(found)  # not executed: its __init__ imports compiled libraries
    if library not in sys.modules and find_spec(library) is None:
        stand_in: Any = ModuleType(library)
        stand_in.EventCD = np.dtype(
            {"names": ["x", "y", "p", "t"], "formats": ["<u2", "<u2", "<i2", "<i8"], "offsets": [0, 2, 4, 8]}
        )
        sys.modules[library] = stand_in
    return import_module(f"{package}.simulator")


def eventcv(given: Recorded, threshold: float, seed: int) -> Recorded:
    """Simulate with eventcv, which takes frames as sRGB and at one rate."""
    curve, width = Light.parse("srgb").of(np.linspace(0.0, 255.0, 4096)), len(given.pixels) // ROWS
    coded = np.interp(given.known_light.of(given.frames), curve, np.linspace(0.0, 1.0, 4096)).astype(np.float32)
    asked = {"pos_thres": threshold, "neg_thres": threshold} if threshold else {}
    step_us = float(np.diff(given.frame_us).mean())
    frames, simulate = coded.reshape(-1, ROWS, width), import_module("eventcv").simulate
    made: Any = simulate(frames, fps=1e6 / step_us, seed=seed, **asked)
    x, y, t, p = made.numpy().astype(np.int64).T
    us = np.interp(t, step_us * np.arange(len(frames)), given.frame_us)
    return of_events(given, us, y * width + x, p > 0)


def v2v(given: Recorded, threshold: float, seed: int) -> Recorded:
    """Simulate with the code that the paper's authors released, which takes frames as gamma 2.2.

    Cameras are drawn as its data set draws them. It counts events without times: they are spread evenly over a step.
    """
    emulator_class: Any = import_module("data.v2v_core_esim").EventEmulator
    np.random.seed(seed)
    random = np.random.default_rng(seed)
    own = random.uniform(0.05, 2.0) * np.array([1.0, random.uniform(1.0, 1.5)])[:: random.choice((-1, 1))]
    positive, negative = (threshold, threshold) if threshold else own
    noise, hot_share, hot_sigma = random.uniform(0.0, [0.2, 0.001, 0.2])
    video = 255.0 * given.known_light.of(given.frames).reshape(len(given.frames), ROWS, -1) ** (1 / 2.2)
    made = emulator_class(positive, negative, noise, hot_share, hot_sigma).video_to_voxel(video)
    counts = np.rint(made).astype(np.int64).reshape(len(made), -1)
    step, pixel = np.nonzero(counts)
    size = np.abs(counts[step, pixel])
    first = np.repeat(np.cumsum(size) - size, size)
    share = (np.arange(len(first)) - first + 0.5) / np.repeat(size, size)
    at = np.repeat(step, size)
    us = given.frame_us[at] + share * np.diff(given.frame_us)[at]
    return of_events(given, us, np.repeat(pixel, size), np.repeat(counts[step, pixel] > 0, size))


def _since_first(given: Recorded) -> npt.NDArray[np.int64]:
    """Return the times of the frames from the first one on, us: [n]. Some peers refuse times before 0."""
    return np.asarray(given.frame_us - given.frame_us[0])


PEERS: dict[str, Simulator] = {
    "v2e": v2e, "v2e-noisy": partial(v2e, params="noisy"), "openeb": openeb, "eventcv": eventcv, "v2v": v2v
}  # fmt: skip


def of_events(given: Recorded, t_us: Any, pixel: Any, p: Any) -> Recorded:
    """Return a recording with other events, of pixels by their number among those kept."""
    t_us, place = np.asarray(t_us).astype(np.int64), given.pixels[np.asarray(pixel).astype(np.int64)]
    if not len(t_us):
        return dataclasses.replace(given, first=0 * given.first, t_us=given.t_us[:0], p=given.p[:0])
    size = given.height_px, given.width_px
    return recorded(*size, t_us, place, p, given.frames, given.frame_us, pixels=given.pixels, light=given.light)


def counts_of(given: Recorded) -> Doubles:
    """Return the darker and brighter events of each step: [2, steps, pixels]."""
    owner = np.repeat(np.arange(len(given.pixels)), np.diff(given.first))
    steps, pixels = len(given.frames) - 1, len(given.pixels)
    step = np.searchsorted(given.frame_us, given.t_us, side="right") - 1
    inside = (step >= 0) & (step < steps)
    at = (given.p[inside] * steps + step[inside]) * pixels + owner[inside]
    return np.bincount(at, minlength=2 * steps * pixels).reshape(2, steps, pixels).astype(np.float64)


def correlation(one: Doubles, other: Doubles) -> float:
    """Return the correlation of two maps; 0 where one is constant."""
    return float(np.corrcoef(one, other)[0, 1]) if one.std() and other.std() else 0.0


def is_unchanged(given: Recorded) -> npt.NDArray[np.bool_]:
    """Return in which steps no pixel around one changes by more than the noise of frames: [steps, pixels].

    Frames alone decide: what chose pixels by their events would find quiet ones.
    """
    around, found = np.ones((_STILL_PX, _STILL_PX), np.uint8), []
    change = np.full((given.height_px, given.width_px), 255, np.uint8)  # of pixels that are not kept
    for before, after in pairwise(given.frames.astype(np.int16)):
        change.flat[given.pixels] = np.abs(after - before)
        found.append(cv2.dilate(change, around).flat[given.pixels] <= _STILL_GREYS)
    return np.stack(found)


def tallied(given: Recorded, true: Doubles, made: Recorded) -> Doubles:
    """Return the sums that figures rest on, by block of the sensor and step: [SIDE**2, steps, :data:`SUMS`].

    Args:
        true: :func:`counts_of` the recording.
    """
    found, blocks = counts_of(made), given.blocks()
    row, column = np.divmod(given.pixels, given.width_px)
    place = row * given.width_px + given.width_px - 1 - column
    mirror = np.minimum(np.searchsorted(given.pixels, place), len(place) - 1)
    kept = given.pixels[mirror] == place
    signed, real = found[1] - found[0], true[1] - true[0]
    pairs = ((signed, real), (found[0], true[0]), (found[1], true[1]), (signed[:, mirror] * kept, real * kept))
    columns = [
        part for number, (one, other) in enumerate(pairs)
        for part in (kept + 0.0 * one if number == 3 else np.ones_like(one), one, other, one**2, other**2, one * other)
    ]  # fmt: skip
    active, seen_active = found.sum(axis=0) > 0, true.sum(axis=0) > 0
    columns += [seen_active & ~active, seen_active, active & ~seen_active, active]
    still = is_unchanged(given)
    seconds = 1e-6 * np.diff(given.frame_us)[:, None]
    columns += [still * each for each in (seconds, found.sum(axis=0), true.sum(axis=0))]
    table = np.stack(columns, axis=2).astype(np.float64)
    gaps = np.concatenate([_gaps_of(each, blocks, len(real)) for each in (made, given)], axis=2)
    return np.concatenate([np.stack([sums_by_block(blocks, step) for step in table], axis=1), gaps], axis=2)


def _gaps_of(given: Recorded, blocks: npt.NDArray[np.int64], steps: int) -> Doubles:
    """Return how many intervals end in each step, by their length: [SIDE**2, steps, GAPS]."""
    owner = np.repeat(np.arange(len(given.pixels)), np.diff(given.first))
    ends = np.flatnonzero(np.diff(owner) == 0) + 1
    step = np.searchsorted(given.frame_us, given.t_us[ends], side="right") - 1
    length = np.searchsorted(INTERVAL_EDGES_US, intervals_us(given)[0], side="right") - 1
    inside = (step >= 0) & (step < steps)
    place = ((blocks[owner[ends]] * steps + step) * GAPS + length)[inside]
    return np.bincount(place, minlength=SIDE**2 * steps * GAPS).reshape(SIDE**2, steps, GAPS).astype(np.float64)


def figures(sums: Doubles) -> Doubles:
    """Return the figures of one simulation from its sums: [..., SUMS] to [..., FIGURES], in the order of FIGURES."""
    count, one, other, ones, others, both = np.moveaxis(sums[..., :24].reshape(*sums.shape[:-1], 4, 6), -1, 0)
    spread = (count * ones - one**2) * (count * others - other**2)
    alike = np.where(spread > 1e-9, (count * both - one * other) / np.sqrt(np.maximum(spread, 1e-9)), 0.0)
    missed, seen, invented, active = np.moveaxis(sums[..., 24:28], -1, 0)
    ratio = np.log((one[..., 1] + one[..., 2] + 0.5) / (other[..., 1] + other[..., 2] + 0.5))
    seconds, made_still, seen_still = np.moveaxis(sums[..., 28:31], -1, 0)
    gaps = sums[..., 31:].reshape(*sums.shape[:-1], 2, GAPS)
    shares = gaps / np.maximum(gaps.sum(axis=-1, keepdims=True), 1.0)
    apart = np.abs(shares[..., 0, :] - shares[..., 1, :]).sum(axis=-1) / 2
    rest = (
        np.abs(ratio), ratio, apart, missed / np.maximum(seen, 1.0), invented / np.maximum(active, 1.0),
        *(events / np.maximum(seconds, 1e-9) for events in (made_still, seen_still)),
    )  # fmt: skip
    return np.concatenate([alike, np.stack(rest, axis=-1)], axis=-1)


def within(given: Recorded) -> Recorded:
    """Return a recording with the events between its first and last frame."""
    inside = (given.t_us >= given.frame_us[0]) & (given.t_us < given.frame_us[-1])
    first = np.concatenate([[0], np.cumsum(inside)])[given.first]
    return dataclasses.replace(given, first=first, t_us=given.t_us[inside], p=given.p[inside])


def frame_offset(recording: Recorded) -> Estimate:
    """Estimate how much later than its time a frame was seen, s: where the correlation of changes of log intensity with
    signed events is largest. Clipped levels are left out, and counts limited: lamps that flicker have many events, and
    no frame shows them.
    """
    t, frame_us, reach = recording.t_us, recording.frame_us, OFFSETS_US[-1]
    steps = np.flatnonzero((frame_us[:-1] - reach >= t.min()) & (frame_us[1:] + reach <= t.max()))
    if not len(steps):
        return unknown(f"no two frames have events for {reach / 1000:g} ms before and after them")
    steps = steps[:: -(-len(steps) // _MOST_STEPS)]
    owner, blocks = np.repeat(np.arange(len(recording.pixels)), np.diff(recording.first)), recording.blocks()
    level = np.log(_DARK + recording.known_light.of(np.arange(256.0)))
    sums = np.zeros((64, len(OFFSETS_US), 2))
    for step in steps:
        before, after = recording.frames[step : step + 2]
        seen = np.maximum(before, after) <= BRIGHTEST_GREY
        change = np.where(seen, level[after] - level[before], 0.0)
        near = (t >= frame_us[step] - reach) & (t < frame_us[step + 1] + reach)
        at, pixel, sign = t[near], owner[near], np.where(recording.p[near], 1.0, -1.0)
        for number, offset in enumerate(OFFSETS_US):
            inside = (at >= frame_us[step] + offset) & (at < frame_us[step + 1] + offset)
            count = np.bincount(pixel[inside], sign[inside], len(change))
            count = np.clip(count, -_MOST_COUNT, _MOST_COUNT) * seen
            sums[:, number] += sums_by_block(blocks, np.stack([change * count, count**2], axis=1))
    seconds = np.asarray(OFFSETS_US * 1e-6, np.float64)
    value, low, high = bootstrap(
        sums, lambda s: np.array([summit(seconds, s[:, 0] / np.sqrt(np.maximum(s[:, 1], 1e-9)))])
    )
    note = f"{len(steps)} steps between frames"
    if high[0] - low[0] > _WIDEST_OFFSET_SECONDS or abs(value[0]) > seconds[-3]:
        return unknown(f"the events fit no offset much better than others, by {note}")
    return Estimate(float(value[0]), float(low[0]), float(high[0]), 0.0, note)
