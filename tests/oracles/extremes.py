"""Extremes of the simulation: one check for each edge of what a recipe may ask for.

A check measures one figure and states its bound, which follows from the arithmetic
(``v2v_server/simulation/precision.py``) or from counting, never from a fit. Most are the balance of ``balance.py``:
every event accounted for. A "refused" row passes only if the stated error of ``v2v_protocol.errors`` is raised and
names the number and the limit.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from tests.oracles import extremes_in_time as in_time
from tests.oracles.balance import Camera, balance, imbalance, trace_of
from tests.oracles.dense import trace
from tests.oracles.noise import error_bound, mix, standard_normals, words
from v2v_protocol.errors import RecipeError, UsageError
from v2v_protocol.recipe import Recipe, most_events, preset
from v2v_protocol.spec import StreamSpec
from v2v_server.simulation import noise, simulate, simulate_log
from v2v_server.simulation.draw import draw, noise_key_of_seed
from v2v_server.simulation.intensity import log_table, log_table_float64
from v2v_server.simulation.precision import LIMITS
from v2v_server.simulation.voxel import rounding_tolerance
from v2v_server.video.picture import SDR, Signal

Frames = npt.NDArray[Any]
HEIGHT_PX, WIDTH_PX, STEPS = 6, 8, 60
LONG_STEPS = 999_999
LARGEST_Z = 5.0
"""Bound of a correlation, in standard errors: 26 of them reach it by chance once in 67,000 runs."""


@dataclass(frozen=True)
class Finding:
    """The result of a check. It passes where ``measured <= bound``.

    Attributes:
        measured, bound: in the row's own quantity.
        precision: arithmetic that was used, "" where there is no single one.
        note: what else is worth knowing.
    """

    measured: float
    bound: float
    precision: str = ""
    note: str = ""


@dataclass(frozen=True)
class Row:
    """One edge.

    Attributes:
        name: what is asked for.
        expected: "counted" or "refused".
        quantity: what is measured, with its unit.
        check: measures it.
        slow: True for rows of more than a few seconds or of large memory.
    """

    name: str
    expected: str
    quantity: str
    check: Callable[[], Finding]
    slow: bool = False


def record_of(row: Row) -> dict[str, Any]:
    """Run a row's check; return its flat record."""
    found = row.check()
    return {
        "row": row.name, "expected": row.expected, "quantity": row.quantity, "measured": float(found.measured),
        "bound": float(found.bound), "precision": found.precision, "note": found.note,
        "passed": bool(found.measured <= found.bound),
    }  # fmt: skip


def texture(steps: int = STEPS, height: int = HEIGHT_PX, width: int = WIDTH_PX, signal: Signal = SDR) -> Frames:
    """Return uncorrelated grey levels: every pixel jumps at every step."""
    shape = (steps + 1, height, width)
    return np.random.default_rng(1).integers(0, signal.white + 1, shape, signal.dtype.type)


def flicker(steps: int = STEPS, signal: Signal = SDR) -> Frames:
    """Return frames that are black and white in turns."""
    frames = np.zeros((steps + 1, HEIGHT_PX, WIDTH_PX), signal.dtype)
    frames[1::2] = signal.white
    return frames


def staircase() -> Frames:
    """Return all grey levels, one by one, up and down again."""
    levels = np.concatenate([np.arange(256), np.arange(254, -1, -1)]).astype(np.uint8)
    return np.broadcast_to(levels[:, None, None], (len(levels), HEIGHT_PX, WIDTH_PX))


def balanced(camera: Camera, frames: npt.NDArray[Any]) -> Finding:
    """Return the balance of a clip; infinite where the kernel's counts are not those of the trace.

    The bound is never above half the smaller threshold: where the arithmetic allows more, it was the wrong one.
    """
    found = balance(camera, frames)
    measured = max(found.error, found.beyond) if found.differing == 0 else math.inf
    note = f"{found.fired:.4g} events" if found.differing == 0 else f"{found.differing} bins differ from the trace"
    bound = min(found.bound, camera.threshold_pos / 2, camera.threshold_neg / 2)
    return Finding(measured, bound, found.real.__name__, note)


