"""From the stream to the device: batches in order, copied while the device still computes the one before.

On a GPU the copy runs on its own CUDA stream, from page-locked memory. No batch is prefetched for that: the training
loop only queues work, so it asks for the next batch long before the GPU is done.
"""

from __future__ import annotations

import dataclasses
import signal
import time
from collections.abc import Iterable, Iterator, Sequence
from itertools import islice
from typing import Any

import torch
from torch.utils.data import DataLoader

from trainer.config import StreamConfig, TrainConfig
from trainer.tasks import Asked
from v2v_client import Batch, V2VStreamDataset
from v2v_client.local_server import LocalServer, server_flags
from v2v_protocol.errors import UsageError, V2VError
from v2v_protocol.recipe import Recipe
from v2v_protocol.sample import LARGEST_SEED

HELD_OUT_SEED = 1 << 32
"""Added to the seed: the held-out batch has the same virtual cameras throughout, none of which is trained on."""


def stream(config: TrainConfig, asked: Asked, address: str, **changes: Any) -> V2VStreamDataset:
    """Return the dataset of section ``stream``, without its ``mix``.

    Args:
        changes: arguments of the dataset that override the configuration.

    Raises:
        UsageError: a setting outside its limits.
    """
    settings = config.stream
    arguments: dict[str, Any] = {
        "batch_size": settings.batch_size,
        "arrays": asked.arrays,
        "recipe": asked.recipe(settings.resolved_recipe),
        "seed": settings.seed,
        "flow_direction": asked.flow_direction,
        "flow_from": asked.flow_from,
        "timeout_seconds": settings.timeout_seconds,
        "keys": None if settings.address else "",  # a server of our own asks for none
        "insecure": settings.insecure,
        **settings.spec,
    }
    return V2VStreamDataset(address, **(arguments | changes))


def streams(config: TrainConfig, asked: Asked, addresses: Sequence[str]) -> V2VStreamDataset:
    """Return the dataset that the run trains on, mixed of several with ``stream.mix``; see :func:`stream`."""
    mixed = config.stream.mixed.values()
    if len(mixed) == 1:
        return stream(config, asked, addresses[0])
    members = [
        stream(dataclasses.replace(config, stream=each), asked, address)
        for (each, _), address in zip(mixed, addresses, strict=True)
    ]
    return V2VStreamDataset.mix(
        {member: weight for member, (_, weight) in zip(members, mixed, strict=True)}, config.stream.seed
    )


def flags_of(settings: StreamConfig, recipe: Recipe) -> list[str]:
    """Return the flags of a server on ``settings.videos``."""
    asked = {"--list": settings.list, "--videos-kind": "" if settings.videos_kind == "videos" else settings.videos_kind}
    others = [part for flag, value in asked.items() if value for part in (flag, value)]
    return server_flags(recipe, settings.spec, "--rows", settings.rows, *others)


def held_out_batch(config: TrainConfig, asked: Asked, address: str) -> Iterator[Batch]:
    """Yield the held-out batch, on the CPU; it is the same at each start of the run.

    It has ``run.judge_samples`` samples, or fewer if an epoch has fewer. With ``run.judge_videos``, they come from a
    server on those videos, which is stopped afterwards.

    Raises:
        UsageError: ``run.judge_videos`` cannot be served.
    """
    if not config.run.judge_videos:
        yield from _held_out(config, asked, address)
        return
    settings = dataclasses.replace(config.stream, address="", videos=config.run.judge_videos, list="")
    config = dataclasses.replace(config, stream=settings)
    try:
        flags = flags_of(settings, asked.recipe(settings.resolved_recipe))
        with LocalServer(settings.videos, workers=1, flags=flags) as server:
            batches = list(_held_out(config, asked, server.address))
    except UsageError as error:
        raise UsageError(f"run.judge_videos = {config.run.judge_videos}: {error}") from error
    yield from batches


