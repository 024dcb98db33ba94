"""Run `make demo`.

It draws a reconstruction by the shipped network, streams real clips through a server into a dataset, prints the batches
per second, draws a batch, and trains for a minute.

python -m examples.demo --videos DIR --picture out/demo.png
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

from examples.demo_reconstruction import reconstruct
from examples.demo_training import judge
from v2v_client import Batch, V2VStreamDataset
from v2v_client.local_server import LocalServer
from v2v_pictures.camera import Camera
from v2v_pictures.files import write_png
from v2v_pictures.sheet import draw_sheet

_BATCH_SIZE = 4
_WARMUP_BATCHES = 2
_SHOWN = 4
_VOXELS_PER_CLIP = 10
_CONFIGURATION = "finetune-cpu"
_HELD_OUT = "bikes.mp4"
"""A clip that the shipped network was not trained on."""


def main() -> int:
    """Run the demo. Return 0, or 1 if the trained network is no better than a grey picture."""
    parser = argparse.ArgumentParser(description="Stream real clips through a server into a dataset, then train.")
    parser.add_argument("--videos", required=True, metavar="DIR")
    parser.add_argument(
        "--picture", required=True, metavar="FILE.png", help="PNG to write; training.png and training/ go next to it"
    )
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--seconds", type=float, default=10.0, help="seconds to stream without training")
    parser.add_argument("--training-seconds", type=float, default=60.0)
    arguments = parser.parse_args()
    picture = Path(arguments.picture)
    picture.parent.mkdir(parents=True, exist_ok=True)

    os.environ.pop("V2V_KEYS", None)  # a key for other servers; this one needs no key
    reconstruct(Path(arguments.videos) / _HELD_OUT, picture.with_name("reconstruction.png"))
    with LocalServer(arguments.videos, workers=arguments.workers) as server:
        _stream(server.address, arguments.seconds, arguments.workers, picture)
        run = picture.parent / "training"
        shutil.rmtree(run, ignore_errors=True)
        trained = subprocess.run(
            [
                *(sys.executable, "-m", "trainer.train", _CONFIGURATION, "--connect", server.address),
                *("--out", str(run), "--set", f"run.seconds={arguments.training_seconds}"),
            ],
            check=False,
        )
        if trained.returncode:
            return trained.returncode
        return 0 if judge(server.address, _CONFIGURATION, run, picture.with_name("training.png")) else 1


def _stream(address: str, seconds: float, workers: int, picture: Path) -> None:
    # The demo's clips are short: 10 voxel grids need 51 frames, the paper's 40 need 201.
    recipe = {"preset": "paper", "voxels_per_clip": _VOXELS_PER_CLIP}
    dataset = V2VStreamDataset(address, batch_size=_BATCH_SIZE, recipe=recipe)
    batches, started, last = 0, 0.0, ""
    while not batches or time.monotonic() - started < seconds:
        for batch in dataset:
            batches, last = batches + 1, repr(batch)
            if batches == _WARMUP_BATCHES:
                started = time.monotonic()
    elapsed = time.monotonic() - started

    counted = batches - _WARMUP_BATCHES
    print(f"last batch: {last}")
    print(
        f"{counted / elapsed:.2f} batches/s ({counted * _BATCH_SIZE / elapsed:.1f} samples/s) over {elapsed:.1f} s "
        f"with {workers} workers; batches of {_BATCH_SIZE} clips of {_VOXELS_PER_CLIP} voxel grids, "
        f"first {_WARMUP_BATCHES} batches not counted"
    )
    with_flow = V2VStreamDataset(address, _SHOWN, ("voxels", "frames", "flow"), recipe)
    cameras = _cameras(next(iter(with_flow)))
    write_png(picture, draw_sheet(cameras, f"{len(cameras)} samples of the stream, each with its own virtual camera"))
    print(f"picture: {picture}")


def _cameras(batch: Batch) -> list[Camera]:
    arrays = {name: tensor.numpy() for name, tensor in batch.arrays.items()}
    return [
        Camera.of({name: array[number] for name, array in arrays.items()}, batch.provenance[number], "")
        for number in range(len(batch))
    ]


if __name__ == "__main__":
    sys.exit(main())