def refused(error: type[UsageError], *calls: tuple[Callable[[], object], Sequence[str]]) -> Finding:
    """Count the calls that do not raise exactly that error with all words in its message; other errors pass through."""
    wrong = []
    for number, (call, texts) in enumerate(calls):
        try:
            call()
        except error as refusal:
            if type(refusal) is error and all(word in str(refusal) for word in texts):
                continue
            wrong.append(f"{number}: {refusal}")
        else:
            wrong.append(f"{number}: not refused")
    return Finding(len(wrong), 0.0, note="; ".join(wrong) or f"{error.__name__}, {len(calls)} calls")


def still(level: int) -> Finding:
    """Count the events of a still scene after its first step."""
    frames = np.full((STEPS + 1, HEIGHT_PX, WIDTH_PX), level, np.uint8)
    voxels = simulate(frames, threshold_pos=0.05, threshold_neg=0.06, bins=STEPS).voxels[0]
    accounted = balanced(Camera(0.05, 0.06), frames)
    return Finding(float(np.abs(voxels[1:]).sum()) + (accounted.measured > accounted.bound), 0.0, accounted.precision)


def exact_multiples() -> Finding:
    """Count the ramps of k thresholds, from everywhere between black and white, that do not give k events."""
    wrong = tried = 0
    cases = [(0.1, 20, 10)]  # 2.0 log units at 0.1
    cases += [(c, k, steps) for c in (0.05, 0.1, 1 / 3, 0.7, 2.0) for k in (1, 3, 100) for steps in (5, 40, 200)]
    for threshold, count, steps in cases:
        threshold = float(np.float32(threshold))
        height = threshold * count
        if height < 6.9:
            offsets = np.linspace(-6.9, -height, 200)
            ramp = offsets + height * np.arange(steps + 1)[:, None] / steps
            got = simulate_log(ramp[:, None], threshold_pos=threshold, start_residual=0.0, bins=steps, dtype="float32")
            wrong += int(np.count_nonzero(got.voxels.sum(axis=(0, 1)) != count))
            tried += offsets.size
    return Finding(wrong, 0.0, "float32", f"{tried} ramps")


def one_grey_level() -> Finding:
    """Check the staircase: balance, and as many events up as the whole height holds."""
    camera = Camera(0.05, 0.05)
    accounted = balanced(camera, staircase())
    up = simulate(staircase()[:256], threshold_pos=0.05, start_residual=0.0, bins=255, dtype="int16").voxels.sum((0, 1))
    table = log_table_float64(camera.gamma, camera.log_eps)
    expected = math.floor((table[-1] - table[0]) / 0.05)
    return (
        accounted if (up == expected).all() else Finding(math.inf, accounted.bound, note=f"{up.ravel()[0]} events up")
    )


def large_frames() -> Finding:
    """Count wrong pixels of a noisy step of 8192 x 4320, among every 101st and the last 4096."""
    height, width, camera = 4320, 8192, Camera(0.2, 0.25, 0.1)
    pixels, key = height * width, noise_key_of_seed(camera.seed)
    first = (np.arange(pixels, dtype=np.uint32) * np.uint32(2654435761) >> np.uint32(24)).astype(np.uint8)
    frames = np.stack([first, first[::-1]])
    got = simulate(
        frames.reshape(2, height, width), threshold_pos=camera.threshold_pos, threshold_neg=camera.threshold_neg,
        noise_sigma=camera.noise_sigma, bins=1, seed=camera.seed,
    ).voxels.ravel()  # fmt: skip
    place = np.union1d(np.arange(0, pixels, 101), np.arange(pixels - 4096, pixels))
    radius, angle, begin = (words(key, use, place) for use in (noise.PIXEL_RADIUS, noise.PIXEL_ANGLE, noise.START))
    pair = [words(key, use, 0) for use in (noise.PAIR_RADIUS, noise.PAIR_ANGLE)]
    normal, _ = noise.box_muller(*mix(radius ^ pair[0], angle ^ pair[1]))
    level = log_table(camera.gamma, camera.log_eps)[frames[:, place]]
    positive, negative = np.float32(camera.threshold_pos), np.float32(camera.threshold_neg)
    start = (begin >> np.uint32(8)).astype(np.float32) * np.float32(2.0**-24) * (positive + negative) - negative
    noisy, no_drift = normal[None] * np.float32(camera.noise_sigma), np.zeros(place.size)
    tolerance = rounding_tolerance(camera.threshold_pos, camera.threshold_neg)
    expected = trace(level, noisy, no_drift, start, positive, negative, tolerance).counts[0]
    return Finding(int(np.count_nonzero(got[place] != expected)), 0.0, "float32", f"{place.size} of {pixels} pixels")


