"""`make demo`: real clips through a server into a dataset; batches a second, and a picture.

python -m examples.demo --videos DIR --picture out/demo.png
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from v2v_client import Batch, V2VStreamDataset
from v2v_client.local_server import LocalServer
from v2v_server.picture import Row, draw_rows, write_png

_BATCH_SIZE = 4
_WARMUP_BATCHES = 2
_VOXELS_PER_CLIP = 10


def main() -> None:
    """Runs the demo."""
    parser = argparse.ArgumentParser(description="Stream real clips through a server into a dataset.")
    parser.add_argument("--videos", required=True, metavar="DIR")
    parser.add_argument("--picture", required=True, metavar="FILE.png")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--seconds", type=float, default=10.0)
    arguments = parser.parse_args()

    with LocalServer(arguments.videos, workers=arguments.workers) as server:
        # The demo's clips are short: 10 voxel grids need 51 frames, the paper's 40 need 201.
        dataset = V2VStreamDataset(
            server.address, batch_size=_BATCH_SIZE, recipe={"preset": "paper", "voxels_per_clip": _VOXELS_PER_CLIP}
        )
        shown: list[Row] = []
        batches, started = 0, 0.0
        while not batches or time.monotonic() - started < arguments.seconds:
            for batch in dataset:
                if len(shown) < 6:
                    shown += _rows(batch)
                batches += 1
                if batches == _WARMUP_BATCHES:
                    started = time.monotonic()
        seconds = time.monotonic() - started

    counted = batches - _WARMUP_BATCHES
    print(f"last batch: {batch}")
    print(
        f"{counted / seconds:.2f} batches/s ({counted * _BATCH_SIZE / seconds:.1f} samples/s) over {seconds:.1f} s "
        f"with {arguments.workers} workers; batches of {_BATCH_SIZE} clips of {_VOXELS_PER_CLIP} voxel grids, "
        f"first {_WARMUP_BATCHES} batches left out"
    )
    picture = Path(arguments.picture)
    picture.parent.mkdir(parents=True, exist_ok=True)
    write_png(picture, draw_rows(shown[:6]))
    print(f"picture: {picture}")


def _rows(batch: Batch) -> list[Row]:
    """For the picture: of each sample the voxel grid with most events that still shows the scene."""
    rows = []
    arrays = {name: tensor.numpy() for name, tensor in batch.arrays.items()}
    for number in range(len(batch)):
        voxels, frames = arrays["voxels"][number], arrays["frames"][number]
        pick = int(abs(voxels.astype("int32")).sum(axis=(1, 2, 3)).argmax())
        rows.append(Row(frames[pick, 0], voxels[pick], batch.provenance[number], f"voxel {pick}"))
    return rows


if __name__ == "__main__":
    main()
