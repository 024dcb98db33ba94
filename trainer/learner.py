"""The parts of a training run: network, task, optimiser and average, one step with them, and their checkpoint."""

from __future__ import annotations

import contextlib
import copy
import hashlib
import inspect
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel
from torch.torch_version import TorchVersion

from trainer.captured import CapturedGradients
from trainer.config import ComputeConfig, OptimizerConfig, RunConfig, TrainConfig, setting_of
from trainer.models import NETWORKS, VoxelNetwork
from trainer.precision import bfloat16_products
from trainer.run.checkpoint import Checkpoint
from trainer.run.distributed import Ranks
from trainer.tasks import TASKS, Task
from trainer.tasks.task import Work
from trainer.weights import load_into, read_weights
from v2v_protocol.errors import UsageError


@dataclass(frozen=True, slots=True)
class Learner:
    """The parts of one run.

    Attributes:
        network: holds the weights.
        model: the network, wrapped for several ranks and compiled as configured; call it in the training step.
        average: the averaged network, or None.
        rank: of this process; dropout differs between ranks.
        captured: computes :meth:`gradients` with a CUDA graph, or None.
    """

    network: VoxelNetwork
    model: nn.Module
    task: Task
    optimizer: torch.optim.Optimizer
    average: AveragedNetwork | None
    config: TrainConfig
    device: torch.device
    rank: int
    captured: CapturedGradients | None = None

    @property
    def trained(self) -> VoxelNetwork:
        """Return the network to evaluate: the averaged one if there is one."""
        return self.network if self.average is None else self.average.network

    def step(self, work: Work, step: int, epoch: int) -> dict[str, Tensor]:
        """Compute gradients and update the weights. Work for the device is queued; this does not wait for it.

        Args:
            step: optimiser steps before this one.
            epoch: of the batch.

        Returns:
            The losses and the norm of the gradient, on the device.
        """
        torch.manual_seed(_seed(self.config.compute.seed, self.rank, step))
        found = self.gradients(work) if self.captured is None else self.captured(work)
        rate = learning_rate(self.config.optimizer, self.config.run, step, epoch)
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        self.optimizer.step()
        if self.average is not None:
            self.average.update(self.network, step + 1)
        return found

    def gradients(self, work: Work) -> dict[str, Tensor]:
        """Run forward and backward; return the losses and the norm of the gradient. Earlier gradients are dropped."""
        config = self.config.compute
        pieces = work.pieces(config.pieces)
        losses: dict[str, Tensor] = {}
        self.optimizer.zero_grad()
        for number, piece in enumerate(pieces, start=1):
            with self._exchanging(number == len(pieces)):
                with bfloat16_products(
                    self.device, enabled=config.precision == "bfloat16", share=config.compile == "none"
                ):
                    prediction, _ = self.model(piece.voxels, None, piece.guide)
                    found = self.task.losses(prediction, piece)
                (found["total"] / len(pieces)).backward()  # type: ignore[no-untyped-call]
            for name, value in found.items():
                losses[name] = losses.get(name, 0) + value.detach() / len(pieces)
        norm = gradient_norm(self.network.parameters(), self.config.optimizer.clip_gradient_norm)
        return losses | {"gradient_norm": norm}

    def _exchanging(self, now: bool) -> contextlib.AbstractContextManager[None]:
        """Return a context in which ranks exchange gradients: once a step, with the last piece."""
        if now or not isinstance(self.model, DistributedDataParallel):
            return contextlib.nullcontext()
        return self.model.no_sync()

    def checkpoint(self, step: int, stream: Mapping[str, Any] | None) -> Checkpoint:
        """Return all that determines the next losses; ``stream`` is the resume state of the last batch trained on."""
        return Checkpoint(
            step=step,
            epoch=0 if stream is None else stream["epoch"],
            model=self.network.state_dict(),
            optimizer=self.optimizer.state_dict(),
            ema=None if self.average is None else dict(self.average.network.state_dict()),
            stream=stream,
            config=self.config.to_dict(),
        )

    def restore(self, checkpoint: Checkpoint) -> None:
        """Load a checkpoint whose configuration agrees (see :func:`trainer.run.checkpoint.require_same_run`)."""
        self.network.load_state_dict(checkpoint.model)
        _restore_optimizer(self.optimizer, checkpoint.optimizer)
        if self.average is not None and checkpoint.ema is not None:
            self.average.network.load_state_dict(checkpoint.ema)


