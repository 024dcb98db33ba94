"""The named baseline: a sample made in the style of the loader released with the paper.

Written from its description, not from its code: the file is opened twice, seeks go by frame number, whole BGR frames
are decoded and turned to grey before the crop is cut, the pixel model runs in numpy float64 with the global random
state, voxels are float32, and torch's default collate stacks a batch.

    python -m bench.speed.released --videos DIR --samples 12

prints the processor time that each stage costs per sample, on one core; another load on the machine hardly shows in it.
"""

from __future__ import annotations

import argparse
import itertools
import os
import statistics
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch.utils.data import Dataset, default_collate

from v2v_protocol.errors import CorpusError, UsageError, V2VError, VideoError
from v2v_protocol.recipe import Recipe
from v2v_protocol.records import write_json
from v2v_server.video.rows import Rows

BATCH_SIZE = 12
_SUFFIXES = {".avi", ".mkv", ".mov", ".mp4", ".webm"}

Sample = dict[str, torch.Tensor]


@dataclass(frozen=True, slots=True)
class View:
    """Where one sample is cut from: path, first frame, crop, flip, and the frame that each position shows."""

    path: Path
    start_frame: int
    top_px: int
    left_px: int
    flip: bool
    source_index: npt.NDArray[np.int64]


class ReleasedStyleDataset(Dataset[Sample]):
    """Samples of the paper's recipe, drawn with replacement from the global random state.

    Each is {"voxels": float32 [T, bins, H, W], "frames": uint8 [T, 1, H, W]}.

    Args:
        videos: folder of clips, searched recursively.
        rows: usable rows, as for ``v2v-serve --rows``.
        recipe: ranges to draw from; its view is crop, flip and pauses only.
        samples: length of the data set; an index means nothing but "one more".

    Raises:
        CorpusError: no clip with enough frames.
    """

    def __init__(
        self, videos: Path | str, rows: str = "full", recipe: Recipe | None = None, samples: int = 1_000_000
    ) -> None:
        self.recipe = Recipe() if recipe is None else recipe
        self.rows = Rows.parse(rows)
        self.samples = samples
        found = sorted(path for path in Path(videos).rglob("*") if path.suffix.lower() in _SUFFIXES)
        self.clips = [path for path in found if _frame_count(path) >= self.recipe.frames_needed]
        if not self.clips:
            raise CorpusError(
                f"{videos}: none of its {len(found)} videos has the {self.recipe.frames_needed} frames of a sample"
            )

    def __len__(self) -> int:
        return self.samples

    def __getitem__(self, index: int) -> Sample:
        view = self.draw_view()
        return self.simulate(self.read(view))

    def draw_view(self) -> View:
        """Clip, sequence, crop, flip and pauses. The first opening of the file is here: its size is not remembered."""
        recipe = self.recipe
        path = self.clips[np.random.randint(len(self.clips))]
        capture = cv2.VideoCapture(str(path))
        count = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
        height, width = int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT)), int(capture.get(cv2.CAP_PROP_FRAME_WIDTH))
        capture.release()
        top, bottom = self.rows.bounds(height)
        if bottom - top < recipe.crop_height_px or width < recipe.crop_width_px:
            raise UsageError(f"{path}: usable picture {width}x{bottom - top} is smaller than the crop")
        advance, paused = np.ones(recipe.frames_needed, np.int64), False
        advance[0] = 0
        for position in range(1, recipe.frames_needed):
            paused = np.random.rand() < (recipe.pause_stay_probability if paused else recipe.pause_probability)
            advance[position] = not paused
        return View(
            path,
            np.random.randint((count - recipe.frames_needed) // recipe.frames_per_sequence + 1)
            * recipe.frames_per_sequence,
            top + np.random.randint(bottom - top - recipe.crop_height_px + 1),
            np.random.randint(width - recipe.crop_width_px + 1),
            np.random.rand() < recipe.flip_probability,
            np.cumsum(advance),
        )

    def read(self, view: View) -> npt.NDArray[np.uint8]:
        """The frames of the sample, [steps + 1, H, W].

        Raises:
            VideoError: the file ends early.
        """
        height, width = self.recipe.crop_height_px, self.recipe.crop_width_px
        capture = cv2.VideoCapture(str(view.path))
        capture.set(cv2.CAP_PROP_POS_FRAMES, view.start_frame)
        decoded = []
        for number in range(int(view.source_index[-1]) + 1):
            read, picture = capture.read()
            if not read:
                raise VideoError(str(view.path), view.start_frame + number, "OpenCV gives no frame")
            grey = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
            decoded.append(grey[view.top_px : view.top_px + height, view.left_px : view.left_px + width])
        capture.release()
        frames = np.stack([decoded[source] for source in view.source_index])
        return frames[:, :, ::-1] if view.flip else frames

    def simulate(self, frames: npt.NDArray[np.uint8]) -> Sample:
        """Fresh camera, voxels and target frames."""
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


def _frame_count(path: Path) -> int:
    capture = cv2.VideoCapture(str(path))
    count = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
    capture.release()
    return count


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
    """Signed events of every step in numpy float64, frame by frame (paper, section 3).

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


def stage_seconds(dataset: ReleasedStyleDataset, samples: int) -> dict[str, float]:
    """Processor seconds per sample of each stage: medians over samples, and over batches of 12 for the collate."""
    seconds: dict[str, list[float]] = {"read": [], "voxels": [], "collate": []}
    batch: list[Sample] = []
    for _ in range(samples):
        begin = time.process_time()
        frames = dataset.read(dataset.draw_view())
        read = time.process_time()
        batch.append(dataset.simulate(frames))
        seconds["read"].append(read - begin)
        seconds["voxels"].append(time.process_time() - read)
        if len(batch) == BATCH_SIZE:
            begin = time.process_time()
            default_collate(batch)
            seconds["collate"].append((time.process_time() - begin) / BATCH_SIZE)
            batch = []
    return {stage: statistics.median(values) for stage, values in seconds.items()}


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--videos", required=True, type=Path, help="clips of at least 201 frames")
    parser.add_argument("--rows", default="top:0.54")
    parser.add_argument("--samples", type=int, default=24, help=f"rounded up to batches of {BATCH_SIZE}")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    if hasattr(os, "sched_setaffinity"):
        # OpenCV's decoder and torch's collate start as many threads as there are cores.
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    torch.set_num_threads(1)
    np.random.seed(arguments.seed)
    samples = max(1, -(-arguments.samples // BATCH_SIZE)) * BATCH_SIZE
    try:
        seconds = stage_seconds(ReleasedStyleDataset(arguments.videos, arguments.rows), samples)
    except V2VError as error:
        print(error, file=sys.stderr)
        return 2
    records: list[dict[str, Any]] = [
        {"name": f"released/{stage}", "cpu_seconds_per_sample": value} for stage, value in seconds.items()
    ]
    for stage, value in seconds.items():
        print(f"{stage:8s}{value * 1e3:8.1f} ms per sample")
    print(f"{'all':8s}{sum(seconds.values()) * 1e3:8.1f} ms per sample")
    if arguments.json is not None:
        write_json(arguments.json, records)
    return 0


if __name__ == "__main__":
    sys.exit(main())
