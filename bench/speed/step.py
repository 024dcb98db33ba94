"""Time one training step on resident data, by precision, memory format and how it is launched.

    python -m bench step                                     # FireNet as in firenet-cpu, on the device there is
    python -m bench step e2vid --batch 12 --grids 40 --crop 128 --launches eager,graph

The whole step of `v2v-train` on one batch that stays on the device: forward, loss, backward, optimiser, average. No
stream, no copies. The loss is L1, or for a flow network the error of flow, unless `--set` names more. Each of `ieee`,
`tf32` and `bf16` is taken with NCHW and NHWC, `eager`, with one turn of each loop compiled (`compile`) and as one CUDA
graph (`graph`). On a processor `tf32` equals `ieee`, and there is no graph: these are left out. Beside the time stand
its ratio to the first row and, on a GPU, the peak of allocated memory. The last line is the fastest one's settings.
"""

from __future__ import annotations

import argparse
import itertools
import statistics
import time
from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any, cast

import torch

from bench.frame import Column, Report, add_whole, chosen, progress
from trainer.config import TrainConfig
from trainer.config_file import load_config
from trainer.learner import Learner, build
from trainer.models import NETWORKS
from trainer.run.distributed import Ranks, ranks
from trainer.tasks import Work
from v2v_client import Batch
from v2v_protocol.command import Parser
from v2v_protocol.errors import UsageError
from v2v_protocol.sample import array_layout

PRECISIONS = {"ieee": "float32", "tf32": "tf32", "bf16": "bfloat16"}
FORMATS = {"NCHW": False, "NHWC": True}
LAUNCHES: Mapping[str, Mapping[str, Any]] = {
    "eager": {},
    "compile": {"compute.compile": "step"},
    "graph": {"compute.cuda_graph": True},
}
"""Settings of each way to launch a step."""
WARM_UP_STEPS = 5
"""A CUDA graph is recorded in the fourth step."""
EVENT_SHARE = 0.2
"""Share of the bins of a pixel that hold an event."""
_COLUMNS: tuple[Column, ...] = (
    ("precision", "precision", "{}", 1),
    ("format", "format", "{}", 1),
    ("launch", "launch", "{}", 1),
    ("seconds", "ms a step", "{:.1f}", 1e3),
    ("ratio", "of the first", "{:.2f}", 1),
    ("peak_bytes", "peak, MiB", "{:.0f}", 2**-20),
    ("failed", "failed", "{}", 1),
)


def add_flags(parser: Parser) -> None:
    """Add the bench's flags."""
    parser.add_argument("config", nargs="?", default="firenet-cpu", help="of v2v-train (default firenet-cpu)")
    parser.add_argument(
        "--device", choices=("auto", "cpu", "cuda"), default="auto", help="default: a GPU if there is one"
    )
    add_whole(parser, "--batch", 2, "samples of a batch")
    add_whole(parser, "--grids", 20, "voxel grids of a sample")
    add_whole(parser, "--crop", 64, "side of a sample, px", least=16)
    add_whole(parser, "--steps", 5, "timed steps of each row; the median counts")
    add_whole(parser, "--threads", 1, "threads of PyTorch on a processor")
    for flag, words in (("--precisions", PRECISIONS), ("--launches", LAUNCHES)):
        parser.add_argument(flag, metavar="A,B", help=f"some of {','.join(words)} (default all)")
    parser.add_argument("--set", dest="settings", action="append", default=[], metavar="KEY=VALUE", help="of v2v-train")


def configuration(asked: argparse.Namespace, device: torch.device, more: Mapping[str, Any]) -> TrainConfig:
    """Return the configuration of a row: the named one on this batch, with plain losses, then ``--set``."""
    is_flow = NETWORKS[load_config(asked.config).network.name].task == "flow"
    losses = ["loss.flow=stream"] if is_flow else ["loss.lpips_weight=0", "loss.temporal_weight=0", "loss.l1_weight=1"]
    shape = {"voxels_per_clip": asked.grids, "crop_height_px": asked.crop, "crop_width_px": asked.crop}
    fixed = {"stream.list": "", "stream.batch_size": asked.batch, "compute.device": device.type}
    fixed |= {f"stream.recipe.{name}": value for name, value in shape.items()}
    own = [f"{name}={value}" for name, value in fixed.items()]
    return load_config(
        asked.config, [*own, *losses, *asked.settings, *(f"{name}={value}" for name, value in more.items())]
    )


