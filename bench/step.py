"""Time and memory of one optimiser step of every network, full width, at a small size.

    v2v-bench step --voxels 10 --side 64 --batch-size 2

Each network in a process of its own: forward through all voxel grids, L1 loss, backward, Adam. Batches are random and
made before, so that nothing of the stream is timed.

    s a step       median of the steps, and the fastest; processor: of the processor, which other work disturbs less
    voxel grids/s  of all samples together
    MiB            the most that the process held beyond what it held before the network was built; of a GPU, the most
                   that PyTorch had given out
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from bench.records import Column, at_least, plain_parser, run, show, write
from trainer.captured import WARM_UP_STEPS
from trainer.config import TrainConfig
from trainer.learner import build
from trainer.models import NETWORKS
from trainer.run.distributed import Ranks
from v2v_client.batch import Batch
from v2v_protocol.errors import UsageError
from v2v_protocol.sample import array_layout

_MIB = 1 << 20
_COLUMNS: tuple[Column, ...] = (
    ("network", "", "{}", 1.0),
    ("parameters", "parameters", "{:,}", 1),
    ("seconds", "s a step", "{:.3f}", 1.0),
    ("fastest_seconds", "fastest", "{:.3f}", 1.0),
    ("processor_seconds", "processor", "{:.3f}", 1.0),
    ("voxel_grids_per_second", "voxel grids/s", "{:.1f}", 1.0),
    ("memory_mib", "MiB", "{:.0f}", 1.0),
)


def measure(
    name: str, compute: Mapping[str, Any], side: int, voxels: int, batch_size: int, steps: int
) -> dict[str, Any]:
    """One network, in this process; the first steps, which allocate, compile and record, are left out.

    Args:
        name: of the network.
        compute: section of that name of its configuration.
        side, voxels, batch_size: of the batch.
        steps: timed.
    """
    device = compute["device"]
    torch.set_num_threads(1)
    loss = {"flow": "stream"} if NETWORKS[name].task == "flow" else {"lpips_weight": 0.0, "temporal_weight": 0.0}
    recipe = {"preset": "paper", "voxels_per_clip": voxels, "crop_height_px": side, "crop_width_px": side}
    config = TrainConfig.from_dict(
        {"network": {"name": name}, "stream": {"recipe": recipe}, "loss": loss, "compute": compute}
    )
    before = _held(device)
    learner = build(config, Ranks(0, 1, torch.device(device)))
    asked = learner.task.asked
    draw = np.random.default_rng(0)
    layout = array_layout(asked.recipe(config.stream.resolved_recipe), "int8", asked.arrays)
    arrays = {
        array: torch.from_numpy(draw.integers(0, 3, (batch_size, *shape)).astype(dtype))
        for array, (dtype, shape) in layout.items()
    }
    batch = Batch(
        arrays=arrays, indices=tuple(range(batch_size)), epoch=0, provenance=(), resume_state={}, wait_seconds=0.0,
        cpu_seconds=0.0, decodes=batch_size,
    )  # fmt: skip
    seconds, processor = [], []
    untimed = WARM_UP_STEPS + 1 if compute["cuda_graph"] else 1
    for step in range(untimed + steps):
        began, spent = time.perf_counter(), time.process_time()
        values = learner.step(learner.task.prepare(batch, 0), step, 0)
        float(values["total"])  # waits for a GPU
        seconds.append(time.perf_counter() - began)
        processor.append(time.process_time() - spent)
    del seconds[:untimed], processor[:untimed]
    median = statistics.median(seconds)
    return {
        "network": name,
        "device": device,
        "compile": compute["compile"],
        "cuda_graph": compute["cuda_graph"],
        "parameters": sum(parameter.numel() for parameter in learner.trained.parameters()),
        "side_px": side,
        "voxels_per_clip": voxels,
        "batch_size": batch_size,
        "seconds": median,
        "fastest_seconds": min(seconds),
        "processor_seconds": statistics.median(processor),
        "voxel_grids_per_second": batch_size * voxels / median,
        "memory_mib": (_held(device) - before) / _MIB,
    }


def _held(device: str) -> float:
    if device == "cuda":
        return float(torch.cuda.max_memory_allocated())
    # getrusage's peak begins with that of the process that started this one.
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return 1024.0 * int(next(line for line in lines if line.startswith("VmHWM")).split()[1])


def _apart(name: str, asked: argparse.Namespace) -> dict[str, Any]:
    """In a process of its own, whose greatest memory is that of this network.

    Raises:
        UsageError: it could not be measured; the message quotes what was said.
    """
    numbers = {"--side": asked.side, "--voxels": asked.voxels, "--batch-size": asked.batch_size, "--steps": asked.steps}
    command = [sys.executable, "-m", "bench.step", "--networks", name, "--device", asked.device, "--here"]
    command += ["--compile", asked.compile, *(["--cuda-graph"] if asked.cuda_graph else [])]
    command += [str(part) for pair in numbers.items() for part in pair]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise UsageError(f"{name}: {done.stderr.strip()[-500:]}")
    record: dict[str, Any] = json.loads(done.stdout)
    return record


def _work(asked: argparse.Namespace) -> int:
    at_least(asked, side=16, voxels=1, batch_size=1, steps=1)
    names = asked.networks.split(",")
    if unknown := set(names) - set(NETWORKS):
        raise UsageError(f"--networks {', '.join(sorted(unknown))}: choose of {', '.join(NETWORKS)}")
    if asked.here:
        compute = {
            "device": asked.device, "threads": 1, "compile": asked.compile, "cuda_graph": asked.cuda_graph,
        }  # fmt: skip
        print(json.dumps(measure(names[0], compute, asked.side, asked.voxels, asked.batch_size, asked.steps)))
        return 0
    records = [_apart(name, asked) for name in names]
    show(records, _COLUMNS)
    write(records, asked.json)
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line."""
    parser = plain_parser(__doc__, "step")
    parser.add_argument("--networks", default=",".join(NETWORKS), metavar="A,B", help="default: all")
    parser.add_argument("--device", default="cpu", choices=("cpu", "cuda"), help="default cpu, one thread")
    parser.add_argument("--compile", default="none", choices=("none", "step", "clip"), help="compute.compile")
    parser.add_argument("--cuda-graph", action="store_true", help="compute.cuda_graph")
    parser.add_argument("--side", type=int, default=64, help="pixels of a crop's side (default 64)")
    parser.add_argument("--voxels", type=int, default=10, help="voxel grids of a sample (default 10)")
    parser.add_argument("--batch-size", type=int, default=2, help="default 2")
    parser.add_argument("--steps", type=int, default=3, help="timed (default 3)")
    parser.add_argument("--here", action="store_true", help=argparse.SUPPRESS)
    return run(parser, _work, arguments)


if __name__ == "__main__":
    sys.exit(main())
