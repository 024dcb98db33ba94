"""A consumer of the chaos test: a process that streams, logs what it got, saves its state, and may be killed anywhere.

    python -m bench.chaos.consumer --address tcp://127.0.0.1:5555 --profile 0 --folder DIR

It goes on from the state in DIR, if there is one, until SIGTERM.
"""

from __future__ import annotations

import argparse
import json
import signal
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bench.chaos.log import BatchLine, LifeLine, LogWriter, sighting
from v2v_protocol.addresses import leaves_host
from v2v_protocol.errors import V2VError
from v2v_protocol.spec import StreamSpec


@dataclass(frozen=True, slots=True)
class Profile:
    """What one consumer asks for, and how fast it is.

    Attributes:
        spec: fields of its stream's spec.
        seed, batch_size: of its stream.
        think_seconds: pause after each batch.
        save_every: batches between two savings of the state, as a trainer has steps between two checkpoints.
    """

    spec: Mapping[str, Any]
    seed: int
    batch_size: int
    think_seconds: float = 0.0
    save_every: int = 1

    @property
    def stream_spec(self) -> StreamSpec:
        """The resolved spec, which must not depend on the server's defaults."""
        return StreamSpec.from_dict(self.spec)

    @property
    def stream(self) -> str:
        """Names the stream: equal names must mean equal bytes."""
        return f"{self.stream_spec.digest}:{self.seed}"


_SMALL = {"preset": "paper", "voxels_per_clip": 4, "crop_height_px": 32, "crop_width_px": 40}
PROFILES = (
    Profile({"recipe": _SMALL, "max_sequences_per_video": 100}, seed=1, batch_size=4, think_seconds=0.02, save_every=5),
    Profile({"recipe": {"preset": "paper"}}, seed=2, batch_size=1),
    Profile(
        {
            "recipe": {**_SMALL, "preset": "paper-contrast", "voxels_per_clip": 6},
            "voxel_dtype": "int16",
            "samples_per_decode": 3,
            "sibling_spacing": 3,
        },
        seed=2**63 + 5,
        batch_size=3,
        think_seconds=0.2,
        save_every=3,
    ),
    # The stream of the first one in other batches: all samples of the two are compared with each other.
    Profile({"recipe": _SMALL, "max_sequences_per_video": 100}, seed=1, batch_size=5, think_seconds=0.05),
)
"""Small samples in large numbers, the paper's 40 voxel grids of 128 x 128, and a slow consumer of siblings."""


def profile(number: int) -> Profile:
    """That of consumer ``number``; they repeat when there are more consumers than profiles."""
    return PROFILES[number % len(PROFILES)]


def log_path(folder: Path) -> Path:
    """The log in a consumer's folder."""
    return folder / "log.jsonl"


def consume(address: str, asked: Profile, folder: Path, timeout_seconds: float, told: Callable[[], bool]) -> None:
    """Streams until the process is told to end.

    Args:
        address, asked, folder, timeout_seconds: as on the command line.
        told: whether it was: Python drops an exception that a signal's handler raises within a finalizer.

    Raises:
        V2VError: what the dataset raises: nothing that the chaos test does may cause it.
    """
    # Here, because the checker reads the profiles without PyTorch.
    from v2v_client.dataset import V2VStreamDataset

    dataset = V2VStreamDataset(
        address,
        batch_size=asked.batch_size,
        seed=asked.seed,
        rank=0,
        world_size=1,
        timeout_seconds=timeout_seconds,
        shared_memory=not leaves_host(address),  # another host may be played by this one (bench/link)
        **asked.spec,
    )
    state_path = folder / "state.json"
    saved = json.loads(state_path.read_text(encoding="utf-8")) if state_path.exists() else None
    committed = 0
    if saved is not None:
        dataset.load_state_dict(saved["resume_state"])
        committed = saved["committed"]
    life_path = folder / "lives"
    lives = int(life_path.read_text(encoding="utf-8")) if life_path.exists() else 0
    _replace(life_path, str(lives + 1))
    log = LogWriter(log_path(folder))
    try:
        log.append(LifeLine(lives, committed, time.monotonic()))
        while not told():
            for batch in dataset:
                if told():
                    return
                arrays = {name: tensor.numpy() for name, tensor in batch.arrays.items()}
                samples = tuple(
                    sighting({name: array[row] for name, array in arrays.items()}, batch.provenance[row])
                    for row in range(len(batch))
                )
                log.append(BatchLine(committed, batch.epoch, time.monotonic(), batch.wait_seconds, samples))
                committed += 1
                if committed % asked.save_every == 0:
                    _replace(state_path, json.dumps({"committed": committed, "resume_state": batch.resume_state}))
                time.sleep(asked.think_seconds)
    finally:
        log.close()


def _replace(path: Path, text: str) -> None:
    """Whoever reads the file sees the old text or the new one."""
    partial = path.with_suffix(".partial")
    partial.write_text(text, encoding="utf-8")
    partial.replace(path)


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; returns the exit status."""
    parser = argparse.ArgumentParser(prog="python -m bench.chaos.consumer", description=__doc__)
    parser.add_argument("--address", required=True)
    parser.add_argument("--profile", type=int, required=True)
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--timeout-seconds", type=float, default=60.0)
    asked = parser.parse_args(arguments)
    told = False

    def leave(number: int, frame: object) -> None:
        nonlocal told
        told = True
        sys.exit(0)  # an exception, so that the dataset and its socket are closed as at the end of any program

    signal.signal(signal.SIGTERM, leave)
    try:
        consume(asked.address, profile(asked.profile), asked.folder, asked.timeout_seconds, lambda: told)
    except V2VError as error:
        print(f"consumer {asked.profile}: {type(error).__name__}: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
