"""Check that every network learns: train each repeatedly on the same four clips, and draw its loss.

    python examples/overfit.py --videos .demo/videos --work /tmp/overfit --plot overfit.png

The first four videos of the folder are shrunk to 32 x 32 pixels, and a noise-free virtual camera sees all of each.
A correctly built network can overfit to four clips. The networks are small enough for some minutes on a processor.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterable, Sequence
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np

from trainer.run.reporting import METRICS_FILE, read_metrics
from trainer.train import main as train

SIDE_PX = 32
VOXELS = 6
FRAMES = 5 * (VOXELS + 1) + 1
NARROW = {"base_channels": 8}
RUNS: dict[str, dict[str, Any]] = {
    "firenet": {"network.options": NARROW, "optimizer.learning_rate": 5e-3},
    "e2vid": {"network.options": NARROW, "optimizer.learning_rate": 2e-3},
    "hypere2vid": {"network.options": NARROW, "optimizer.learning_rate": 2e-3, "loss.guide_epochs": 16},
    "etnet": {"network.options": NARROW, "optimizer.learning_rate": 1e-3, "optimizer.name": "adamw"},
    "evflownet": {"network.options": NARROW, "optimizer.learning_rate": 1e-3, "loss": {"flow": "stream"}},
    "eraft": {
        "network.options": {}, "optimizer.learning_rate": 2e-4, "loss": {"flow": "stream"}, "run.steps": 20,
        "stream.recipe.voxels_per_clip": 2,
    },
}  # fmt: skip
"""Settings that differ between the networks; :data:`_TINY` and :func:`overfit` have the common ones."""


def squares(path: Path) -> list[np.ndarray[Any, np.dtype[np.uint8]]]:
    """Return the central squares of the first frames, shrunk; fewer than FRAMES if the file is short or damaged."""
    found = []
    with suppress(av.FFmpegError, IndexError), av.open(str(path)) as container:
        for frame in islice(container.decode(video=0), FRAMES):
            grey = frame.to_ndarray(format="gray")
            side = min(grey.shape)
            top, left = ((length - side) // 2 for length in grey.shape)
            square = np.ascontiguousarray(grey[top : top + side, left : left + side], np.uint8)
            found.append(np.asarray(cv2.resize(square, (SIDE_PX, SIDE_PX), interpolation=cv2.INTER_AREA), np.uint8))
    return found


def shrink(videos: Iterable[Path], folder: Path, clips: int) -> None:
    """Write the first frames of ``clips`` videos as lossless clips of one sequence each; skip unusable files."""
    folder.mkdir(parents=True, exist_ok=True)
    usable = ((path, frames) for path in videos if len(frames := squares(path)) == FRAMES)
    for path, frames in islice(usable, clips):
        with av.open(str(folder / f"{path.stem}.mkv"), "w") as written:
            stream = written.add_stream("ffv1", rate=25)
            stream.width, stream.height, stream.pix_fmt = SIDE_PX, SIDE_PX, "gray"
            for small in frames:
                written.mux(stream.encode(av.VideoFrame.from_ndarray(small, format="gray")))
            written.mux(stream.encode())


def overfit(name: str, clips: Path, out: Path, **changes: Any) -> list[tuple[int, float]]:
    """Train a network of :data:`RUNS`, and return step and loss of each reading."""
    settings = {
        "network.name": name, "stream.batch_size": 4, "run.seconds": 0, "run.steps": 100, "run.log_every": 2,
        "run.judge_every": 0, "run.preview_every": 0, "stream.recipe.preset": "noise-free",
        "stream.recipe.voxels_per_clip": VOXELS, "stream.recipe.threshold": 0.15, "stream.recipe.threshold_ratio": 1.0,
        "stream.recipe.flip_probability": 0.0, "stream.recipe.noise_sigma": 0.0, "optimizer.ema_decay": 0.0,
        **RUNS[name], **changes,
    }  # fmt: skip
    loss = settings.pop("loss", None)
    configuration = out.with_suffix(".yaml")
    configuration.parent.mkdir(parents=True, exist_ok=True)
    own = "" if loss is None else f"loss: {json.dumps(loss)}\n"
    configuration.write_text(f"network: {{name: {name}}}\n{own}{_TINY}", encoding="utf-8")
    given = [f"{key}={json.dumps(value)}" for key, value in settings.items()]
    flags = [text for setting in given for text in ("--set", setting)]
    if train([str(configuration), "--videos", str(clips), "--out", str(out), *flags]):
        raise SystemExit(1)
    return [(record["step"], record["total"]) for record in read_metrics(out / METRICS_FILE) if "total" in record]


_TINY = f"""
stream: {{workers: 1, recipe: {{crop_height_px: {SIDE_PX}, crop_width_px: {SIDE_PX}}}}}
optimizer: {{amsgrad: false, clip_gradient_norm: 1.0}}
compute: {{device: cpu, threads: 1}}
run: {{epochs: 100000}}
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--videos", required=True, type=Path, help="folder with at least four videos")
    parser.add_argument("--work", required=True, type=Path, help="empty folder for clips and runs")
    parser.add_argument("--plot", type=Path, help="PNG to write with the curves")
    parser.add_argument("--networks", default=",".join(RUNS), help="networks to train (default %(default)s)")
    asked = parser.parse_args(arguments)
    shrink(sorted(asked.videos.iterdir()), asked.work / "clips", 4)
    curves = {name: overfit(name, asked.work / "clips", asked.work / name) for name in asked.networks.split(",")}
    for name, curve in curves.items():
        first, last = curve[0][1], curve[-1][1]
        print(f"{name}: loss {first:.4f} at step {curve[0][0]}, {last:.4f} at step {curve[-1][0]} ({last / first:.0%})")
    if asked.plot is not None:
        draw(curves, asked.plot)
    return 0


def draw(curves: dict[str, list[tuple[int, float]]], path: Path) -> None:
    """Draw the loss over steps, relative to the first reading."""
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(figsize=(7, 3.5))
    for name, curve in curves.items():
        axes.plot([step for step, _ in curve], [loss / curve[0][1] for _, loss in curve], label=name, linewidth=1.2)
    axes.set_title("Overfitting to four clips: does each network learn them?")
    axes.set_xlabel("optimiser step")
    axes.set_ylabel("loss / first loss")
    axes.set_ylim(0, 1.1)
    axes.legend(frameon=False)
    figure.tight_layout()
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    sys.exit(main())
