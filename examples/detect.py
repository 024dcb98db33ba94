"""Train a small recurrent detector on the simulated events of videos with boxes: docs/guides/detection.md.

python examples/render_sprites.py --footage .demo/videos --out /tmp/sprites
python examples/detect.py --videos /tmp/sprites/train --held-out /tmp/sprites/held-out --minutes 10
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from itertools import chain, repeat

import numpy as np
import torch
from torch import nn
from torch.nn import functional as F

from v2v_client import Batch, V2VStreamDataset
from v2v_client.representations import stacked_histogram

CLASSES, BINS, STRIDE = 2, 5, 8
ARRAYS = ("event_counts", "boxes")
SIGNS = torch.tensor([1.0, 1.0, -1.0, -1.0])[:, None, None]
RECIPE = {
    "voxels_per_clip": 6, "bins": BINS, "crop_height_px": 128, "crop_width_px": 128, "threshold": [0.15, 0.3],
    "noise_sigma": [0.0, 0.03], "hot_pixel_share": 0.0, "pause_probability": 0.0, "max_boxes": 16,
}  # fmt: skip


class Detector(nn.Module):
    """Convolutions, a convolutional GRU, and for each cell the scores of the classes and the distances to the sides."""

    def __init__(self, channels: int = 40) -> None:
        super().__init__()
        self.stem = nn.Sequential(
            nn.Conv2d(2 * BINS, 16, 3, 2, 1), nn.ReLU(), nn.Conv2d(16, 32, 3, 2, 1), nn.ReLU(),
            nn.Conv2d(32, channels, 3, 2, 1), nn.ReLU(),
        )  # fmt: skip
        self.gates = nn.Conv2d(2 * channels, 2 * channels, 3, 1, 1)
        self.fresh = nn.Conv2d(2 * channels, channels, 3, 1, 1)
        self.head = nn.Sequential(
            nn.Conv2d(channels, channels, 3, 1, 1), nn.ReLU(), nn.Conv2d(channels, CLASSES + 4, 3, 1, 1)
        )

    def forward(self, histograms: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return logits [B, T, classes, h, w] and distances [B, T, 4, h, w], px, of histograms [B, T, 2 bins, H, W]."""
        features = self.stem(histograms.flatten(0, 1)).unflatten(0, histograms.shape[:2])
        state, states = torch.zeros_like(features[:, 0]), []
        for now in features.unbind(1):
            update, reset = self.gates(torch.cat([now, state], 1)).sigmoid().chunk(2, 1)
            fresh = self.fresh(torch.cat([now, reset * state], 1)).tanh()
            state = (1 - update) * state + update * fresh
            states.append(state)
        out = self.head(torch.stack(states, 1).flatten(0, 1)).unflatten(0, histograms.shape[:2])
        return out[:, :, :CLASSES] - 3, out[:, :, CLASSES:].clamp(-2, 3).exp() * STRIDE


def cell_centres(side: int) -> torch.Tensor:
    """Return x and y, twice, of the centre of each cell, px: [4, side, side]."""
    line = (torch.arange(side) + 0.5) * STRIDE
    return torch.stack([line.expand(side, side), line[:, None].expand(side, side)] * 2)


def loss_of(scores: torch.Tensor, distances: torch.Tensor, batch: Batch) -> torch.Tensor:
    """Return the focal loss of the scores, plus the error of the log distances in the middle of each box."""
    wanted, sides, where = torch.zeros_like(scores), torch.ones_like(distances), cell_centres(scores.shape[-1])
    for (b, t), boxes in zip(np.ndindex(*scores.shape[:2]), chain(*batch.boxes), strict=True):
        for box in boxes:  # the smallest comes last and wins its cells
            size, middle = box[2:4] - box[:2], (box[:2] + box[2:4]) / 2
            near = ((where[:2] - middle[:, None, None]).abs() <= (size / 6).clamp(STRIDE / 2)[:, None, None]).all(0)
            wanted[b, t, int(box[4]), near] = 1
            sides[b, t, :, near] = ((where - box[:4, None, None]) * SIGNS)[:, near].clamp(0.5)
    cells, count = wanted.amax(2, keepdim=True), wanted.sum().clamp(1)
    focal = (wanted - scores.sigmoid()) ** 2 * F.binary_cross_entropy_with_logits(scores, wanted, reduction="none")
    return (focal.sum() + (cells * (distances.log() - sides.log()).abs()).sum()) / count


