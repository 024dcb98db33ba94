"""Pairs of pictures whose flow is known exactly: photographs and video frames moved by formula.

A texture S is a function of real coordinates: a picture's cubic spline, mirrored beyond its border. With an affine
motion T of the image plane the earlier picture is S(M x), the later one S(M T^-1 x), and the forward flow is T x - x
without any error. M is the same slight turn and shift for both, so that neither shows the texture's own pixels and both
are equally soft. Layers are ellipses with textures and motions of their own in front.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from scipy import ndimage  # type: ignore[import-untyped]
from skimage import color, data

KINDS = ("pan", "zoom", "rotation", "layers")
DEGRADATIONS = ("clean", "noise", "blur")
PHOTOGRAPHS = ("coffee", "rocket", "astronaut", "camera", "chelsea", "gravel")
NOISE_SIGMA = 2.0
BLUR_SIGMA_PX = 1.2
BOUNDARY_PX = 4
"""A pixel this near to a layer's outline lies at a motion boundary."""
_LEAST_PX, _MOST_PX = 0.25, 16.0
_LAYERS = 2

Grey = npt.NDArray[np.uint8]
_Affine = npt.NDArray[np.float64]
"""[3, 3], acts on columns (x, y, 1)."""


@dataclass(frozen=True, slots=True)
class Scene:
    """A pair and its truth.

    Attributes:
        name: texture, kind of motion, degradation.
        kind, degradation: of KINDS and DEGRADATIONS.
        earlier, later: [h, w] uint8.
        forward: [h, w, 2] float32, px: flow on the grid of ``earlier``.
        backward: [h, w, 2] float32, px: flow on the grid of ``later``.
        boundary: [h, w] bool, near a motion boundary of the earlier picture.
    """

    name: str
    kind: str
    degradation: str
    earlier: Grey
    later: Grey
    forward: npt.NDArray[np.float32]
    backward: npt.NDArray[np.float32]
    boundary: npt.NDArray[np.bool_]


def photograph(name: str) -> Grey:
    """Return one of the photographs that come with scikit-image, grey."""
    picture = getattr(data, name)()
    return np.array(picture if picture.ndim == 2 else color.rgb2gray(picture) * 255.0 + 0.5, np.uint8)


def scenes(textures: Mapping[str, Grey], height: int, width: int, seed: int = 0, every: int = 1) -> list[Scene]:
    """Return one scene of every texture, kind and degradation, or every ``every``-th of them.

    The largest displacement of each is drawn log-uniformly from 0.25 to 16 px.
    """
    names = list(textures)
    made = []
    for number, (name, kind, degradation) in enumerate(itertools.product(names, KINDS, DEGRADATIONS)):
        if number % every == 0:
            first = names.index(name)
            layers = [textures[names[(first + layer) % len(names)]] for layer in range(1 + _LAYERS)]
            generator = np.random.default_rng((seed, number))
            made.append(_scene(name, kind, degradation, layers, height, width, generator))
    return made


def _scene(
    name: str, kind: str, degradation: str, textures: Sequence[Grey], height: int, width: int, rng: np.random.Generator
) -> Scene:
    most = float(np.exp(rng.uniform(math.log(_LEAST_PX), math.log(_MOST_PX))))
    if kind == "layers":
        motions = [_motion("pan", most * share, height, width, rng) for share in (0.3, 1.0, 0.7)]
    else:
        motions = [_motion(kind, most, height, width, rng)]
    outlines = [_outline(height, width, rng) for _ in motions[1:]]
    looks = [_look(texture, height, width, rng) for texture in textures[: len(motions)]]
    x, y = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    grid = np.stack([x, y, np.ones_like(x)])
    earlier, forward, owner = _render(textures, looks, motions, outlines, grid, later=False)
    later, backward, _ = _render(textures, looks, motions, outlines, grid, later=True)
    first, second = _degraded(earlier, degradation, rng), _degraded(later, degradation, rng)
    edge = np.zeros(owner.shape, np.uint8)
    edge[:, 1:] |= owner[:, 1:] != owner[:, :-1]
    edge[1:] |= owner[1:] != owner[:-1]
    boundary = cv2.dilate(edge, np.ones((2 * BOUNDARY_PX + 1,) * 2, np.uint8)).astype(bool)
    return Scene(f"{name} {kind} {degradation}", kind, degradation, first, second, forward, backward, boundary)


