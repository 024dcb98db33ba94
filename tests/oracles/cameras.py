"""Simulated cameras with known parameters, event by event: the truth that ``v2v-fit`` has to find again.

They share no code with the product. From the equations, in float64, for all pixels at once:

    L = log(log_eps + light),   dP/dt = 2 pi f (L - P),   f = corner (light + 20/255) / (1 + 20/255)

Light is linear between the pictures of a film, and P between steps of about a millisecond. A pixel fires where P and
its leak have moved by its own threshold since its last event, and sees nothing during its refractory period. Shot noise
is a Poisson process for each polarity; an event of it restarts the pixel. It obeys the refractory period, as in a
sensor, or ignores it, as in many simulators (v2e before its version 1.5, this product's kernel).

Noise before the comparator is an Ornstein-Uhlenbeck process x that is added to P: a pixel whose level lies between two
thresholds flips between them, so events alternate. x is exact at the end of a step. Its two extremes inside are those
of a Brownian bridge, whose rates are within 10 % of those of fine steps up to a corner of 35 Hz:

    x' = rho x + sigma sqrt(1 - rho^2) N,   rho = exp(-h),   h = 2 pi f dt
    top = (x + x' + sqrt((x - x')^2 - 4 sigma^2 sinh(h) ln V)) / 2,   V uniform; the lowest value is its mirror

A step has three legs: to the extreme away from x', to the other one, and to x'.

Scenes are photographs that move on a smooth path, scenes rendered by formula, and clips whose frames are blended. The
cameras and scenes on which the fit was tuned (:data:`TUNING`) are others than those of the report (:data:`REPORT`).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import numpy.typing as npt
from scipy import ndimage  # type: ignore[import-untyped]

from tests.oracles.known_motion import photograph
from tests.oracles.rendered import GAMMA, OTHERS, rendered_scene

Doubles = npt.NDArray[np.float64]
HEIGHT_PX, WIDTH_PX = 64, 96
FRAMES_PER_SECOND = 30
_DARKEST = 20 / 255
_HZ, _STEPS_A_SECOND = 240, 960
_RENDERED = OTHERS[1:]  # all but the photograph
_BLENDED = 10
"""Pictures made of one frame of a clip, which has 24 to 30 frames a second."""


@dataclass(frozen=True)
class TrueCamera:
    """Parameters under the names of the recipe.

    Attributes:
        noise_ignores: shot noise ignores the refractory period.
        band_share, band_hz: sigma of the noise before the comparator as a share of the mean threshold, and its corner.
    """

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
    noise_ignores: bool = False
    band_share: float = 0.0
    band_hz: float = 0.0


@dataclass(frozen=True, eq=False)
class Film:
    """Pictures of a high rate: [n, height, width], grey levels from 0 to 1; the last one stays."""

    grey: npt.NDArray[Any]
    hz: int


@dataclass(frozen=True)
class Case:
    """One recording of a list.

    Attributes:
        scene: photograph, or file name of a clip.
        seed: of camera and motion.
        ignores: noise ignores the refractory period.
        still: seconds without motion at the end.
        alternates: the noise is one before the comparator, in the place of shot noise.
    """

    scene: str
    seed: int
    ignores: bool
    still: float = 1.5
    alternates: bool = False

    @property
    def camera(self) -> TrueCamera:
        """Parameters drawn for this case; a fifth to a third of the effects are off."""
        rng = np.random.default_rng(self.seed)

        def between(low: float, high: float, off: float = 0.0) -> float:
            value = math.exp(rng.uniform(math.log(low), math.log(high)))
            return 0.0 if rng.random() < off else value

        positive = between(0.12, 0.35)
        made = TrueCamera(
            positive, positive * between(0.75, 1.33), threshold_mismatch_sigma=between(0.03, 0.12, off=0.3),
            shot_noise_hz=between(0.3, 6.0, off=0.15), leak_hz=between(0.1, 1.0, off=0.3),
            refractory_seconds=between(2e-4, 2e-3, off=0.2), photoreceptor_hz=between(30.0, 300.0, off=0.3),
            log_eps=between(2e-3, 3e-2), hot_pixel_share=between(4e-3, 2e-2, off=0.5),
            hot_pixel_sigma=between(2.0, 20.0), dead_pixel_share=between(4e-3, 2e-2, off=0.5),
            noise_ignores=self.ignores,
        )  # fmt: skip
        if not self.alternates:
            return made
        return replace(
            made, shot_noise_hz=0.0, noise_ignores=False, band_share=between(0.16, 0.26), band_hz=between(15.0, 35.0)
        )

    def film(self, clips: Path) -> Film:
        """Render the scene, or read it from a folder of clips."""
        if "." in self.scene:
            return _blended(clips / self.scene, self.seed, self.still)
        if self.scene in _RENDERED:
            return rendered_film(self.scene, HEIGHT_PX, WIDTH_PX, 70.0, still=self.still)
        return _moving(self.scene, self.seed, self.still)


def _cases(seed: int, scenes: tuple[str, ...], stills: tuple[float, ...]) -> tuple[Case, ...]:
    """Return two cases of each scene: noise that obeys and noise that ignores the refractory period."""
    pairs = itertools.product(scenes, (False, True))
    return tuple(
        Case(scene, seed + number, ignores, stills[number % len(stills)])
        for number, (scene, ignores) in enumerate(pairs)
    )


TUNING = _cases(
    1000,
    (
        "camera", "chelsea", "gravel", "carphone_pristine.mp4", "rocket", "camera", "chelsea", "rocket", "gravel",
        "plain", "rotation",
    ),
    (1.5, 1.0, 2.0),
)  # fmt: skip
ALTERNATING = tuple(
    Case(scene, 3000 + number, False, 1.5, alternates=True)
    for number, scene in enumerate(("coffee", "astronaut", "coins", "brick", "parallax", "zoom"))
)
"""Cameras whose events of noise alternate: no parameter of the fit explains them."""
REPORT = _cases(
    2000,
    (
        "coffee", "astronaut", "coins", "bikes.mp4", "bigbuckbunny.mp4", "brick", "parallax", "zoom", "occlusion",
        "astronaut", "coffee", "coins",
    ),
    (1.5, 1.0, 2.0),
)  # fmt: skip


def rendered_film(
    name: str, height: int, width: int, px_per_second: float, moving: float = 2.0, still: float = 3.0
) -> Film:
    """Render a scene that moves for some seconds and then stands still."""
    scene = rendered_scene(name, height, width, px_per_second)
    pictures = [scene.light(step / _HZ) for step in range(round(moving * _HZ) + 1)]
    return Film(np.stack(pictures + [pictures[-1]] * round(still * _HZ)), _HZ)


def record(film: Film, camera: TrueCamera, seed: int) -> dict[str, npt.NDArray[Any]]:
    """Return what a camera records.

    Returns:
        ``frames`` [n, height, width] uint8, ``frame_us`` [n] int64; in order of time ``t`` [N] int64 microseconds,
        ``x``, ``y``, ``p`` [N].
    """
    count, height, width = film.grey.shape
    pixels = _Pixels(camera, height * width, seed)
    light = film.grey.reshape(count, -1).astype(np.float64) ** GAMMA
    steps = max(1, round(_STEPS_A_SECOND / film.hz))
    pixels.settle(light[0])
    for picture, step in itertools.product(range(count - 1), range(1, steps + 1)):
        pixels.step(light[picture] + step / steps * (light[picture + 1] - light[picture]), 1.0 / film.hz / steps)
    seconds, place, p = (np.concatenate(column) for column in zip(*pixels.events, strict=True))
    order = np.argsort(seconds, kind="stable")
    y, x = np.divmod(place[order], width)
    shown = np.arange(0, count, max(1, film.hz // FRAMES_PER_SECOND))
    return {
        "frames": np.rint(255 * film.grey[shown]).astype(np.uint8),
        "frame_us": np.rint(1e6 * shown / film.hz).astype(np.int64),
        "t": (1e6 * seconds[order]).astype(np.int64), "x": x, "y": y, "p": p[order],
    }  # fmt: skip


class _Pixels:
    """The state of all pixels of a camera, and the events that they fired: seconds, place, brighter."""

    def __init__(self, camera: TrueCamera, count: int, seed: int) -> None:
        self._camera, self._rng = camera, np.random.default_rng(seed)
        nominal = np.array([[camera.threshold_pos], [camera.threshold_neg]])
        spread = 1.0 + camera.threshold_mismatch_sigma * self._rng.standard_normal((2, count))
        self._on, self._off = nominal * np.maximum(spread, 0.3)
        self._moved = self._rng.triangular(-self._off, 0.0, self._on)
        of_camera = np.random.default_rng(seed + 1)
        is_hot, self._is_dead = of_camera.random((2, count)) < [[camera.hot_pixel_share], [camera.dead_pixel_share]]
        hot = is_hot * camera.hot_pixel_sigma * of_camera.standard_normal(count)
        self._drift = camera.leak_hz * camera.threshold_pos + hot
        self._blind_until = np.full(count, -1.0)
        self._now = 0.0
        self._sigma = camera.band_share * float(nominal.mean())
        self._noise = self._sigma * self._rng.standard_normal(count)
        self.events: list[tuple[Doubles, npt.NDArray[np.int64], npt.NDArray[np.bool_]]] = []

    def settle(self, light: Doubles) -> None:
        """Start in this light."""
        self._level = self._aim = np.log(self._camera.log_eps + light)

    def step(self, light: Doubles, dt: float) -> None:
        """Advance by a step that ends in this light."""
        level, target = self._level, np.log(self._camera.log_eps + light)
        if self._camera.photoreceptor_hz:
            corner = self._camera.photoreceptor_hz * (light + _DARKEST) / (1.0 + _DARKEST)
            tau = 1.0 / (2.0 * math.pi * corner)
            # The solution for an L that rises steadily: it lags by tau, and what differs from that decays.
            lag = tau * (target - self._aim) / dt
            self._level = target - lag + (level - self._aim + lag) * np.exp(-dt / tau)
        else:
            self._level = target
        self._aim = target
        slope = (self._level - level) / dt + self._drift
        end = self._now + dt
        if self._sigma:
            everyone = np.arange(len(light))
            for number, leg in enumerate(self._legs(dt)):
                begin, until = (np.full(len(light), self._now + dt * (number + k) / 3) for k in (0, 1))
                self._cross(everyone, begin, until, slope + leg / (dt / 3))
            self._now = end
            return
        rate = self._camera.shot_noise_hz * (1.0 - 0.75 * light)
        noisy = np.flatnonzero(self._rng.random(len(light)) < rate * dt)
        everyone = np.arange(len(light))
        begin = np.full(len(light), self._now)
        if len(noisy):
            at = self._now + dt * self._rng.random(len(noisy))
            self._cross(noisy, begin[noisy], at, slope[noisy])
            fires = self._camera.noise_ignores | (at >= self._blind_until[noisy])
            noisy, at = noisy[fires], at[fires]
            self._moved[noisy] = 0.0
            self._fire(noisy, at, self._rng.random(len(noisy)) < 0.5, is_noise=True)
            begin[noisy] = at
            refused = np.setdiff1d(everyone, noisy, assume_unique=True)
            self._cross(refused, begin[refused], np.full(len(refused), end), slope[refused])
            self._cross(noisy, at, np.full(len(noisy), end), slope[noisy])
        else:
            self._cross(everyone, begin, np.full(len(light), end), slope)
        self._now = end

    def _legs(self, dt: float) -> Doubles:
        """Return the changes of the noise before the comparator in the three legs of a step: [3, pixels]."""
        rng, x, h = self._rng, self._noise, 2 * math.pi * self._camera.band_hz * dt
        end = math.exp(-h) * x + self._sigma * math.sqrt(-math.expm1(-2 * h)) * rng.standard_normal(len(x))
        reach = np.sqrt((x - end) ** 2 - 4 * self._sigma**2 * math.sinh(h) * np.log(rng.random((2, len(x)))))
        top, bottom = (x + end + reach[0]) / 2, (x + end - reach[1]) / 2
        falls = end < x
        self._noise = end
        return np.diff([x, np.where(falls, top, bottom), np.where(falls, bottom, top), end], axis=0)

    def _cross(self, who: npt.NDArray[np.int64], begin: Doubles, end: Doubles, slope: Doubles) -> None:
        """Let pixels move at a steady pace from one time to another, and fire what they cross."""
        while len(who):
            begin = np.maximum(begin, self._blind_until[who])
            seen = np.maximum(end - begin, 0.0)
            limit = np.where(slope > 0, self._on[who], -self._off[who])
            wait = np.maximum((limit - self._moved[who]) / np.where(slope == 0, 1e-30, slope), 0.0)
            fires = (wait < seen) & (slope != 0)
            rest = ~fires
            self._moved[who[rest]] += slope[rest] * seen[rest]
            who, begin, end, slope = who[fires], (begin + wait)[fires], end[fires], slope[fires]
            self._moved[who] = 0.0
            self._fire(who, begin, slope > 0)

    def _fire(
        self, who: npt.NDArray[np.int64], at: Doubles, is_on: npt.NDArray[np.bool_], is_noise: bool = False
    ) -> None:
        seen = ~self._is_dead[who]
        self.events.append((at[seen], who[seen], is_on[seen]))
        if not (is_noise and self._camera.noise_ignores):
            self._blind_until[who] = at + self._camera.refractory_seconds


def _moving(name: str, seed: int, still: float, moving: float = 2.0) -> Film:
    """Render a photograph on a path of two sines, then at rest."""
    rng = np.random.default_rng(10_000 + seed)
    picture = cv2.GaussianBlur(photograph(name).astype(np.float64) / 255.0, (0, 0), 0.7)
    spline = ndimage.spline_filter(picture, mode="mirror")
    speed, turn = np.exp(rng.uniform(np.log(40.0), np.log(130.0))), rng.uniform(0.0, math.pi)
    hz = rng.uniform(0.35, 0.8, 2)
    corner = np.array(picture.shape) / 2 - (HEIGHT_PX / 2, WIDTH_PX / 2) + rng.uniform(-40.0, 40.0, 2)
    y, x = np.mgrid[0:HEIGHT_PX, 0:WIDTH_PX].astype(np.float64)
    moment = np.arange(round(moving * _HZ) + 1)[:, None] / _HZ
    path = speed / (2 * math.pi * hz) * np.sin(2 * math.pi * hz * moment + [turn, 1.3 * turn])
    at: Callable[[Doubles], Doubles] = lambda place: ndimage.map_coordinates(  # noqa: E731
        spline, [y + corner[0] + place[0], x + corner[1] + place[1]], mode="mirror", prefilter=False
    )
    pictures = [np.clip(at(place), 0.0, 1.0) for place in path]
    return Film(np.stack(pictures + [pictures[-1]] * round(still * _HZ)), _HZ)


def _blended(path: Path, seed: int, still: float, moving: float = 2.0) -> Film:
    """Read a part of a clip, its frames blended, and let it rest at the end."""
    with av.open(str(path)) as container:
        rate = float(container.streams.video[0].average_rate or 25)
        frames = [frame.to_ndarray(format="gray") for frame in container.decode(video=0)]
    first = int(np.random.default_rng(10_000 + seed).integers(len(frames) - int(moving * rate) - 1))
    small = []
    for frame in frames[first : first + round(moving * rate) + 1]:
        height = min(frame.shape[0], frame.shape[1] * HEIGHT_PX // WIDTH_PX)
        top, left = (frame.shape[0] - height) // 2, (frame.shape[1] - height * WIDTH_PX // HEIGHT_PX) // 2
        part = frame[top : top + height, left : left + height * WIDTH_PX // HEIGHT_PX]
        small.append(cv2.resize(part, (WIDTH_PX, HEIGHT_PX), interpolation=cv2.INTER_AREA) / 255.0)
    shares = np.arange(_BLENDED) / _BLENDED
    pictures = [one + share * (two - one) for one, two in itertools.pairwise(small) for share in shares]
    hz = round(rate * _BLENDED)
    return Film(np.stack([*pictures, small[-1]] + [small[-1]] * round(still * hz)), hz)