def build(config: TrainConfig, ranks: Ranks) -> Learner:
    """Build the parts of a run, and read every weight file that the configuration names.

    Raises:
        UsageError: a file or option is missing or wrong; the message names the key.
    """
    compute = config.compute
    if config.stream.batch_size % compute.pieces:
        raise UsageError(
            f"compute.pieces = {compute.pieces}: give a divisor of stream.batch_size = {config.stream.batch_size}"
        )
    if compute.cuda_graph and ranks.device.type != "cuda":
        raise UsageError("compute.cuda_graph = true: PyTorch sees no GPU here; leave the key out")
    if compute.cuda_graph and ranks.world_size > 1:
        raise UsageError(
            f"compute.cuda_graph = true: {ranks.world_size} ranks exchange gradients outside of a graph; leave the key "
            "out, or use one rank"
        )
    if compute.compile == "step" and TorchVersion(torch.__version__) < "2.7":
        raise UsageError(
            f"compute.compile = step: PyTorch is {torch.__version__}, and this needs 2.7 or later; update it, or take "
            "clip, or none"
        )
    _set_numerics(compute)
    torch.manual_seed(compute.seed)
    network = _network(config)
    if channels_last(compute, ranks.device):
        network = network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    network = network.to(ranks.device)
    task = TASKS[network.task](config.loss, network, ranks.device, bfloat16=compute.precision == "bfloat16")
    optimizer = _optimizer(config.optimizer, network)
    decay = config.optimizer.ema_decay
    average = AveragedNetwork(network, decay) if decay else None
    model: nn.Module = network
    if ranks.world_size > 1:
        devices = [ranks.device] if ranks.device.type == "cuda" else None
        model = DistributedDataParallel(network, device_ids=devices)
    if compute.compile == "clip":
        model = torch.compile(model)  # type: ignore[assignment]
    elif compute.compile == "step":
        try:
            network.compile_turns()
        except UsageError as error:
            raise UsageError(f"compute.compile = step: {error}; take clip, or none") from error
    learner = Learner(network, model, task, optimizer, average, config, ranks.device, ranks.rank)
    if compute.cuda_graph:
        learner = replace(learner, captured=CapturedGradients(learner.gradients))
    return learner


def channels_last(compute: ComputeConfig, device: torch.device) -> bool:
    """Return whether the network is kept in channels-last format.

    "auto": on a processor, where it is faster (``python -m bench step``); on a GPU with "tf32" and "bfloat16", whose
    units (tensor cores) work in that format.
    """
    if compute.channels_last == "auto":
        return device.type != "cuda" or compute.precision != "float32"
    return bool(compute.channels_last)


def learning_rate(config: OptimizerConfig, run: RunConfig, step: int, epoch: int) -> float:
    """Return the learning rate of the step after ``step`` others; epochs count from 0.

    learning_rate * decay^epoch * (step + 1) / warmup_steps, the last factor at most 1; with ``schedule`` "cosine" also
    times (1 + cos(pi p)) / 2, where p is the part of the run that is over.
    """
    rate = config.learning_rate * config.learning_rate_decay**epoch
    rate *= min(1.0, (step + 1) / max(1, config.warmup_steps))
    if config.schedule == "cosine":
        over = max(epoch / run.epochs, step / run.steps if run.steps else 0.0)
        rate *= (1 + math.cos(math.pi * min(1.0, over))) / 2
    return rate


@torch.no_grad()
def gradient_norm(parameters: Iterable[nn.Parameter], longest: float) -> Tensor:
    """Return the norm, [], of the gradient of all parameters, and clip the gradient to ``longest`` (0: no clipping)."""
    gradients = [parameter.grad for parameter in parameters if parameter.grad is not None]
    norm: Tensor = torch.linalg.vector_norm(torch.stack(torch._foreach_norm(gradients)))
    if longest:
        torch._foreach_mul_(gradients, (longest / (norm + 1e-6)).clamp(max=1.0))
    return norm


