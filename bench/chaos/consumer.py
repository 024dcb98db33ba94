"""A consumer of the chaos bench: a process that streams, logs its samples, saves its state, and may be killed anywhere.

    python -m bench.chaos.consumer --address tcp://127.0.0.1:5555 --profile 0 --folder DIR

It continues from the state in DIR, if there is one, until SIGTERM.
"""

from __future__ import annotations

import argparse
import json
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path

from tests.oracles.stream import Profile
from tests.oracles.stream_log import BatchLine, LifeLine, LogWriter, sighting
from v2v_protocol.errors import V2VError
from v2v_protocol.keys import leaves_host
from v2v_protocol.write_aside import write_aside_and_rename

_SMALL = {"preset": "paper", "voxels_per_clip": 4, "crop_height_px": 32, "crop_width_px": 40}
# Small samples in large numbers, the paper's 40 voxel grids of 128 x 128, and a slow consumer of siblings, sub-steps,
# colour and labels.
PROFILES = (
    Profile({"recipe": _SMALL, "max_sequences_per_video": 100}, seed=1, batch_size=4, think_seconds=0.02, save_every=5),
    Profile({"recipe": {"preset": "paper"}}, seed=2, batch_size=1),
    Profile(
        {
            "recipe": {**_SMALL, "preset": "paper-contrast", "voxels_per_clip": 6},
            "voxel_dtype": "int16",
            "samples_per_decode": 3,
            "sibling_spacing": 3,
            "substep_px": 0.5,
        },
        seed=2**63 + 5,
        batch_size=3,
        think_seconds=0.2,
        save_every=3,
        arrays=("voxels", "frames", "frames_rgb", "boxes", "masks"),
    ),
    # The stream of the first one in other batches: the samples of the two are compared with each other.
    Profile({"recipe": _SMALL, "max_sequences_per_video": 100}, seed=1, batch_size=5, think_seconds=0.05),
    # More memory than a worker of 1 GiB has.
    Profile(
        {
            "recipe": {"preset": "paper", "voxels_per_clip": 30, "crop_height_px": 300, "crop_width_px": 580},
            "substep_px": 0.5,
        },
        seed=4,
        batch_size=1,
    ),
)
LARGE = 4
"""Number of the profile of large clips."""


def profile(number: int) -> Profile:
    """Return the profile of consumer ``number``; profiles repeat after the last."""
    return PROFILES[number % len(PROFILES)]


def log_path(folder: Path) -> Path:
    """Return the path of the log in a consumer's folder."""
    return folder / "log.jsonl"


def consume(address: str, asked: Profile, folder: Path, stopped: Callable[[], bool]) -> None:
    """Stream until ``stopped`` returns True.

    Args:
        address, asked, folder: as on the command line.
        stopped: whether SIGTERM has arrived: Python drops an exception that a signal handler raises in a finalizer.

    Raises:
        V2VError: as the dataset raises it; no fault of the chaos bench may cause one.
    """
    # Import lazily: the fleet reads the profiles without PyTorch.
    from v2v_client.dataset import V2VStreamDataset

    dataset = V2VStreamDataset(
        address,
        batch_size=asked.batch_size,
        arrays=asked.arrays,
        labels="optional",  # a corpus of --videos may have none
        seed=asked.seed,
        rank=0,
        world_size=1,
        shared_memory=not leaves_host(address),  # a network namespace may stand for another host
        **asked.spec,
    )
    state_path = folder / "state.json"
    saved = json.loads(state_path.read_text(encoding="utf-8")) if state_path.exists() else None
    committed = 0
    if saved is not None:
        dataset.load_state_dict(saved["resume_state"])
        committed = saved["committed"]
    log = LogWriter(log_path(folder))
    try:
        log.append(LifeLine(committed, time.monotonic()))
        while not stopped():
            for batch in dataset:
                if stopped():
                    return
                arrays = {name: tensor.numpy() for name, tensor in batch.arrays.items()}
                samples = tuple(
                    sighting({name: array[row] for name, array in arrays.items()}, batch.provenance[row])
                    for row in range(len(batch))
                )
                log.append(BatchLine(committed, batch.epoch, time.monotonic(), batch.wait_seconds, samples))
                committed += 1
                if committed % asked.save_every == 0:
                    with write_aside_and_rename(state_path) as partial:
                        state = {"committed": committed, "resume_state": batch.resume_state}
                        partial.write_text(json.dumps(state), encoding="utf-8")
                time.sleep(asked.think_seconds)
    finally:
        log.close()


def main() -> int:
    """Run the consumer; return the exit status."""
    parser = argparse.ArgumentParser(prog="python -m bench.chaos.consumer", description=__doc__)
    parser.add_argument("--address", required=True)
    parser.add_argument("--profile", type=int, required=True)
    parser.add_argument("--folder", type=Path, required=True)
    asked = parser.parse_args()
    stopped = False

    def leave(number: int, frame: object) -> None:
        nonlocal stopped
        stopped = True
        sys.exit(0)  # an exception, so that the dataset and its socket are closed

    signal.signal(signal.SIGTERM, leave)
    try:
        consume(asked.address, profile(asked.profile), asked.folder, lambda: stopped)
    except V2VError as error:
        print(f"consumer {asked.profile}: {type(error).__name__}: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