def million_frames(real_name: str) -> Finding:
    """Measure the drift of a residual over 10^6 frames of a scene with period three: rounding does not cancel."""
    levels = np.array([[10, 0, 255, 30], [90, 255, 3, 31], [200, 128, 77, 33]], np.uint8)
    frames = levels[np.arange(LONG_STEPS + 1) % 3][:, None]
    camera = Camera(0.05, 0.06)
    if real_name == "float64":
        return balanced(camera, frames)
    found = imbalance(camera, frames, trace_of(camera, frames, np.float32))
    table = log_table_float64(camera.gamma, camera.log_eps)
    events = most_events(LONG_STEPS, (float(table[0]), float(table[-1])), (0.05, 0.06), 0.0)
    call = (
        lambda: simulate(frames, threshold_pos=0.05, bins=LONG_STEPS, precision="float32"),
        ["float32", "1.049e+06"],
    )
    turned_away = refused(UsageError, call)
    note = f"{found / 0.05:.2g} thresholds; asked for by name it is refused"
    return Finding(
        found if turned_away.measured == 0 else math.inf, error_bound(np.float32, events, 0.05), "float32", note
    )


def not_numbers() -> Finding:
    """Check every numeric argument, NaN or infinite."""
    frames = texture(5)
    names = ("threshold_pos", "threshold_neg", "noise_sigma", "hot_pixel_sigma", "gamma", "log_eps", "start_residual")
    calls: list[tuple[Callable[[], object], Sequence[str]]] = []
    for value in (math.nan, math.inf, -math.inf):
        for name in names:
            arguments: dict[str, Any] = {"threshold_pos": 0.2, name: value}
            calls.append((partial(simulate, frames, **arguments), (name, repr(value))))
        level = np.zeros((6, 1, 1))
        level[3] = value
        calls.append((partial(simulate_log, level, threshold_pos=0.2), ("log_frames",)))
    return refused(UsageError, *calls)


def not_numbers_in_a_recipe() -> Finding:
    """Check every real field of a recipe, NaN or infinite."""
    fields = [name for name, value in Recipe().to_dict().items() if isinstance(value, float | list)]
    calls: list[tuple[Callable[[], object], Sequence[str]]] = []
    for name, value in itertools.product(fields, (math.nan, math.inf, -math.inf)):
        settings: dict[str, Any] = {name: value}
        calls.append((partial(Recipe, **settings), (name, repr(value))))
    return refused(RecipeError, *calls)


def not_numbers_of_motion() -> Finding:
    """Check substep_px: NaN, infinite, negative. Motion itself is whole numbers."""
    values = (math.nan, math.inf, -1.0)
    return refused(UsageError, *((partial(StreamSpec, substep_px=value), ("substep_px",)) for value in values))


def denormals() -> Finding:
    """Check log intensities that differ by denormal numbers, under noise of denormal strength."""
    tiny = np.arange(STEPS + 1)[:, None, None] * np.array([[5e-324, 1e-45, 1e-39, 2e-38]])
    return balanced(Camera(0.05, 0.06, noise_sigma=1e-310, hot_pixel_count=2, hot_pixel_sigma=1e-40), tiny)


