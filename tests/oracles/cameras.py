"""Simulated cameras with known parameters, event by event: the truth that ``v2v-fit`` has to find again.

Nothing here is shared with the kernel but the equations of ``docs/effects.md``. Log intensity is linear between the
pictures of a high rate. Unlike the kernel, noise events obey the refractory period, as in a sensor.
"""

# mypy: allow-untyped-defs, allow-untyped-calls
from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import av
import cv2
import numba
import numpy as np
import numpy.typing as npt

from tests.oracles.rendered import GAMMA, rendered_scene

RENDERED_HZ, FRAMES_PER_SECOND = 480, 30
MOVING_SECONDS, STILL_SECONDS = 2.0, 3.0
SCENES = ("camera", "coffee", "coins", "parallax", "occlusion", "plain", "rotation", "gravel")


@dataclass(frozen=True)
class TrueCamera:
    """Parameters under the names of the recipe."""

    threshold_pos: float
    threshold_neg: float
    threshold_mismatch_sigma: float = 0.0
    shot_noise_hz: float = 0.0
    leak_hz: float = 0.0
    refractory_seconds: float = 0.0
    photoreceptor_hz: float = 0.0
    hot_pixel_share: float = 0.0
    hot_pixel_sigma: float = 0.0
    dead_pixel_share: float = 0.0
    log_eps: float = 1e-3

    def to_dict(self) -> dict[str, float]:
        """Return the parameters by name."""
        return dataclasses.asdict(self)


@dataclass(frozen=True, eq=False)
class Film:
    """Pictures of a high rate: [n, height, width] float32, grey levels from 0 to 1; the last one stays.

    Attributes:
        hz: pictures a second, a multiple of FRAMES_PER_SECOND.
    """

    grey: npt.NDArray[np.float32]
    hz: int


def drawn_camera(seed: int) -> TrueCamera:
    """Return a camera of random parameters; about a third of the effects are off."""
    rng = np.random.default_rng(seed)

    def between(low: float, high: float, *, may_be_off: bool = True) -> float:
        value = math.exp(rng.uniform(math.log(low), math.log(high)))
        return 0.0 if may_be_off and rng.random() < 0.3 else value

    positive = between(0.12, 0.4, may_be_off=False)
    return TrueCamera(
        positive,
        positive * between(0.7, 1.4, may_be_off=False),
        between(0.03, 0.2),
        between(0.3, 5.0),
        between(0.05, 1.0),
        between(1e-4, 2e-3),
        between(30.0, 300.0),
        between(1e-3, 1e-2),
        between(2.0, 20.0, may_be_off=False),
        between(1e-3, 1e-2),
        between(1e-3, 3e-2, may_be_off=False),
    )


def rendered_film(
    name: str,
    height: int,
    width: int,
    px_per_second: float,
    moving: float = MOVING_SECONDS,
    still: float = STILL_SECONDS,
) -> Film:
    """Render a scene that moves for some seconds and then stands still."""
    scene = rendered_scene(name, height, width, px_per_second)
    moving_steps = round(moving * RENDERED_HZ)
    pictures = [scene.light(step / RENDERED_HZ).astype(np.float32) for step in range(moving_steps + 1)]
    return Film(np.stack(pictures + [pictures[-1]] * round(still * RENDERED_HZ)), RENDERED_HZ)