def overlap(one: torch.Tensor, other: torch.Tensor) -> torch.Tensor:
    """Return intersection over union of boxes [..., 4]."""
    sides = torch.minimum(one[..., 2:], other[..., 2:]) - torch.maximum(one[..., :2], other[..., :2])
    common, areas = sides.clamp(0).prod(-1), [(each[..., 2:] - each[..., :2]).prod(-1) for each in (one, other)]
    return common / (areas[0] + areas[1] - common)


def detections(scores: torch.Tensor, distances: torch.Tensor) -> list[tuple[float, torch.Tensor]]:
    """Return score and corners of the boxes of one class in one frame, the best first, without doubles."""
    found, corners = list[tuple[float, torch.Tensor]](), (cell_centres(len(scores)) - distances * SIGNS).flatten(1).T
    for score, place in zip(*scores.sigmoid().flatten().topk(40), strict=True):
        if all(overlap(corners[place], box) < 0.4 for _, box in found):
            found.append((float(score), corners[place]))
    return found


@torch.no_grad()
def average_precision(network: Detector, dataset: V2VStreamDataset) -> float:
    """Return AP50: the mean over the classes of the area under the curve of precision over recall."""
    hits, counts = [list[tuple[float, bool]]() for _ in range(CLASSES)], [0] * CLASSES
    for batch in dataset:
        scores, distances = network(stacked_histogram(batch.event_counts, 8).float())
        boxes = batch.boxes
        for b, t, kind in np.ndindex(*scores.shape[:3]):
            true = [box[:4] for box in boxes[b][t] if box[4] == kind]
            counts[kind] += len(true)
            for score, box in detections(scores[b, t, kind], distances[b, t]):
                overlaps = [float(overlap(box, each)) for each in true]
                is_hit = max(overlaps, default=0.0) >= 0.5
                hits[kind].append((score, is_hit))
                if is_hit:  # each object counts once
                    del true[int(np.argmax(overlaps))]
    areas = []
    for found, total in zip(hits, counts, strict=True):
        right = np.array([hit for _, hit in sorted(found, reverse=True)], float)
        precision = right.cumsum() / np.arange(1, len(right) + 1)
        areas.append((np.maximum.accumulate(precision[::-1])[::-1] * right).sum() / max(1, total))
    return float(np.mean(areas))


def main(argv: Sequence[str] | None = None) -> int:
    """Train, judge, and print AP50."""
    parser = argparse.ArgumentParser(description="Train a recurrent detector on events of labelled videos.")
    parser.add_argument("--videos", required=True, help="folder of videos with boxes beside them, to train on")
    parser.add_argument("--held-out", required=True, help="folder of such videos to judge on")
    parser.add_argument("--minutes", type=float, default=10.0, help="processor time to train for, minutes")
    options = parser.parse_args(argv)
    torch.manual_seed(0)
    network = Detector()
    optimizer = torch.optim.Adam(network.parameters(), 2e-3)
    began = time.process_time()
    with V2VStreamDataset.local(options.videos, 4, ARRAYS, RECIPE, workers=1) as dataset:
        for step, batch in enumerate(chain.from_iterable(repeat(dataset))):
            spent = (time.process_time() - began) / 60 / options.minutes
            optimizer.param_groups[0]["lr"] = 2e-3 * min(1.0, 2.05 - 2 * spent)
            scores, distances = network(stacked_histogram(batch.event_counts, 8).float())
            loss = loss_of(scores, distances, batch)
            optimizer.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            nn.utils.clip_grad_norm_(network.parameters(), 5.0)
            optimizer.step()
            if step % 50 == 0 or spent >= 1:
                print(f"step {step}, {spent:.0%} of the time: loss {loss.item():.3f}", flush=True)
            if spent >= 1:
                break
    with V2VStreamDataset.local(options.held_out, 2, ARRAYS, RECIPE, workers=1) as dataset:
        print(f"AP50 on {options.held_out}: {average_precision(network.eval(), dataset):.3f}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