def dtype_limits(precision: str, **limits: float) -> Finding:
    """Count bins that are neither exact nor clipped to the limit of their type and counted."""
    wrong, contrast = 0, float(np.ptp(log_table_float64(2.2, 1e-3)))
    frames = np.array([0, 255, 0, 255, 0], np.uint8)[:, None, None]
    largest = 65536.5 if precision == "float32" else 1e6 + 0.5
    for dtype, limit in limits.items():
        for height in (0.5, 126.5, 127.5, 128.5, 255.5, 256.5, 32766.5, 32767.5, 32768.5, largest):
            threshold = contrast / height
            # A quarter of a threshold is left above each whole number of them, up and down.
            got = simulate(
                frames, threshold_pos=threshold, bins=4, start_residual=-threshold / 4, dtype=dtype, precision=precision
            )
            whole = math.floor(height)
            expected = np.clip([whole, -whole, whole, -whole], -limit, limit)
            wrong += int((got.voxels.ravel() != expected).sum()) + (got.saturated_bins != 4 * (whole > limit))
    return Finding(wrong, 0.0, precision)


def seeds() -> Finding:
    """Check the ends of the seed's range: both work, differ, and repeat; beyond them is refused."""
    frames = texture(5)
    make = [simulate(frames, threshold_pos=0.2, noise_sigma=0.5, seed=s).voxels for s in (0, 2**64 - 1, 0, 2**64 - 1)]
    wrong = int((make[0] == make[1]).all()) + int((make[0] != make[2]).any()) + int((make[1] != make[3]).any())
    low, high = (partial(simulate, frames, threshold_pos=0.2, seed=seed) for seed in (-1, 2**64))
    turned_away = refused(UsageError, (low, ("-1", str(2**64 - 1))), (high, (str(2**64), str(2**64 - 1))))
    return Finding(wrong + turned_away.measured, 0.0)


def noise_correlation() -> Finding:
    """Measure the largest correlation of the noise with itself: next pixels, frames, samples, epochs and seeds."""
    steps, pixels = 40, 25_000
    recipe = preset("paper")

    def normals(seed: int, epoch: int, index: int) -> npt.NDArray[np.float64]:
        params = draw(
            recipe, seed=seed, epoch=epoch, index=index, picture_height_px=180, picture_width_px=320, video_id="v"
        )
        return standard_normals(params.noise_key, steps, pixels).astype(np.float64)

    base = normals(5, 3, 1000)
    pairs = {f"pixel +{lag}": (base[:, lag:], base[:, :-lag]) for lag in (1, 2, 128)}
    pairs |= {f"frame +{lag}": (base[lag:], base[:-lag]) for lag in (1, 2, 3, 5)}
    pairs |= {f"sample {index}": (base, normals(5, 3, index)) for index in (999, 1001)}
    pairs |= {f"epoch {epoch}": (base, normals(5, epoch, 1000)) for epoch in (2, 4)}
    pairs |= {f"seed {seed}": (base, normals(seed, 3, 1000)) for seed in (4, 2**64 - 1)}
    z = {}
    for name, (one, other) in pairs.items():
        z[name] = abs((one * other).mean()) * math.sqrt(one.size)
        # Squares as well: dependence without correlation. The variance of (n^2 - 1) is 2.
        z[f"{name}, squares"] = abs(((one**2 - 1) * (other**2 - 1)).mean()) / 2.0 * math.sqrt(one.size)
    worst = max(z, key=lambda name: z[name])
    return Finding(z[worst], LARGEST_Z, "float32", f"worst of {len(z)}: {worst}")