def film_of_video(path: Path, height: int, width: int, hz: int, moving: float = MOVING_SECONDS) -> Film:
    """Read the middle of a high-rate video, and let it stand still at the end."""
    pictures = []
    with av.open(str(path)) as container:
        for frame in container.decode(video=0):
            grey = frame.to_ndarray(format="gray")
            small = cv2.resize(grey, (2 * width, 2 * height), interpolation=cv2.INTER_AREA)
            pictures.append(
                small[height // 2 : height // 2 + height, width // 2 : width // 2 + width] / np.float32(255)
            )
            if len(pictures) > moving * hz:
                break
    return Film(np.stack(pictures + [pictures[-1]] * round(STILL_SECONDS * hz)), hz)


def record(film: Film, camera: TrueCamera, seed: int) -> dict[str, npt.NDArray[Any]]:
    """Return what the camera records: frames [n, height, width] uint8 with their times, and events in order of time.

    Returns:
        ``frames``, ``frame_us`` [n] int64; ``t`` [N] int64 microseconds, ``x``, ``y``, ``p`` [N].
    """
    count, height, width = film.grey.shape
    rng, pixels = np.random.default_rng(seed), height * width
    spread = np.maximum(1 + camera.threshold_mismatch_sigma * rng.standard_normal((2, pixels)), 0.25)
    drift = np.zeros(pixels)
    drift[rng.choice(pixels, round(camera.hot_pixel_share * pixels), replace=False)] = camera.hot_pixel_sigma
    drift *= rng.standard_normal(pixels)
    is_dead = np.zeros(pixels, bool)
    is_dead[rng.choice(pixels, round(camera.dead_pixel_share * pixels), replace=False)] = True
    grey = np.ascontiguousarray(film.grey.reshape(count, pixels).T)
    capacity = 40 * grey.size
    out = np.empty(capacity, np.int64), np.empty(capacity, np.int32), np.empty(capacity, np.bool_)
    made = _record(
        grey, 1.0 / film.hz, camera.log_eps, GAMMA, camera.threshold_pos * spread[0], camera.threshold_neg * spread[1],
        camera.threshold_pos, camera.leak_hz, drift, camera.shot_noise_hz, camera.refractory_seconds,
        camera.photoreceptor_hz, is_dead, seed, *out,
    )  # fmt: skip
    t, pixel, p = (column[:made] for column in out)
    order = np.argsort(t, kind="stable")
    y, x = np.divmod(pixel[order], width)
    shown = np.arange(0, count, film.hz // FRAMES_PER_SECOND)
    frame_us = np.rint(1e6 * shown / film.hz).astype(np.int64)
    frames = np.rint(255 * film.grey[shown]).astype(np.uint8)
    return {"frames": frames, "frame_us": frame_us, "t": t[order], "x": x, "y": y, "p": p[order]}


@numba.njit(cache=True)
def _record(
    grey, dt, log_eps, gamma, positive, negative, nominal, leak_hz, drift, shot_hz, refractory, corner_hz, is_dead,
    seed, t, pixel, polarity,
):  # fmt: skip
    np.random.seed(seed)
    made = 0
    for i in range(grey.shape[0]):
        before = math.log(log_eps + grey[i, 0] ** gamma)
        seen = before
        residual = np.random.uniform(-negative[i], positive[i])
        blind_until = -1.0
        for step in range(1, grey.shape[1]):
            begin = (step - 1) * dt
            light = grey[i, step] ** gamma
            now = math.log(log_eps + light)
            change = now - before
            if corner_hz > 0.0:
                turns = 2 * math.pi * corner_hz * dt * (light + 20 / 255) / (1 + 20 / 255)
                a = 1.0 - math.exp(-turns)
                change = a * (before - seen) + (1.0 - a / turns) * (now - before)
                seen += change
            before = now
            slope = change / dt + leak_hz * nominal + drift[i]
            shot = begin + dt
            rate = shot_hz * (1.0 - 0.75 * light)
            has_shot = rate > 0.0 and np.random.random() < rate * dt
            if has_shot:
                shot = begin + dt * np.random.random()
            at = begin
            passes = 2 if has_shot else 1
            for part in range(passes):
                end = shot if part == 0 else begin + dt
                while True:
                    start = max(at, blind_until)
                    if start >= end:
                        at = end
                        break
                    threshold = positive[i] if slope > 0 else -negative[i]
                    wait = (threshold - residual) / slope if slope != 0.0 else 1e9
                    if start + max(wait, 0.0) >= end:
                        residual += slope * (end - start)
                        at = end
                        break
                    at = start + max(wait, 0.0)
                    residual = 0.0
                    blind_until = at + refractory
                    if not is_dead[i] and made < len(t):
                        t[made], pixel[made], polarity[made] = int(at * 1e6), i, slope > 0
                        made += 1
                if part == 0 and has_shot and shot >= blind_until:
                    residual = 0.0
                    blind_until = shot + refractory
                    if not is_dead[i] and made < len(t):
                        t[made], pixel[made], polarity[made] = int(shot * 1e6), i, np.random.random() < 0.5
                        made += 1
    return made
