"""Cameras outside the family that ``v2v-fit`` fits: noise after v2e and IEBCS, from the equations of their papers.

v2e (Hu, Liu, Delbruck 2021): log intensity is linear below 20 grey levels; the low-pass is an Euler step of
(F + 20) / 275 dt / tau; leak differs from pixel to pixel (lognormal) and jitters; shot noise of a pixel grows as its
threshold falls, and resets it.

IEBCS (Joubert et al. 2021): each pixel has its own rates of background events, lognormal here, other ones for brighter
than for darker; a threshold is drawn again after each event; events are late, by a time that jitters.
"""

# mypy: allow-untyped-defs, allow-untyped-calls
from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
import numpy.typing as npt

from tests.oracles.cameras import FRAMES_PER_SECOND, Film
from tests.oracles.rendered import GAMMA

_PARTS = 4


@dataclass(frozen=True)
class OtherCamera:
    """Parameters: log units, Hz, seconds; rates are those of a black pixel (v2e), or the median pixel's (IEBCS)."""

    model: str
    threshold_pos: float
    threshold_neg: float
    spread: float
    on_hz: float
    off_hz: float
    leak_hz: float
    tau_seconds: float
    refractory_seconds: float
    latency_seconds: float = 0.0


OTHERS = {
    "v2e noisy": OtherCamera("v2e", 0.2, 0.2, 0.05, 2.5, 2.5, 0.1, 1 / (2 * np.pi * 30), 5e-4),
    "v2e quiet": OtherCamera("v2e", 0.25, 0.3, 0.03, 0.25, 0.25, 0.1, 1 / (2 * np.pi * 200), 5e-4),
    "IEBCS bright": OtherCamera("IEBCS", 0.22, 0.17, 0.03, 0.8, 0.08, 0.0, 1e-3, 1e-4, 3e-4),
    "IEBCS dark": OtherCamera("IEBCS", 0.3, 0.35, 0.05, 2.0, 1.0, 0.0, 5e-3, 1e-3, 2e-3),
}


def record_other(film: Film, camera: OtherCamera, seed: int) -> dict[str, npt.NDArray[Any]]:
    """Return what the camera records, as :func:`tests.oracles.cameras.record` does."""
    count, height, width = film.grey.shape
    rng, pixels = np.random.default_rng(seed), height * width
    is_v2e, light = camera.model == "v2e", film.grey.reshape(count, pixels).T.astype(np.float64) ** GAMMA
    grey = 255.0 * film.grey.reshape(count, pixels).T
    if is_v2e:
        level = GAMMA * np.where(grey <= 20, grey * np.log(20) / 20, np.log(np.maximum(grey, 1)))
        rates = np.exp(np.log(10) * 0.1 * rng.standard_normal(pixels))
        leak, on, off = camera.leak_hz * rates, np.full(pixels, camera.on_hz), np.full(pixels, camera.off_hz)
        seen = grey / 255.0
    else:
        level, seen, leak = np.log(1e-3 + light), light, np.zeros(pixels)
        on, off = (hz * np.exp(rng.standard_normal(pixels)) for hz in (camera.on_hz, camera.off_hz))
    nominal = np.array([camera.threshold_pos, camera.threshold_neg])
    thresholds = np.maximum(nominal[:, None] + camera.spread * rng.standard_normal((2, pixels)), 0.01)
    capacity = 20 * grey.size
    out = np.empty(capacity), np.empty(capacity, np.int32), np.empty(capacity, np.bool_)
    made = _record(
        np.ascontiguousarray(level), np.ascontiguousarray(seen), 1.0 / film.hz / _PARTS, is_v2e, thresholds, nominal,
        camera.spread, on, off, leak, camera.tau_seconds, camera.refractory_seconds, camera.latency_seconds, seed, *out,
    )  # fmt: skip
    t, pixel, p = (column[:made] for column in out)
    order = np.argsort(t, kind="stable")
    y, x = np.divmod(pixel[order], width)
    shown = np.arange(0, count, film.hz // FRAMES_PER_SECOND)
    return {
        "frames": np.rint(255 * film.grey[shown]).astype(np.uint8),
        "frame_us": np.rint(1e6 * shown / film.hz).astype(np.int64),
        "t": (1e6 * t[order]).astype(np.int64), "x": x, "y": y, "p": p[order],
    }  # fmt: skip


@numba.njit(cache=True)
def _record(
    level, light, dt, is_v2e, thresholds, nominal, spread, on, off, leak, tau, refractory, latency, seed, t, pixel, p
):
    np.random.seed(seed)
    made = 0
    for i in range(level.shape[0]):
        filtered = level[i, 0]
        base = filtered - np.random.uniform(-thresholds[1, i], thresholds[0, i])
        positive, negative, blind_until = thresholds[0, i], thresholds[1, i], -1.0
        for step in range((level.shape[1] - 1) * _PARTS):
            frame, share = step // _PARTS, (step % _PARTS + 1) / _PARTS
            now = level[i, frame] + share * (level[i, frame + 1] - level[i, frame])
            lit, time = light[i, frame], step * dt
            if is_v2e:
                filtered += min(1.0, (255 * lit + 20) / 275 * dt / tau) * (now - filtered)
                base -= dt * leak[i] * (1 - 0.1 * np.random.randn()) * thresholds[0, i]
            else:
                filtered += (1 - np.exp(-dt / tau * (lit + 0.1) / 1.1)) * (now - filtered)
                if time < blind_until:
                    base = filtered
            shot = 0.5 * (1 - 0.75 * lit) if is_v2e else 1.0
            drawn = np.random.random()
            noise_on = shot * 2 * on[i] * dt * (nominal[0] / thresholds[0, i] if is_v2e else 1.0)
            noise_off = shot * 2 * off[i] * dt * (nominal[1] / thresholds[1, i] if is_v2e else 1.0)
            if not is_v2e:
                noise_on, noise_off = noise_on / 2, noise_off / 2
            while True:
                difference = filtered - base
                is_noise = drawn < noise_on + noise_off
                if difference < positive and difference > -negative and not is_noise:
                    break
                is_on = drawn < noise_on if is_noise else difference > 0
                drawn = 1.0
                if is_noise:
                    base = filtered
                else:
                    base += positive if is_on else -negative
                at = time + dt * np.random.random()
                if at >= blind_until and made < len(t):
                    late = latency * max(0.0, 1 + 0.3 * np.random.randn())
                    t[made], pixel[made], p[made] = at + late, i, is_on
                    made += 1
                    blind_until = at + refractory
                if not is_v2e:
                    positive = max(thresholds[0, i] + spread * np.random.randn(), 0.01)
                    negative = max(thresholds[1, i] + spread * np.random.randn(), 0.01)
    return made