def beyond_float64() -> Finding:
    """Check cameras that not even float64 can count."""
    frames = texture(5)
    limit = f"{LIMITS['float64'][1]:.4g}"
    return refused(
        UsageError,
        (lambda: simulate(frames, threshold_pos=1e-14), (limit, "events")),
        (lambda: simulate(frames, threshold_pos=1e-6, noise_sigma=1e9), (limit, "events")),
        (lambda: simulate(frames, threshold_pos=1e-6, hot_pixel_count=1, hot_pixel_sigma=1e9), (limit, "events")),
        (lambda: simulate_log(np.array([[[0.0]], [[1e300]]]), threshold_pos=0.1, bins=1), (limit, "events")),
        (lambda: simulate(frames, threshold_pos=1e-40), ("threshold_pos = 1e-40", "7.89e-31")),
        (lambda: simulate(frames, threshold_pos=5e-324), ("threshold_pos = 5e-324", "7.89e-31")),
        (lambda: simulate(frames, threshold_pos=0.1, threshold_neg=1e39), ("threshold_neg = 1e+39", "1.27e+30")),
    )


def recipe_beyond_float64() -> Finding:
    """Check recipes whose worst draw not even float64 can count."""
    limit = f"{LIMITS['float64'][1]:.4g}"
    return refused(
        RecipeError,
        (lambda: Recipe(threshold=(1e-6, 1.0), hot_pixel_sigma=(0.0, 1e9)), (limit, "hot_pixel_sigma 1e+09")),
        (lambda: Recipe(threshold=(1e-6, 1.0), threshold_ratio=(1e-6, 1.0)), (limit, "threshold 1e-12")),
        (
            lambda: Recipe(threshold=(1e-6, 1.0), noise_sigma=(0.0, 1e6), voxels_per_clip=100_000),
            (limit, "500000 steps"),
        ),
    )


def divided_rows() -> list[Row]:
    """Return the rows of steps that are divided into bins and by intermediate levels."""
    asked: dict[str, tuple[Any, ...]] = {
        "64 grids in a step": (0.2, 1.3, 64, 1),
        "1 grid of 1024 bins in a step": (0.2, 1.3, 1, 1024),
        "divided steps, thresholds 1e-6": (1e-6, 1.0, 3, 5),
        "divided steps, thresholds 1e3": (1e3, 1.0, 3, 5),
        "divided steps, c- = 1e4 c+": (1e-4, 1e4, 3, 5),
        "64 levels in a step": (0.2, 1.3, 3, 5, 64),
    }

    def check(setting: tuple[Any, ...]) -> Finding:
        return Finding(*in_time.excess_of_divided_steps(*setting))

    def check_motion(px: float) -> Finding:
        return Finding(*in_time.excess_along_motion(px))

    quantity = "more than a threshold left, log units"
    made = [  # slow: in float64, another compiled kernel
        Row(name, "counted", quantity, partial(check, setting), slow=setting[0] < 1e-3)
        for name, setting in asked.items()
    ]
    for px in (0.0, 500.0, -2048.0):  # the last is the largest that is stored
        name = f"motion of {px:g} px a frame"
        made.append(Row(name, "counted", quantity, partial(check_motion, px)))
    return made


