"""Measure a :class:`v2v_server.corpus.scenes.scene.Scene` in one pass: every frame in blocks, some for motion.

Shot boundaries. Let m_t be the means of the 8 x 8 blocks of frame t, less their own mean, so that flicker and exposure
do not count, and d(s, t) = mean |m_s - m_t|. Frame t begins a shot if d(t-1, t) is

- at least 2 grey levels, and 0.35 of what two unrelated pictures of the same contrasts differ by, which is of the order
  of sqrt(var m_t-1 + var m_t): it is another picture;
- at least 3 times the median over the five steps before and after: not the pace of this shot;
- not above twice d(t-1, t+1): the next frame does not go back, as after a flash;
- large beside most steps around it (``is_cut``): repeated frames make the median small.

Missing frames of a moving shot leave a picture of less difference. Frame t begins another piece of it too, if d(t-1, t)
is at least 2 grey levels, the next frame does not go back, and what of m_t is not m_t-1 in another light,

    u(t) = var m_t - cov(m_t-1, m_t)^2 / var m_t-1,

is at least 0.35^2 var m_t and 3^2 times that of each of the eight steps before and after. In a shot that stands still
(median of d below 0.2 grey levels) that is something which appears, not a jump.

All of this is exact arithmetic, the same everywhere. Repeats and the other stretches are found in ``stretches``;
dissolves are not found. Motion is that of dense inverse search on pictures of a quarter of the size, over the first
four of every eight frames, rounded to 1/64 px a frame.
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import islice

import cv2
import numpy as np
import numpy.typing as npt

from v2v_server.corpus.scenes.scene import (
    CHANGE,
    CLIPPED,
    COLUMNS,
    CONTRAST,
    DARK,
    FLICKER,
    LAG_FRAMES,
    MOST_ANALYSED_FRAMES,
    MOTION,
    NOISE,
    SEGMENT_FRAMES,
    TILES,
    Scene,
    Sides,
)
from v2v_server.corpus.scenes.stretches import (
    bars_of,
    change_of,
    duplicated,
    halt_before,
    is_cut,
    is_flat,
    is_still,
    pieces_of,
)
from v2v_server.flow import DIS_ULTRAFAST, GreyPicture, dis, one_thread

DARK_BELOW_LEVEL = 16
CLIPPED_FROM_LEVEL = 250
_BLOCK_PX = 8
_SHRINK = 4
_MOST_OF_THE_PICTURE = 0.95
_STILLEST = 0.1
_LEAST_BOUNDARY_LEVELS = 2.0
_LEAST_BOUNDARY_SHARE = 0.35
_LEAST_BOUNDARY_RATIO = 3.0
_NEIGHBOURS = 5
_LEAST_JUMP_PACE = 0.2
"""Grey levels."""
_JUMP_REACH = 8
"""Steps."""
_LARGEST_RETURN = 0.5
_KEPT_FRAMES = 9
"""Those whose blocks are kept, for halts of up to seven steps."""
_PIXEL_NOISE = 4
"""Grey levels."""
_BARS_EVERY = 8
"""Frames."""
_COMB_LEVELS = 5
"""Least difference of the neighbouring lines of a combed block, grey levels."""
_COMB_CHANGE = 64
"""Least change of its mean from one frame to the next, 1/64 grey level."""
_COMB_BLOCKS = 1000
"""One of that number of blocks are combed in a combed picture, and four at least: fine texture has two or three."""

_QUIET_CHANGE = 35
"""Grey levels over four frames, in the mean of the tiles. Of the samples of the paper's cameras, half of those from
quieter sequences were mostly noise, and a fifth of the others."""

_EVEN_BYTES = np.uint64(0x00FF00FF00FF00FF)
_EACH_WORD = np.uint64(0x0001000100010001)
_Tiles = npt.NDArray[np.float64]
"""[16], row by row."""


class SceneAnalysis:
    """Analyse a video frame by frame. Memory: three pictures, and some hundred bytes a frame."""

    def __init__(self) -> None:
        self._search = dis(DIS_ULTRAFAST, 1)
        self._frames = 0
        self._blocks: list[npt.NDArray[np.int64]] = []  # of the last frames, 1/64 grey level each
        self._last: GreyPicture | None = None
        self._reduced: tuple[int, GreyPicture] | None = (
            None  # a frame from which motion is to be measured, and its number
        )
        self._means: list[float] = []
        self._variances: list[float] = []
        self._light: list[int] = []  # 1/64 grey level
        self._step_changes: list[int] = []  # of `change_of`
        self._pixel_changes: list[int] = []  # of `_pixel_change`
        self._halts: list[bool] = []  # of `halt_before`
        self._still: list[bool] = []
        self._flat: list[bool] = []
        self._bars: list[tuple[int, Sides]] = []
        self._combed: list[tuple[int, bool]] = []
        self._steps: list[float] = []  # d(t-1, t)
        self._returns: list[float] = []  # d(t-1, t+1)
        self._news: list[float] = []  # u(t), (1/64 grey level)^2
        self._changes: list[_Tiles] = []  # of frame 1, 2 ...: largest change over four frames
        self._motions: list[tuple[int, int, _Tiles]] = []  # (frame, later frame, px a frame)
        self._shares: list[tuple[int, float, float]] = []  # (frame, dark, clipped)
        self._noises: list[tuple[int, float]] = []

    def add(self, picture: GreyPicture) -> None:
        """Add the next frame: [h, w] uint8, full-range luma, upright, of the size of the others."""
        with one_thread():
            self._add(np.ascontiguousarray(picture))

    def _add(self, picture: GreyPicture) -> None:
        number, self._frames = self._frames, self._frames + 1
        blocks = block_sums(picture)
        self._means.append(float(blocks.mean()) / 64)
        self._variances.append(_covariance(blocks, blocks) / blocks.size**2)
        self._light.append(int(blocks.sum()) // blocks.size)
        self._flat.append(is_flat(blocks))
        self._still.append(is_still((self._blocks[-LAG_FRAMES:] or [blocks])[0], blocks))
        if number % _BARS_EVERY == 0 and not self._flat[-1]:
            self._bars.append((number, bars_of(picture)))
        if self._last is not None:
            self._step_changes.append(change_of(self._blocks[-1], blocks))
            self._pixel_changes.append(_pixel_change(self._last, picture))
            count = halt_before([*self._blocks, blocks], self._step_changes, self._pixel_changes)
            self._halts[number - 1 - count :] = [True] * count + [False]
            if number % LAG_FRAMES == 0:
                self._combed.append((number, _is_combed(picture, np.abs(blocks - self._blocks[-1]))))
            self._steps.append(_difference(self._blocks[-1], blocks))
            self._news.append(_unexplained(self._blocks[-1], blocks))
            self._changes.append(_largest(np.abs(blocks - self._blocks[-LAG_FRAMES:][0])) / 64)
        if len(self._blocks) > 1:
            self._returns.append(_difference(self._blocks[-2], blocks))
        self._blocks = [*self._blocks, blocks][-_KEPT_FRAMES:]
        if number % SEGMENT_FRAMES == 1 and self._last is not None:
            self._noises.append((number, _noise(self._last, picture)))
        if number % LAG_FRAMES == 0:
            dark, clipped = map(np.count_nonzero, (picture < DARK_BELOW_LEVEL, picture >= CLIPPED_FROM_LEVEL))
            self._shares.append((number, dark / picture.size, clipped / picture.size))
            self._measure_motion(number, picture)
        self._last = picture

    def _measure_motion(self, number: int, picture: GreyPicture) -> None:
        reduced = _reduced(picture)
        if self._reduced is None:
            self._reduced = (number, reduced)
            return
        (before, earlier), self._reduced = self._reduced, None
        field = self._search(earlier, reduced)[::2, ::2]  # made of patches that are wider apart
        pace = _most(np.hypot(field[..., 0], field[..., 1])) * (_SHRINK / (number - before))
        self._motions.append((before, number, pace))

    def scene(self) -> Scene:
        """Return the statistics; no frame may be added afterwards."""
        if not self._frames:
            return Scene.unknown()
        if self._last is not None and self._reduced is not None and self._reduced[0] < self._frames - 1:
            with one_thread():
                self._measure_motion(self._frames - 1, self._last)
        boundaries = self._shot_boundaries()
        values = np.full((-(-self._frames // SEGMENT_FRAMES), COLUMNS), np.nan)
        deviations = np.sqrt(self._variances) / 64
        means = np.array(self._means)
        ripples = np.abs(means[1:-1] - (means[:-2] + means[2:]) / 2)
        for number, row in enumerate(values):
            low, high = number * SEGMENT_FRAMES, min((number + 1) * SEGMENT_FRAMES, self._frames)
            inside = [
                pace
                for before, after, pace in self._motions
                if before < high and after > low and not any(before < boundary <= after for boundary in boundaries)
            ]
            row[MOTION] = np.max(inside, axis=0) if inside else np.nan
            row[CHANGE] = np.max(self._changes[low:high], axis=0) if low + 1 < self._frames else 0.0
            row[CONTRAST] = deviations[low:high].max()
            shares = [(dark, clipped) for frame, dark, clipped in self._shares if low <= frame < high]
            row[[DARK, CLIPPED]] = np.mean(shares, axis=0)
            rippled = ripples[max(0, low - 1) : high - 1]
            row[FLICKER] = rippled.mean() if len(rippled) else 0.0
            row[NOISE] = next((noise for frame, noise in self._noises if low <= frame < high), np.nan)
        quiet = np.repeat(values[:, CHANGE].mean(axis=1) < _QUIET_CHANGE, SEGMENT_FRAMES)[: self._frames]
        repeats = duplicated(self._step_changes, np.array(self._halts, bool), self._blocks[-1].size, boundaries)
        assert self._last is not None
        pieces = pieces_of(
            np.array(self._light), np.array(self._variances), np.array(self._still), np.array(self._flat), quiet,
            repeats, boundaries, self._combed, self._bars, self._last.shape,
        )  # fmt: skip
        return Scene.of(pieces, values)

    def _shot_boundaries(self) -> tuple[int, ...]:
        boundaries = []
        for at, step in enumerate(self._steps):  # from frame ``at`` to ``at + 1``
            if step < _LEAST_BOUNDARY_LEVELS:
                continue
            if at < len(self._returns) and self._returns[at] < _LARGEST_RETURN * step:
                continue  # a flash begins
            if at and self._returns[at - 1] < _LARGEST_RETURN * step:
                continue  # it ends
            if self._is_another_picture(at, step) or self._is_jump(at):
                boundaries.append(at + 1)
        return tuple(boundaries)

    def _is_another_picture(self, at: int, step: float) -> bool:
        contrast = (self._variances[at] + self._variances[at + 1]) / 64**2
        around = self._steps[max(0, at - _NEIGHBOURS) : at] + self._steps[at + 1 : at + 1 + _NEIGHBOURS]
        is_large = not around or step >= _LEAST_BOUNDARY_RATIO * float(np.median(around))
        return is_large and step**2 >= _LEAST_BOUNDARY_SHARE**2 * contrast and is_cut(self._step_changes, at)

    def _is_jump(self, at: int) -> bool:
        news = self._news[at]
        spans = slice(max(0, at - _JUMP_REACH), at), slice(at + 1, at + 1 + _JUMP_REACH)
        around, paces = ([*each[spans[0]], *each[spans[1]]] for each in (self._news, self._steps))
        return (
            len(around) >= _JUMP_REACH
            and news >= _LEAST_BOUNDARY_SHARE**2 * self._variances[at + 1]
            and news >= _LEAST_BOUNDARY_RATIO**2 * max(around)
            and float(np.median(paces)) >= _LEAST_JUMP_PACE
        )


def analyse(pictures: Iterable[GreyPicture]) -> Scene:
    """Analyse the frames of a video; the first 4096 of them, which are read one by one."""
    analysis = SceneAnalysis()
    for picture in islice(pictures, MOST_ANALYSED_FRAMES):
        analysis.add(picture)
    return analysis.scene()


def block_sums(picture: GreyPicture) -> npt.NDArray[np.int64]:
    """Return the means of the whole 8 x 8 blocks of a picture, [h // 8, w // 8], in 1/64 grey level."""
    height, width = picture.shape
    if height < _BLOCK_PX or width < _BLOCK_PX:
        picture = np.pad(picture, ((0, max(0, _BLOCK_PX - height)), (0, max(0, _BLOCK_PX - width))), mode="edge")
    rows, columns = (side // _BLOCK_PX for side in picture.shape)
    # Eight pixels in a word: sums of eight rows fit into 16 bits each, and a product adds the four of them up.
    words = np.ascontiguousarray(picture[: rows * _BLOCK_PX, : columns * _BLOCK_PX]).view(np.uint64)
    words = words.reshape(rows, _BLOCK_PX, columns)
    sums = (words & _EVEN_BYTES).sum(axis=1) + ((words >> np.uint64(8)) & _EVEN_BYTES).sum(axis=1)
    blocks: npt.NDArray[np.int64] = ((sums * _EACH_WORD) >> np.uint64(48)).astype(np.int64)
    return blocks


def _pixel_change(before: GreyPicture, after: GreyPicture) -> int:
    """Return the sum of the squared changes of all pixels, without what a coder may change of each, grey level^2."""
    change = cv2.absdiff(before, after)
    cv2.subtract(change, _PIXEL_NOISE, dst=change)  # type: ignore[call-overload]
    return int(cv2.norm(change, cv2.NORM_L2SQR))


def _covariance(first: npt.NDArray[np.int64], second: npt.NDArray[np.int64]) -> int:
    """Return the covariance of whole numbers, times the square of their count."""
    return first.size * int((first * second).sum()) - int(first.sum()) * int(second.sum())


def _unexplained(first: npt.NDArray[np.int64], second: npt.NDArray[np.int64]) -> float:
    """Return the variance of block means that those of the picture before do not have in another light."""
    before, both, after = _covariance(first, first), _covariance(first, second), _covariance(second, second)
    return (after * before - both**2) / (before * second.size**2) if before else after / second.size**2


def _is_combed(picture: GreyPicture, change: npt.NDArray[np.int64]) -> bool:
    """Return whether two fields of different times are woven together.

    Args:
        picture: [h, w].
        change: of the means of its blocks from the frame before, 1/64 grey level.
    """
    rows, columns = change.shape
    if picture.shape[0] < 2 * _BLOCK_PX or picture.shape[1] < _BLOCK_PX:
        return False
    part = picture[: (rows - 1) * _BLOCK_PX + 2, : columns * _BLOCK_PX]
    line, field = cv2.absdiff(part[1:-1], part[:-2]), cv2.absdiff(part[2:], part[:-2])
    size = columns, rows - 1
    near, far = (cv2.resize(each, size, interpolation=cv2.INTER_AREA).astype(np.int32) for each in (line, field))
    combed = (near >= _COMB_LEVELS) & (near > 2 * far) & (change[:-1] >= _COMB_CHANGE)
    return int(np.count_nonzero(combed)) >= max(4, change.size // _COMB_BLOCKS)


def _difference(first: npt.NDArray[np.int64], second: npt.NDArray[np.int64]) -> float:
    """Return the mean absolute difference of block means in grey levels, after each picture's mean is subtracted."""
    change = second - first
    count = change.size
    return float(np.abs(count * change - change.sum()).sum()) / (64 * count**2)


def _largest(blocks: npt.NDArray[np.int64]) -> _Tiles:
    """Return [16], the largest value of each tile."""
    rows, columns = (np.arange(TILES) * side // TILES for side in blocks.shape)
    return np.maximum.reduceat(np.maximum.reduceat(blocks, rows, axis=0), columns, axis=1).ravel().astype(np.float64)


def _most(pace: npt.NDArray[np.float32]) -> _Tiles:
    """Return [16], what 95 % of each tile stays below."""
    tiles = [part for row in _parts(pace, 0) for part in _parts(row, 1)]
    places = [int(_MOST_OF_THE_PICTURE * (tile.size - 1) + 0.5) for tile in tiles]
    return np.array([np.partition(tile, place, axis=None)[place] for tile, place in zip(tiles, places, strict=True)])


def _parts(values: npt.NDArray[np.float32], axis: int) -> list[npt.NDArray[np.float32]]:
    """Return four parts of about equal size, of at least one row or column each."""
    side = values.shape[axis]
    starts = [at * side // TILES for at in range(TILES)]
    ends = [max(start + 1, (at + 1) * side // TILES) for at, start in enumerate(starts)]
    return [values.take(range(start, end), axis) for start, end in zip(starts, ends, strict=True)]


def _noise(first: GreyPicture, second: GreyPicture) -> float:
    """Return the standard deviation of one pixel's noise in grey levels.

    It is measured in the middle half of the rows, in the tenth of the blocks whose difference varies least. Motion adds
    to it only where no part of the picture stands still.
    """
    height, width = (max(1, side // _BLOCK_PX) for side in first.shape)
    above, height = height // 4, max(1, height // 2)
    part = np.s_[above * _BLOCK_PX : (above + height) * _BLOCK_PX, : width * _BLOCK_PX]
    change = cv2.subtract(second[part], first[part], dtype=cv2.CV_32F)
    mean = cv2.resize(change, (width, height), interpolation=cv2.INTER_AREA)
    square = cv2.resize(change * change, (width, height), interpolation=cv2.INTER_AREA)
    variance = np.maximum(square - mean * mean, 0.0)
    return float(np.sqrt(np.quantile(variance, _STILLEST) / 2))


def _reduced(picture: GreyPicture) -> GreyPicture:
    height, width = (max(1, side // _SHRINK) for side in picture.shape)
    part = picture[: height * _SHRINK, : width * _SHRINK]
    return cv2.resize(part, (width, height), interpolation=cv2.INTER_AREA).astype(np.uint8, copy=False)