class AveragedNetwork:
    """Exponential moving average of a network: often better pictures than the last weights.

        average <- average + (1 - d) (weights - average),    d = min(decay, (1 + n) / (10 + n)) at update n = 1, 2, ...

    The ramp removes the random initial weights: with a decay of 0.999 alone, a third of them would remain after 1000
    updates.

    Args:
        network: unwrapped; its present weights are the first average.
        decay: d after the ramp, in 0 .. 1, 1 excluded.

    Attributes:
        network: a copy that holds the average, without gradients.
    """

    def __init__(self, network: VoxelNetwork, decay: float) -> None:
        self.network = copy.deepcopy(network).requires_grad_(False)
        self._decay = decay

    @torch.no_grad()
    def update(self, network: VoxelNetwork, update: int) -> None:
        """Add the weights after optimiser step number ``update`` (from 1), without waiting for the device."""
        share = 1 - min(self._decay, (1 + update) / (10 + update))
        pairs = list(zip(self.network.state_dict().values(), network.state_dict().values(), strict=True))
        real = [pair for pair in pairs if pair[0].is_floating_point()]
        torch._foreach_lerp_([mine for mine, _ in real], [theirs for _, theirs in real], share)
        for mine, theirs in pairs:
            if not mine.is_floating_point():
                mine.copy_(theirs)  # a counter has no average


def _seed(seed: int, rank: int, step: int) -> int:
    """Return the seed of one step on one rank, so that dropout of a resumed run is that of the uninterrupted one."""
    return int.from_bytes(hashlib.blake2b(f"{seed} {rank} {step}".encode(), digest_size=8).digest(), "little")


def _set_numerics(compute: ComputeConfig) -> None:
    """Set how a GPU computes float32. TF32 keeps 10 of 23 bits of the factors in a product."""
    torch.backends.cuda.matmul.allow_tf32 = False
    torch.backends.cudnn.allow_tf32 = compute.precision == "tf32"
    torch.backends.cudnn.benchmark = compute.cudnn_benchmark


def _restore_optimizer(optimizer: torch.optim.Optimizer, saved: Mapping[str, Any]) -> None:
    """Load moments and settings for this device and memory format.

    PyTorch would keep the kernel of the saving device and the memory order of the saved moments. A fused kernel reads
    parameter, gradient and moments in memory order, and would mix up their elements.
    """
    groups = [
        {**group, "fused": ours["fused"]}
        for group, ours in zip(saved["param_groups"], optimizer.param_groups, strict=True)
    ]
    optimizer.load_state_dict({**saved, "param_groups": groups})
    for parameter, state in optimizer.state.items():
        for name, value in state.items():
            if isinstance(value, Tensor) and value.shape == parameter.shape and value.stride() != parameter.stride():
                state[name] = torch.empty_like(parameter).copy_(value)


def _network(config: TrainConfig) -> VoxelNetwork:
    kind = NETWORKS[config.network.name]
    parameters = inspect.signature(kind, eval_str=True).parameters.items()
    known = {name: parameter.annotation for name, parameter in parameters if name != "bins"}
    options = {}
    for name, value in config.network.options.items():
        if name not in known:
            raise UsageError(f"network.options.{name}: {config.network.name} knows {', '.join(known)}")
        options[name] = setting_of(f"network.options.{name}", known[name], value)
    network = kind(bins=config.stream.resolved_recipe.bins, **options)
    if config.network.weights:
        try:
            load_into(network, config.network.weights)
        except UsageError as error:
            raise UsageError(f"network.weights: {error}") from error
    return network


def obeying_weights(config: TrainConfig) -> TrainConfig:
    """Return the configuration with the network options with which its ``network.weights`` were trained.

    Options in the configuration override them.

    Raises:
        UsageError: the file cannot be read, or is of another network or number of bins.
    """
    if not config.network.weights:
        return config
    try:
        found = read_weights(config.network.weights).recognise()
    except UsageError as error:
        raise UsageError(f"network.weights: {error}") from error
    if found is None:
        return config
    name, options = found
    present = {"stream.recipe.bins": config.stream.resolved_recipe.bins, "network.name": config.network.name}
    told = {"stream.recipe.bins": options.pop("bins", present["stream.recipe.bins"]), "network.name": name}
    missing = [f"{key} = {value}" for key, value in told.items() if present[key] != value]
    if missing:
        raise UsageError(f"network.weights: {config.network.weights} is of another network; set {', '.join(missing)}")
    return config.with_network_options(options)


def _optimizer(config: OptimizerConfig, network: nn.Module) -> torch.optim.Optimizer:
    kind = torch.optim.Adam if config.name == "adam" else torch.optim.AdamW
    return kind(
        network.parameters(),
        lr=config.learning_rate,
        weight_decay=config.weight_decay,
        amsgrad=config.amsgrad,
        fused=next(network.parameters()).is_cuda,
    )
