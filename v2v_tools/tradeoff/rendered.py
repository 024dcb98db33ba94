"""Frames of the corpus become photographs that move as the corpus moves: what settings are compared with at the true
rate.

At some moments of a clip, what moves from one frame to the next is divided into the camera, which most blocks with
texture follow (pan, turn and zoom, aligned to a fraction of a pixel), and things that go their own way. The frame then
moves like the camera. Each thing is cut out as a round patch of its size, plain where the thing is plain inside, and
goes at its speed in front of another part of the frame. ``v2v_server/worlds`` renders frames of 8 bits, which the
setting sees, and steps so fine that half of them change less than .5 % of the signed bins: they give the true events.
Both have the camera of the setting, at ERROR_THRESHOLD and without noise.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from v2v_server.motion import levels_between, motions
from v2v_server.motion.lanes import BLOCK_PX, CELL_PX
from v2v_server.motion.matching import UNITS_PER_PX
from v2v_server.motion.measure import measure, together
from v2v_server.simulation.clip import simulate_clip
from v2v_server.simulation.effects import NOISE
from v2v_server.simulation.intensity import eight_bits
from v2v_server.simulation.view import FrameArray, Window
from v2v_server.simulation.voxel import Doubles, Levels
from v2v_server.system.compile_cache import cv2
from v2v_server.video.picture import SDR, Signal
from v2v_server.worker.arrays.context import SampleContext
from v2v_server.worlds import render
from v2v_server.worlds.world import Layer, World
from v2v_tools.motion import MOST_LOST
from v2v_tools.tradeoff.measures import Leases, seen
from v2v_tools.tradeoff.report import ERROR_THRESHOLD, TRUE_RATE

_Mask = npt.NDArray[np.bool_]
_Counts = npt.NDArray[np.int64]
STEPS = 6
"""Steps of a rendered clip. The first one spreads the residuals, and does not count."""
_CLIPS_OF_A_LEASE = 2
_SPEEDS_PX = {"to 1": 1.0, "1 to 4": 4.0, "4 to 16": 16.0, "over 16": math.inf}
"""Classes of speed: the largest of each, px a frame."""
_DEEP = Signal(16)
_FINER = 4
"""Pixels of the photograph in one of the frame: the renderer reads it bilinearly, which has a kink at each pixel."""
_FIRST_PART_PX, _MOST_PARTS, _ALIKE = 0.5, 512, 0.005
_NOISE_GREY, _TEXTURE_GREY = 8, 12
_APART_PX, _REST_PX, _LEAST_RADIUS_PX, _FAR_PX = 1.0, 1 / 32, 2.0, 1e6
_LEAST_CELLS, _LEAST_BORDER, _MOST_PATCHES = 6, 1 / 3, 8
_BLOCK, _NEAR = np.ones((BLOCK_PX, BLOCK_PX), np.uint8), np.ones((5, 5), np.uint8)


def true_rates(leases: Leases, ways: Mapping[float, str]) -> tuple[dict[float, dict[str, Any]], list[dict[str, Any]]]:
    """Compare the events of settings with those of their corpus at the true rate.

    Args:
        leases: from the source; the settings differ in ``substep_px`` only.
        ways: names of the settings, by ``substep_px``.

    Returns:
        of each ``substep_px`` the errors of TRUE_RATE, None where they cannot be told, and "lost_share", the share of
        the changed pixels that no block follows; records of the errors by speed.
    """
    sums, motion = {substep_px: np.zeros((len(_SPEEDS_PX), 5)) for substep_px in ways}, []
    for number in range(len(leases.each)):
        (context,) = seen(leases, number)
        frames = eight_bits(context.view, context.signal)
        motion.append(measure(frames))
        for part in range(1, _CLIPS_OF_A_LEASE + 1):
            first = part * (len(frames) - 1) // (_CLIPS_OF_A_LEASE + 1)
            pair = frames[first : first + 2]
            speed = np.searchsorted([*_SPEEDS_PX.values()], measure(pair).px_per_frame(0.5))
            for substep_px, each in _compared(context, pair, ways).items():
                sums[substep_px][speed] += each
    moved = together(motion)
    lost = moved.lost / max(moved.changed, 1)
    told = sums if lost <= MOST_LOST else {}
    return {px: {**_fields(told.get(px, np.zeros((1, 5))).sum(axis=0)), "lost_share": lost} for px in ways}, [
        {"measure": "speed", "way": ways[px], "px_per_frame": speeds, **_fields(each),
         "events_share": each[4] / every[:, 4].sum()}
        for px, every in told.items() for speeds, each in zip(_SPEEDS_PX, every, strict=True) if each[4]
    ]  # fmt: skip


def _fields(sums: Doubles) -> dict[str, float | None]:
    """Return the errors of TRUE_RATE from the sums of :func:`_sums`; None where the truth has no events."""
    shares = (sums[:3] / sums[[3, 4, 4]]).tolist() if sums[3] else [None] * 3
    return {each.key: share for each, share in zip(TRUE_RATE, shares, strict=True)}


def _sums(made: _Counts, true: _Counts) -> Doubles:
    """Return sums of event counts [n, 2, ...] that can be added, [5]: how far signed bins, bins of both polarities and
    the number of events are apart; the true signed bins and the true events.
    """
    apart = made - true
    far = np.abs(_signed(apart)).sum(), np.abs(apart).sum(), apart.sum()
    return np.array([*far, np.abs(_signed(true)).sum(), true.sum()], np.float64)


def _signed(counts: _Counts) -> _Counts:
    return counts[:, 1] - counts[:, 0]


def _compared(context: SampleContext, pair: FrameArray, substeps: Iterable[float]) -> dict[float, Doubles]:
    """Render a clip that moves as two frames do; return the sums of :func:`_sums` by ``substep_px``."""
    pyramid, world = moving_photograph(pair)
    moments, source = np.arange(STEPS + 1.0), np.arange(STEPS + 1)
    deep = render.render(pyramid, world, moments)
    parts, sums = int(render.parts_by_motion(world, moments, _FIRST_PART_PX, _MOST_PARTS).max()), np.ones(5)
    true = _counts(context, deep, None, _DEEP)
    while sums[0] > _ALIKE * sums[3] and parts <= _MOST_PARTS:
        levels = render.levels_between(pyramid, world, moments, source, np.full(STEPS, parts))
        before, true, parts = true, _counts(context, deep, levels, _DEEP), 2 * parts
        sums = _sums(before, true)
    frames = ((deep + 128) // 257).astype(np.uint8)
    vectors, whole = motions(frames), (0, 0, *frames.shape[1:])
    between = {px: levels_between(frames, whole, source, px, vectors) if px else None for px in substeps}
    return {px: _sums(_counts(context, frames, levels, SDR), true) for px, levels in between.items()}


def _counts(context: SampleContext, frames: FrameArray, levels: Levels | None, signal: Signal) -> npt.NDArray[np.int64]:
    """Return the event counts of all steps of a rendered clip but the first, as the camera of a sample makes them."""
    seconds, recipe = context.step_seconds, context.recipe
    effects = {name: value for name, value in context.params.effects.items() if name not in NOISE}
    params = dataclasses.replace(
        context.params, threshold_pos=ERROR_THRESHOLD, threshold_neg=ERROR_THRESHOLD, noise_sigma=0.0,
        hot_pixel_count=0, pauses=(), grid_steps=(), effects=effects,
    )  # fmt: skip
    recipe = recipe.replace(
        voxels_per_clip=STEPS, bins=recipe.bins if recipe.grids_per_frame else 1, frames_per_bin=1, lead_frames=0,
        lead_voxels=0, voxel_seconds=(0.0, 0.0),
    )  # fmt: skip
    lasting = None if seconds is None else np.full(STEPS, np.median(seconds))
    made = simulate_clip(frames, params, recipe, "float32", lasting, {}, levels, signal).array("event_counts")
    return made[len(made) // STEPS :].astype(np.int64)


def moving_photograph(pair: FrameArray) -> tuple[render.PhotoPyramid, World]:
    """Return the first of two frames as a photograph, and the world in which it moves as from it to the other.

    Args:
        pair: [2, H, W] uint8.

    Returns:
        the photograph, and the world of STEPS frames, whose moments are the numbers of frames.
    """
    (height, width), way = pair.shape[1:], np.moveaxis(motions(pair)[1], 0, -1) / UNITS_PER_PX
    where = np.moveaxis(np.indices(way.shape[:2])[::-1] + 0.5, 0, -1) * CELL_PX - 0.5 - way / 2
    middle = (np.array([width, height]) - 1) / 2
    has_texture = _by_cell(cv2.dilate(pair[0], _BLOCK) - cv2.erode(pair[0], _BLOCK), way) >= _TEXTURE_GREY
    camera = _most_of(where[has_texture], way[has_texture])
    goes = _filled(_leaves(pair, camera, where, way) & has_texture, has_texture)
    shift = np.column_stack([np.eye(2), np.median(_carried(camera, where), axis=(0, 1))])
    aligned = _aligned(pair, camera, goes, cv2.MOTION_AFFINE), _aligned(pair, shift, goes, cv2.MOTION_TRANSLATION)
    camera = min(camera, *aligned, key=lambda each: float(_mismatch(pair, each).mean()))
    if np.abs(_carried(camera, np.array([[0, 0], 2 * middle]))).max() < _REST_PX:
        camera = np.eye(2, 3)
    moves, far = _leaves(pair, camera, where, way) & has_texture, np.full(2, _FAR_PX)
    turn, zoom = math.atan2(camera[1, 0], camera[0, 0]) / (2 * math.pi), math.log(math.hypot(*camera[:, 0]))
    back = -_carried(camera, middle)
    layers = [Layer((middle + 0.5) * _FINER, back, far, np.zeros(2), -turn, -zoom, ())]
    own = way - _carried(camera, where)
    for radius, place, speed, aside in _things(moves, _filled(moves, has_texture), where, way, own, middle):
        shown = (place + 0.5) * _FINER
        outline = *shown.tolist(), radius * _FINER, 1.0, 0.0, 0.0, 0.0, 0.0, radius / 4
        layers.append(Layer(shown, speed, far, place + aside - middle, 0.0, 0.0, outline))
    size = width * _FINER, height * _FINER
    fine = cv2.resize(pair[0].astype(np.float32), size, interpolation=cv2.INTER_LANCZOS4).clip(0, 255) * np.float32(257)
    return render.PhotoPyramid(fine.ravel(), np.zeros(1, np.int64), np.array([fine.shape])), World(
        1 / _FINER, Window(0, 0, height, width), False, (0.0, float(STEPS)), np.zeros(2),
        np.zeros((2 + len(layers), 4)), 0, tuple(layers), np.empty((0, 3)),
    )  # fmt: skip


def _by_cell(picture: npt.NDArray[Any], way: Doubles) -> npt.NDArray[Any]:
    """Return the pixels of a picture in the middle of the cells, [rows, columns]."""
    return cv2.resize(picture, way.shape[1::-1], interpolation=cv2.INTER_NEAREST)


def _carried(camera: Doubles, where: Doubles) -> Doubles:
    """Return how far the camera, [2, 3], moves places from the middle of the first pixel, [..., 2]."""
    return where @ camera[:, :2].T + camera[:, 2] - where


def _most_of(where: Doubles, way: Doubles) -> Doubles:
    """Return the shift, turn and zoom that most of some places [n, 2] follow; rest, for few places."""
    cv2.setRNGSeed(0)
    is_known = len(where) >= _LEAST_CELLS
    found = cv2.estimateAffinePartial2D(where, where + way, ransacReprojThreshold=_APART_PX)[0] if is_known else None
    return np.eye(2, 3) if found is None else np.asarray(found, np.float64)


def _aligned(pair: FrameArray, camera: Doubles, goes: _Mask, kind: int) -> Doubles:
    """Return the shift, turn and zoom that align the frames: the vectors of blocks say 0 for half a pixel.

    Args:
        goes: [rows, columns], cells that do not count, nor those near them.
        kind: OpenCV's, of the motion.
    """
    rests = cv2.resize(1 - cv2.dilate(goes.astype(np.uint8), _NEAR), None, fx=CELL_PX, fy=CELL_PX, interpolation=0)
    until, (height, width) = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 50, 1e-5), pair.shape[1:]
    start = camera.astype(np.float32)
    try:
        found = cv2.findTransformECC(pair[0], pair[1], start, kind, until, rests[:height, :width], 3)[1]
    except cv2.error:  # there is nothing to align
        return camera
    a, b = (found[0, 0] + found[1, 1]) / 2, (found[1, 0] - found[0, 1]) / 2
    alike = np.array([[a, -b, 0.0], [b, a, 0.0]])
    alike[:, 2] = (found - alike) @ [(width - 1) / 2, (height - 1) / 2, 1.0]
    return alike


def _mismatch(pair: FrameArray, camera: Doubles) -> FrameArray:
    """Return how far the frames differ when the camera is undone, [H, W], grey levels up to _NOISE_GREY + 1."""
    aligned = cv2.warpAffine(pair[0], camera, pair.shape[:0:-1], borderMode=cv2.BORDER_REFLECT)
    return np.minimum(cv2.absdiff(aligned, pair[1]), _NOISE_GREY + 1)


def _leaves(pair: FrameArray, camera: Doubles, where: Doubles, way: Doubles) -> _Mask:
    """Return which cells do not move with the camera, and are not explained by it."""
    apart = np.hypot(*np.moveaxis(way - _carried(camera, where), -1, 0)) > _APART_PX
    unexplained, changes = (
        _by_cell(cv2.dilate(_mismatch(pair, each), _BLOCK), way) > _NOISE_GREY for each in (camera, np.eye(2, 3))
    )
    # A block rests also where none was found; then it changes.
    leaves: _Mask = apart & unexplained & (way.any(axis=-1) | ~changes)
    return leaves


def _filled(goes: _Mask, has_texture: _Mask) -> _Mask:
    """Add the plain areas whose border goes: the inside of things that are plain."""
    filled, plain = goes.copy(), (~has_texture & ~goes).astype(np.uint8)
    count, labels = cv2.connectedComponents(plain, connectivity=4)
    for label in range(1, count):
        inside = labels == label
        border = (cv2.dilate(inside.astype(np.uint8), _NEAR[:3, :3]) > 0) & ~inside
        filled |= inside & (goes[border].sum() > _LEAST_BORDER * border.sum())
    return filled


def _things(
    moves: _Mask, goes: _Mask, where: Doubles, way: Doubles, own: Doubles, middle: Doubles
) -> list[tuple[float, Doubles, Doubles, Doubles]]:
    """Return the largest groups of cells that go their own way.

    Args:
        moves, goes: [rows, columns], cells that move, and those with what is plain between them.
        where, way, own: [rows, columns, 2], place of each, its motion, and that apart from the camera's, px.
        middle: of the frame.

    Returns:
        of each the radius, the place, the speed, and the way to another part of the frame, px.
    """
    found = []
    for contour in cv2.findContours(goes.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]:
        inside = cv2.drawContours(np.zeros(goes.shape, np.uint8), [contour], -1, 1, cv2.FILLED) > 0
        if inside.sum() >= _LEAST_CELLS and (inside & moves).any():
            speed = np.median(way[inside & moves], axis=0)
            right, down = np.median(own[inside & moves], axis=0)
            # Blocks reach beyond their cells, and both frames have a share in the cells of what moves.
            length = max(math.hypot(right, down), _APART_PX)
            radius = CELL_PX * (math.sqrt(inside.sum() / math.pi) - 1.5) - length / 4
            place, aside = where[inside].mean(axis=0), np.array([-down, right]) * (2 * radius + CELL_PX) / length
            if radius >= _LEAST_RADIUS_PX:
                nearest = min(aside, -aside, key=lambda to: np.abs(place + to - middle).max())
                found.append((radius, place, speed, nearest))
    return sorted(found, key=lambda thing: -thing[0])[:_MOST_PATCHES]
