"""Whether server workers keep an accelerator busy: training from the stream, against training on one cached batch.

    python -m bench.speed.gpu_feed --videos CLIPS --workers 1,2,4,8 --json gpu_feed.json --plot gpu_feed.png

The trainer is E2VID (or another network of ``trainer.models``) with the L1 loss and Adam on whole clips; its ceiling is
what it does with one batch that lies on the device. Then the stream feeds it with each number of server workers,
through a DataLoader with one loader worker and pinned memory where the device is CUDA. Utilisation is the share of the
time in which the device computes (between CUDA events around every step; on the CPU, by the clock).

LPIPS, which training adds, needs weight files and is not part of it: a real step takes longer, and needs fewer workers.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.utils.data import DataLoader

from bench import plots
from bench.records import counts, parser_of, recipe_of, run, server_flags, show, write
from bench.usage import Meter, roles_of
from trainer.losses.reconstruction import ReconstructionLoss
from trainer.models import NETWORKS
from v2v_client.batch import Batch
from v2v_client.dataset import V2VStreamDataset
from v2v_client.local_server import LocalServer
from v2v_protocol.errors import UsageError

WARMUP_STEPS = 2
_COLUMNS = (
    ("measure", "", "{}", 1),
    ("workers", "workers", "{}", 1),
    ("batches_per_second", "batches/s", "{:.3f}", 1),
    ("utilisation", "utilisation", "{:.1%}", 1),
    ("share_of_ceiling", "of ceiling", "{:.1%}", 1),
    ("step_seconds", "step ms", "{:.1f}", 1e3),
    ("workers_cpu_seconds_per_batch", "workers CPU ms", "{:.1f}", 1e3),
    ("broker_cpu_seconds_per_batch", "broker CPU ms", "{:.1f}", 1e3),
    ("client_cpu_seconds_per_batch", "client CPU ms", "{:.1f}", 1e3),
)


class Trainer:
    """A network, its loss and its optimiser.

    Args:
        network: name in ``trainer.models.NETWORKS``.
        base_channels: of the network; None: its default.
        bins: of a voxel grid.
        device: where it computes.
        bfloat16: autocast of the forward pass.
    """

    def __init__(
        self, network: str, base_channels: int | None, bins: int, device: torch.device, bfloat16: bool
    ) -> None:
        torch.manual_seed(0)
        size: dict[str, Any] = {} if base_channels is None else {"base_channels": base_channels}
        self._network = NETWORKS[network](bins=bins, **size).to(device)
        self._loss = ReconstructionLoss().to(device)
        self._optimiser = torch.optim.Adam(self._network.parameters(), lr=1e-4)
        self._autocast = torch.autocast(device.type, torch.bfloat16, enabled=bfloat16)
        self.device = device

    def step(self, batch: Batch) -> Tensor:
        """One training step; returns the loss, which may not be computed yet.

        Args:
            batch: voxels and frames on the device.

        Raises:
            UsageError: the stream has no voxels or no frames.
        """
        self._optimiser.zero_grad(set_to_none=True)
        with self._autocast:
            prediction = self._network.forward_sequence(batch.voxels)
        # A target a picture: leading frames are those before the first voxel grid.
        target = batch.frames[:, -prediction.shape[1] :].to(prediction.dtype) / 255
        total: Tensor = self._loss(prediction, target)["total"]
        total.backward()  # type: ignore[no-untyped-call]
        self._optimiser.step()
        return total.detach()


@dataclass(frozen=True, slots=True)
class Trained:
    """What a measured stretch of training took.

    Attributes:
        batches: steps.
        seconds: wall time, the last step's computation included.
        busy_seconds: in which the device computed.
    """

    batches: int
    seconds: float
    busy_seconds: float


def train(trainer: Trainer, batches: Iterator[Batch], seconds: float, begin: Callable[[], None]) -> Trained:
    """Trains for that long after the warm-up, at least one step.

    Args:
        trainer: to be trained.
        batches: on any device.
        seconds: from the end of the warm-up on.
        begin: called at that moment.
    """
    on_device = trainer.device.type == "cuda"
    for _ in range(WARMUP_STEPS):
        trainer.step(next(batches).to(trainer.device, non_blocking=True))
    _finish(trainer.device)
    begin()
    events: list[tuple[Any, Any]] = []
    busy, taken, began = 0.0, 0, time.perf_counter()
    while not taken or time.perf_counter() - began < seconds:
        batch = next(batches).to(trainer.device, non_blocking=True)
        if on_device:
            events.append((_event(), _event()))
            events[-1][0].record()
        started = time.perf_counter()
        trainer.step(batch)
        if on_device:
            events[-1][1].record()
            if len(events) > 1:
                events[-2][1].synchronize()  # one step ahead of the device, no further
        else:
            busy += time.perf_counter() - started
        taken += 1
    _finish(trainer.device)
    elapsed = time.perf_counter() - began
    busy += sum(first.elapsed_time(last) / 1e3 for first, last in events)
    return Trained(taken, elapsed, busy)


def _event() -> Any:
    return torch.cuda.Event(enable_timing=True)  # type: ignore[no-untyped-call]


def _finish(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def _endless(first: Batch) -> Iterator[Batch]:
    while True:
        yield first


def _epochs(source: Any) -> Generator[Batch, None, None]:
    while True:
        yield from source


def fed(asked: argparse.Namespace, trainer: Trainer, workers: int) -> tuple[dict[str, Any], Batch]:
    """The record of training from a stream of that many server workers, and its first batch."""
    flags = ["--rows", asked.rows, *server_flags(asked.changes)]
    on_device = trainer.device.type == "cuda"
    with LocalServer(asked.videos, workers=workers, flags=flags) as server:
        dataset = V2VStreamDataset(server.address, batch_size=asked.batch_size, rank=0, world_size=1)
        source = DataLoader(dataset, batch_size=None, num_workers=1, pin_memory=True) if on_device else dataset
        batches = _epochs(source)
        first = next(batches)
        roles = roles_of(server)
        meters: list[Meter] = []
        trained = train(trainer, batches, asked.seconds, lambda: meters.append(Meter(roles)))
        used = meters[0].used()
        batches.close()
    return _record("fed", workers, trained) | {
        f"{role}_cpu_seconds_per_batch": used[role] / trained.batches for role in used
    }, first


def ceiling(trainer: Trainer, batch: Batch, seconds: float) -> dict[str, Any]:
    """The record of training on one batch that lies on the device."""
    cached = batch.to(trainer.device)
    return _record("ceiling", None, train(trainer, _endless(cached), seconds, lambda: None))


def _record(measure: str, workers: int | None, trained: Trained) -> dict[str, Any]:
    return {
        "measure": measure,
        "workers": workers,
        "batches_per_second": trained.batches / trained.seconds,
        "utilisation": trained.busy_seconds / trained.seconds,
        "step_seconds": trained.busy_seconds / trained.batches,
        "batches": trained.batches,
        "seconds": trained.seconds,
    }


def work(asked: argparse.Namespace) -> int:
    """Measures, prints, writes; returns the exit status.

    Raises:
        V2VError: wrong usage, or no server.
    """
    try:
        device = torch.device(asked.device or ("cuda" if torch.cuda.is_available() else "cpu"))
    except RuntimeError as error:
        raise UsageError(f"--device {asked.device}: give cuda, cuda:N or cpu") from error
    if device.type == "cuda" and not torch.cuda.is_available():
        raise UsageError(f"--device {device}: this PyTorch sees no CUDA device")
    if device.type == "cpu":
        torch.set_num_threads(1)  # the other cores are the server workers'
    recipe = recipe_of(asked.changes)
    trainer = Trainer(asked.network, asked.base_channels, recipe.bins, device, asked.bfloat16)
    records, first = [], None
    for workers in asked.workers:
        record, first = fed(asked, trainer, workers)
        records.append(record)
    if first is None:
        raise UsageError("--workers: give at least one number")
    records.insert(0, ceiling(trainer, first, asked.seconds))
    top = records[0]["batches_per_second"]
    for record in records:
        record |= {
            "share_of_ceiling": record["batches_per_second"] / top,
            "device": torch.cuda.get_device_name(device) if device.type == "cuda" else "cpu",
            "network": asked.network,
            "batch_size": asked.batch_size,
        }
    show(records, _COLUMNS)
    last = records[-1]
    if last["workers_cpu_seconds_per_batch"] > 0:
        needed = math.ceil(top * last["workers_cpu_seconds_per_batch"])
        print(
            f"extrapolated from processor time: {needed} workers of one core each feed this trainer on {last['device']}"
        )
    write(records, asked.json)
    if asked.plot is not None:
        plot(asked.plot, records)
    return 0


def plot(file: Path, records: Sequence[dict[str, Any]]) -> None:
    """Batches a second and utilisation over server workers, with the ceiling."""
    top, fed_ = records[0], {record["workers"]: record for record in records[1:]}
    with plots.panels(file, 2, title="Feeding a GPU") as (speed, utilisation):
        plots.line(speed, {n: record["batches_per_second"] for n, record in fed_.items()}, "fed by the stream")
        speed.axhline(top["batches_per_second"], linestyle="--", color="grey", label="one cached batch")
        speed.set_ylabel("batches/s")
        plots.line(utilisation, {n: 100 * record["utilisation"] for n, record in fed_.items()}, top["device"])
        utilisation.set_ylabel("device computes, % of the time")
        for axes in (speed, utilisation):
            plots.whole_number_axis(axes, list(fed_), "server workers")
            axes.set_ylim(bottom=0)
            axes.legend()


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; returns the exit status."""
    parser = parser_of(__doc__, "gpu_feed", seconds=30.0, what="the ceiling, and each number of workers")
    parser.add_argument("--videos", required=True, type=Path, metavar="DIR")
    parser.add_argument("--rows", default="top:0.54")
    parser.add_argument("--workers", type=counts, default=(1, 2, 4, 8), metavar="N,N", help="server workers (1,2,4,8)")
    parser.add_argument("--batch-size", type=int, default=12)
    parser.add_argument("--network", choices=sorted(NETWORKS), default="e2vid")
    parser.add_argument("--base-channels", type=int, metavar="N", help="default: the network's own")
    parser.add_argument("--bfloat16", action="store_true", help="autocast of the forward pass")
    parser.add_argument("--device", metavar="NAME", help="default: cuda where there is one, else cpu")
    return run(parser, work, arguments)


if __name__ == "__main__":
    sys.exit(main())