def _degraded(picture: npt.NDArray[np.float64], degradation: str, rng: np.random.Generator) -> Grey:
    if degradation == "blur":
        picture = ndimage.gaussian_filter(picture, BLUR_SIGMA_PX)
    if degradation == "noise":
        picture = picture + rng.normal(0.0, NOISE_SIGMA, picture.shape)
    grey: Grey = np.clip(np.rint(picture), 0, 255).astype(np.uint8)
    return grey


def _render(
    textures: Sequence[Grey],
    looks: Sequence[_Affine],
    motions: Sequence[_Affine],
    outlines: Sequence[_Affine],
    grid: npt.NDArray[np.float64],
    *,
    later: bool,
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float32], npt.NDArray[np.int64]]:
    """Return one picture, the flow from it to the other one, and the layer of each pixel."""
    picture = np.zeros(grid.shape[1:])
    flow = np.zeros((*grid.shape[1:], 2), np.float32)
    owner = np.zeros(grid.shape[1:], np.int64)
    for layer, (texture, look, motion) in enumerate(zip(textures, looks, motions, strict=False)):
        inverse = _inverse(motion)
        home = _apply(inverse, grid) if later else grid  # where this pixel of the layer was in the earlier picture
        cover = np.ones_like(picture) if layer == 0 else _cover(outlines[layer - 1], home)
        x, y, _ = _apply(look, home)
        picture += cover * (_sample(texture, x, y) - picture)
        shown = cover >= 0.5
        to = _apply(inverse if later else motion, grid)
        flow[shown] = (to - grid)[:2].transpose(1, 2, 0)[shown]
        owner[shown] = layer
    return picture, flow, owner


def _apply(affine: _Affine, points: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    moved: npt.NDArray[np.float64] = np.einsum("ij,jhw->ihw", affine, points)
    return moved


def _sample(texture: Grey, x: npt.NDArray[np.float64], y: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    # OpenCV's remap rounds coordinates to 1/32 px, which would be the error of the truth.
    sampled: npt.NDArray[np.float64] = ndimage.map_coordinates(texture.astype(np.float64), [y, x], mode="mirror")
    return sampled


def _cover(outline: _Affine, points: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return the share of each pixel that an ellipse covers; ``outline`` takes it to the unit circle."""
    x, y, _ = _apply(outline, points)
    radius = np.hypot(x, y)
    pixel = math.sqrt(abs(np.linalg.det(outline[:2, :2])))
    covered: npt.NDArray[np.float64] = np.clip(0.5 + (1.0 - radius) / pixel, 0.0, 1.0)
    return covered


def _motion(kind: str, most_px: float, height: int, width: int, rng: np.random.Generator) -> _Affine:
    """Return a motion whose largest displacement is about ``most_px``."""
    centre = _shift((width - 1) / 2, (height - 1) / 2)
    reach = math.hypot(width, height) / 2
    sign = rng.choice((-1.0, 1.0))
    if kind == "pan":
        angle = rng.uniform(0.0, 2 * math.pi)
        return _shift(most_px * math.cos(angle), most_px * math.sin(angle))
    if kind == "zoom":
        change = np.diag([1 + sign * most_px / reach, 1 + sign * most_px / reach, 1.0])
    else:
        change = _turn(sign * most_px / reach)
    return centre @ change @ _inverse(centre)


def _look(texture: Grey, height: int, width: int, rng: np.random.Generator) -> _Affine:
    """Return the place of the picture in the texture: its middle part, slightly turned, at a fraction of a pixel."""
    rows, columns = texture.shape
    shift = _shift(columns / 2 + rng.uniform(-20, 20), rows / 2 + rng.uniform(-20, 20))
    return shift @ _turn(rng.uniform(0.02, 0.05)) @ _shift(-width / 2, -height / 2)


def _outline(height: int, width: int, rng: np.random.Generator) -> _Affine:
    axes = rng.uniform(0.15, 0.3, 2) * height * np.array([1.6, 1.0])
    centre = _shift(rng.uniform(0.25, 0.75) * width, rng.uniform(0.25, 0.75) * height)
    return _inverse(centre @ _turn(rng.uniform(0.0, math.pi)) @ np.diag([*axes, 1.0]))


def _inverse(affine: _Affine) -> _Affine:
    inverse: _Affine = np.linalg.inv(affine).astype(np.float64)
    return inverse


def _shift(x: float, y: float) -> _Affine:
    return np.array([[1.0, 0.0, x], [0.0, 1.0, y], [0.0, 0.0, 1.0]])


def _turn(angle: float) -> _Affine:
    cosine, sine = math.cos(angle), math.sin(angle)
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