def resident(learner: Learner) -> Work:
    """Return a batch of random arrays on the device: events in a fifth of the bins, and what the loss compares with."""
    stream, asked = learner.config.stream, learner.task.asked
    random = torch.Generator().manual_seed(0)
    arrays = {}
    for name, (dtype, shape) in array_layout(asked.recipe(stream.resolved_recipe), "int8", asked.arrays).items():
        high = 256 if name == "frames" else 2
        values = torch.randint(0, high, (stream.batch_size, *shape), generator=random)
        if name == "voxels":
            values = (2 * values - 1) * (torch.rand(values.shape, generator=random) < EVENT_SHARE)
        arrays[name] = values.to(getattr(torch, dtype))
    return learner.task.prepare(cast(Batch, SimpleNamespace(arrays=arrays)), None)


def seconds_of(learner: Learner, steps: int) -> float:
    """Return the median time of a step, after some that warm up."""

    def wait() -> None:
        if learner.device.type == "cuda":
            torch.cuda.synchronize(learner.device)

    work, times = resident(learner), []
    for step in range(WARM_UP_STEPS + steps):
        wait()
        began = time.perf_counter()
        learner.step(work, step, 0)
        wait()
        times.append(time.perf_counter() - began)
    return statistics.median(times[WARM_UP_STEPS:])


def timed(asked: argparse.Namespace, device: torch.device, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return time and peak memory of a row, or why it has none: memory that is short, no compiler."""
    on_gpu = device.type == "cuda"
    try:
        if on_gpu:
            torch.cuda.empty_cache()
            torch.cuda.reset_peak_memory_stats()
        learner = build(configuration(asked, device, settings), Ranks(0, 1, device))
        found = {"seconds": seconds_of(learner, asked.steps)}
        return found | ({"peak_bytes": torch.cuda.max_memory_allocated()} if on_gpu else {})
    except RuntimeError as error:
        return {"failed": str(error).partition("\n")[0][:80]}
    finally:
        torch._dynamo.reset()


def measure(asked: argparse.Namespace) -> Report:
    """Time all rows; return a record for each.

    Raises:
        UsageError: a wrong configuration, or no row could run.
    """
    torch.set_num_threads(asked.threads)
    with ranks(asked.device, 60) as mine:
        device = mine.device
    on_gpu = device.type == "cuda"
    precisions = chosen(asked.precisions, PRECISIONS, "--precisions")
    launches = chosen(asked.launches, LAUNCHES, "--launches")
    records: list[dict[str, Any]] = []
    for precision, layout, launch in itertools.product(precisions, FORMATS, launches):
        if not on_gpu and (precision == "tf32" or launch == "graph"):
            continue
        settings = {"compute.precision": PRECISIONS[precision], "compute.channels_last": FORMATS[layout]}
        settings |= LAUNCHES[launch]
        progress(f"{precision} {layout} {launch}")
        row = {"precision": precision, "format": layout, "launch": launch, **timed(asked, device, settings)}
        said = " ".join(f"{key}={str(value).lower()}" for key, value in settings.items())
        records.append({"config": asked.config, "device": str(device), **row, "settings": said})
    ran = [record for record in records if "seconds" in record]
    if not ran:
        why = records[0]["failed"] if records else f"tf32 and graph need a GPU, and the device is {device}"
        raise UsageError(f"{asked.config}: no row could run: {why}")
    for record in ran:
        record["ratio"] = record["seconds"] / ran[0]["seconds"]
    fastest = min(ran, key=lambda record: record["seconds"])
    return Report(records, [(records, _COLUMNS)], [f"fastest: {fastest['settings']}"])