def rows() -> list[Row]:
    """Return all rows."""
    error = "imbalance, log units"
    made = [
        Row("black", "counted", "events after the first step", lambda: still(0)),
        Row("white", "counted", "events after the first step", lambda: still(255)),
        Row("black and white in turns", "counted", error, lambda: balanced(Camera(0.05, 0.05), flicker())),
        Row("steps of one grey level", "counted", error, one_grey_level),
    ]
    for gamma, eps in itertools.product((0.3, 4.0), (1e-9, 1e-1)):
        camera = Camera(0.05, 0.06, 0.1, 2, 5.0, gamma, eps)
        name = f"gamma {gamma:g}, eps {eps:g}"
        made.append(Row(name, "counted", error, partial(balanced, camera, texture())))
    deep, pq = Signal(10), Signal(10, "pq")
    made += [  # slow: another compiled kernel
        Row("10 bits, eps 1e-12", "counted", error, lambda: balanced(
            Camera(0.05, 0.06, 0.1, 2, 5.0, log_eps=1e-12, signal=deep), texture(signal=deep)), slow=True),
        Row("PQ of 0 and 10,000 cd/m2 in turns, eps 1e-12", "counted", error, lambda: balanced(
            Camera(0.05, 0.05, log_eps=1e-12, signal=pq), flicker(signal=pq)), slow=True),
    ]  # fmt: skip
    cameras = {
        "thresholds 1e-6": Camera(1e-6, 1e-6),
        "thresholds 1e3": Camera(1e3, 1e3, 100.0),
        "c+ = 1e4 c-": Camera(1.0, 1e-4),
        "c- = 1e4 c+": Camera(1e-4, 1.0),
        "no noise": Camera(0.05, 0.05, 0.0),
        "noise of 1e3": Camera(0.05, 0.06, 1e3),
        "noise of 1e3, thresholds 1e-6": Camera(1e-6, 1e-6, 1e3),
        "hot pixels of +-1e6": Camera(0.1, 0.1, 0.0, HEIGHT_PX * WIDTH_PX, 1e6),
        "everything at once": Camera(1e-5, 1e-2, 10.0, 20, 1e6, 4.0, 1e-9),
    }
    for name, camera in cameras.items():
        made.append(Row(name, "counted", error, partial(balanced, camera, texture())))
    wrong = "wrong pixels or bins"
    return [
        *made,
        Row("frames of 1 x 1", "counted", error, lambda: balanced(Camera(noise_sigma=0.1), texture(STEPS, 1, 1))),
        Row("frames of 8192 x 4320", "counted", wrong, large_frames, slow=True),
        Row("one frame", "refused", "calls not refused", lambda: refused(
            UsageError, (lambda: simulate(texture()[:1], threshold_pos=0.2), ("1 frames",)))),
        Row("10^6 frames", "counted", error, lambda: million_frames("float64"), slow=True),
        Row("10^6 frames, float32", "counted", error, lambda: million_frames("float32"), slow=True),
        Row("exact multiples of a threshold", "counted", "ramps with a wrong count", exact_multiples),
        Row("NaN and infinity", "refused", "calls not refused", not_numbers),
        Row("NaN and infinity in a recipe", "refused", "calls not refused", not_numbers_in_a_recipe),
        Row("denormal numbers", "counted", error, denormals),
        Row("limits of int8, int16, float32", "counted", wrong,
            lambda: dtype_limits("float32", int8=127, int16=32767, float32=math.inf)),
        Row("limit of float32 in float64", "counted", wrong, lambda: dtype_limits("float64", float32=math.inf)),
        Row("limits of int8 and int16 in float64", "counted", wrong,
            lambda: dtype_limits("float64", int8=127, int16=32767), slow=True),  # other compiled kernels
        Row("seeds 0 and 2^64 - 1", "counted", "violations", seeds),
        Row("correlation of noise", "counted", "standard errors", noise_correlation),
        Row("more than float64 can count", "refused", "calls not refused", beyond_float64),
        Row("recipes beyond float64", "refused", "calls not refused", recipe_beyond_float64),
        *divided_rows(),
        Row("steps of 1 us and 1 h", "counted", "violations", lambda: Finding(in_time.steps_of_any_duration(), 0.0)),
        Row("refractory time longer than a step, sub-steps", "counted", "pixels with a wrong count",
            lambda: Finding(in_time.blind_sub_steps(), 0.0)),
        Row("motion or sub-steps of no number", "refused", "calls not refused", not_numbers_of_motion),
        Row("time stamps of any kind", "counted", "violations", lambda: Finding(in_time.any_time_stamps(), 0.0)),
        Row("float16 above 2,048 events", "counted", wrong, lambda: Finding(in_time.large_float16(), 0.0)),
        Row("table of gamma 4, eps 0.1", "counted", "falls of log intensity", table_never_falls),
    ]  # fmt: skip


def table_never_falls() -> Finding:
    """Count falls of a flat table: it may repeat a value in float32, but must not fall."""
    step = np.diff(log_table(4.0, 0.1))
    note = f"{int((step == 0).sum())} levels share a value"
    return Finding(int((step < 0).sum()), 0.0, "float32", note)
