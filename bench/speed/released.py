"""The baseline: a loader written in the style of the one released with the paper.

Written from its description, not from its code: it opens the file twice, seeks by frame number, decodes whole BGR
frames and turns them to grey before it cuts the crop, runs the pixel model in numpy float64 with the global random
state, and returns float32 voxels; torch's default collate stacks a batch. It is not the released code itself.
"""

from __future__ import annotations

import itertools
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch.utils.data import Dataset

from v2v_protocol.errors import CorpusError, UsageError, VideoError
from v2v_protocol.recipe import Recipe
from v2v_server.video.rows import Rows

_SUFFIXES = {".avi", ".mkv", ".mov", ".mp4", ".webm"}

Sample = dict[str, torch.Tensor]


class ReleasedStyleDataset(Dataset[Sample]):
    """Draw samples of the paper's recipe with replacement from the global random state.

    Each is {"voxels": float32 [T, bins, H, W], "frames": uint8 [T, 1, H, W]}. An index means nothing but "one more".

    Args:
        videos: folder of clips, searched recursively.
        rows: usable rows, as for ``v2v-serve --rows``.

    Raises:
        CorpusError: no clip has enough frames.
    """

    def __init__(self, videos: Path, rows: str) -> None:
        self.recipe = Recipe()
        self.rows = Rows.parse(rows)
        found = sorted(path for path in Path(videos).rglob("*") if path.suffix.lower() in _SUFFIXES)
        self.clips = [path for path in found if _count_and_size(path)[0] >= self.recipe.frames_needed]
        if not self.clips:
            raise CorpusError(
                f"{videos}: none of its {len(found)} videos has the {self.recipe.frames_needed} frames of a sample"
            )

    def __len__(self) -> int:
        return 1_000_000

    def __getitem__(self, index: int) -> Sample:
        return self.simulate(self.read(*self.draw_view()))

    def draw_view(self) -> tuple[Path, int, int, int, bool, npt.NDArray[np.int64]]:
        """Draw clip, first frame, top, left, flip, and the source frame of each position.

        It opens the file a first time: its size is not remembered.
        """
        recipe = self.recipe
        path = self.clips[np.random.randint(len(self.clips))]
        count, height, width = _count_and_size(path)
        top, bottom = self.rows.bounds(height)
        if bottom - top < recipe.crop_height_px or width < recipe.crop_width_px:
            raise UsageError(f"{path}: usable picture {width}x{bottom - top} is smaller than the crop")
        advance, paused = np.ones(recipe.frames_needed, np.int64), False
        advance[0] = 0
        for position in range(1, recipe.frames_needed):
            paused = np.random.rand() < (recipe.pause_stay_probability if paused else recipe.pause_probability)
            advance[position] = not paused
        return (
            path,
            np.random.randint((count - recipe.frames_needed) // recipe.frames_per_sequence + 1)
            * recipe.frames_per_sequence,
            top + np.random.randint(bottom - top - recipe.crop_height_px + 1),
            np.random.randint(width - recipe.crop_width_px + 1),
            np.random.rand() < recipe.flip_probability,
            np.cumsum(advance),
        )

    def read(
        self, path: Path, start: int, top: int, left: int, flip: bool, source_index: npt.NDArray[np.int64]
    ) -> npt.NDArray[np.uint8]:
        """Return the frames of a sample, [steps + 1, H, W].

        Raises:
            VideoError: the file ends early.
        """
        height, width = self.recipe.crop_height_px, self.recipe.crop_width_px
        capture = cv2.VideoCapture(str(path))
        capture.set(cv2.CAP_PROP_POS_FRAMES, start)
        decoded = []
        for number in range(int(source_index[-1]) + 1):
            read, picture = capture.read()
            if not read:
                raise VideoError(str(path), start + number, "OpenCV gives no frame")
            grey = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
            decoded.append(grey[top : top + height, left : left + width])
        capture.release()
        frames = np.stack([decoded[source] for source in source_index])
        return frames[:, :, ::-1] if flip else frames

    def simulate(self, frames: npt.NDArray[np.uint8]) -> Sample:
        """Draw a camera; return voxels and target frames."""
        recipe = self.recipe
        first = np.random.uniform(*recipe.threshold)
        second = first * np.random.uniform(*recipe.threshold_ratio)
        threshold_pos, threshold_neg = (first, second) if np.random.rand() < 0.5 else (second, first)
        steps = simulate_steps(
            frames,
            threshold_pos=threshold_pos,
            threshold_neg=threshold_neg,
            noise_sigma=np.random.uniform(*recipe.noise_sigma),
            hot_pixel_share=np.random.uniform(*recipe.hot_pixel_share),
            hot_pixel_sigma=np.random.uniform(*recipe.hot_pixel_sigma),
            gamma=recipe.gamma,
            log_eps=recipe.log_eps[0],
        )
        bins = steps.reshape(-1, recipe.bins, recipe.frames_per_bin, *steps.shape[1:]).sum(2)
        return {
            "voxels": torch.from_numpy(bins.astype(np.float32)),
            "frames": torch.from_numpy(np.ascontiguousarray(frames[list(recipe.target_steps)][:, None])),
        }


def _count_and_size(path: Path) -> tuple[int, int, int]:
    """Return frames, height and width of a video."""
    capture = cv2.VideoCapture(str(path))
    names = cv2.CAP_PROP_FRAME_COUNT, cv2.CAP_PROP_FRAME_HEIGHT, cv2.CAP_PROP_FRAME_WIDTH
    count, height, width = (int(capture.get(name)) for name in names)
    capture.release()
    return count, height, width


def simulate_steps(
    frames: npt.NDArray[np.uint8],
    *,
    threshold_pos: float,
    threshold_neg: float,
    noise_sigma: float,
    hot_pixel_share: float,
    hot_pixel_sigma: float,
    gamma: float = 2.2,
    log_eps: float = 1e-3,
) -> npt.NDArray[np.float64]:
    """Return the signed events of every step in numpy float64, frame by frame (paper, section 3).

    Args:
        frames: [n, H, W] uint8.

    Returns:
        [n - 1, H, W] float64.
    """
    shape = frames.shape[1:]
    hot = np.zeros(frames[0].size)
    places = np.random.choice(hot.size, int(hot_pixel_share * hot.size), replace=False)
    hot[places] = np.random.normal(0.0, hot_pixel_sigma, len(places))
    hot = hot.reshape(shape)
    level = np.log(log_eps + (frames.astype(np.float64) / 255.0) ** gamma)
    residual = np.random.uniform(-threshold_neg, threshold_pos, shape)
    steps = []
    for before, after in itertools.pairwise(level):
        potential = residual + after - before + np.random.normal(0.0, noise_sigma, shape) + hot
        positive = np.maximum(0.0, np.floor(potential / threshold_pos))
        negative = np.maximum(0.0, np.floor(-potential / threshold_neg))
        residual = potential - threshold_pos * positive + threshold_neg * negative
        steps.append(positive - negative)
    return np.stack(steps)