def _held_out(config: TrainConfig, asked: Asked, address: str) -> Iterator[Batch]:

    def held_out(samples: int) -> V2VStreamDataset:
        seed = (config.stream.seed + HELD_OUT_SEED) % (LARGEST_SEED + 1)
        return stream(config, asked, address, batch_size=samples, seed=seed, rank=0, world_size=1)

    dataset = held_out(config.run.judge_samples)
    try:
        yield from islice(dataset, 1)
    except UsageError:
        sequences = 0 if dataset.stream is None else dataset.stream.sequences
        if not 0 < sequences < config.run.judge_samples:
            raise
        yield from islice(held_out(sequences), 1)


class Feed:
    """Batches of a dataset on a device, epoch after epoch.

    Args:
        dataset: its epoch is set here; a loaded state is kept.
        loader_workers: processes that receive; 0: this one.

    Attributes:
        wait_seconds: time spent waiting for batches so far.
        transfer_seconds: time spent so far page-locking batches, unless a thread of the DataLoader does it, and
            queueing copies to a GPU. It excludes the copies themselves.
    """

    def __init__(self, dataset: V2VStreamDataset, device: torch.device, loader_workers: int = 0) -> None:
        self._dataset = dataset
        self._source: Iterable[Batch] = dataset
        if loader_workers:
            self._source = DataLoader(
                dataset,
                batch_size=None,
                num_workers=loader_workers,
                persistent_workers=True,
                pin_memory=device.type == "cuda",  # in a thread of its own
                multiprocessing_context="spawn",  # a fork would copy locks that other threads hold
                worker_init_fn=_leave_signals_to_the_trainer,
            )
        self._copies = torch.cuda.Stream(device) if device.type == "cuda" else None  # type: ignore[no-untyped-call]
        self.wait_seconds = self.transfer_seconds = 0.0

    def epochs(self, first: int, end: int) -> Iterator[Batch]:
        """Yield the batches of epochs ``first`` .. ``end - 1``."""
        for epoch in range(first, end):
            self._dataset.set_epoch(epoch)
            batches = _begun(self._source)
            while (batch := self._timed(batches)) is not None:
                if self._copies is not None:
                    began = time.perf_counter()
                    batch = _moved(batch, self._copies)
                    self.transfer_seconds += time.perf_counter() - began
                yield batch

    def _timed(self, batches: Iterator[Batch]) -> Batch | None:
        began = time.perf_counter()
        try:
            return next(batches, None)
        except V2VError as error:
            if isinstance(self._source, DataLoader):
                raise _without_trace(error) from error
            raise
        finally:
            self.wait_seconds += time.perf_counter() - began


def _begun(source: Iterable[Batch]) -> Iterator[Batch]:
    """Start an iteration and restore the handler of SIGCHLD.

    The handler of a DataLoader raises an error at any point of this process when a loader worker dies. A SIGTERM to the
    whole process group would end the run in the middle of a step. Without the handler, the wait for the next batch of
    that worker raises the error.
    """
    before = signal.getsignal(signal.SIGCHLD)
    try:
        return iter(source)
    finally:
        if signal.getsignal(signal.SIGCHLD) is not before:  # only the main thread can install one
            signal.signal(signal.SIGCHLD, before or signal.SIG_DFL)


def _moved(batch: Batch, copies: torch.cuda.Stream) -> Batch:
    """Return the batch on the GPU; the copy is queued, and work queued after it waits for it."""
    with torch.cuda.stream(copies):
        moved = batch.pin_memory().to(copies.device, non_blocking=True)
    compute = torch.cuda.current_stream(copies.device)
    compute.wait_stream(copies)
    for tensor in moved.arrays.values():
        # The memory belongs to the copying stream; without this the allocator could reuse it while it is read.
        tensor.record_stream(compute)
    return moved


def _without_trace(error: V2VError) -> V2VError:
    """Return the error of a loader worker without the trace that PyTorch puts before its message."""
    name = f"{type(error).__module__}.{type(error).__qualname__}"
    return type(error)(str(error).rpartition(f"\n{name}: ")[2].rstrip("\n"))


def _leave_signals_to_the_trainer(_worker: int) -> None:
    """Ignore SIGINT: Ctrl-C reaches every process of a terminal, and the training process handles it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
