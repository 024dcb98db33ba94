"""What a configuration trains: the network, what judges it, what improves it, and how all of that is saved."""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from trainer.config import LossConfig, OptimizerConfig, TrainConfig, setting_of
from trainer.ema import AveragedNetwork
from trainer.evaluation.network import fitting
from trainer.losses.backbones import BACKBONES
from trainer.losses.lpips import HEADS_FROM, LPIPS
from trainer.losses.reconstruction import ReconstructionLoss
from trainer.losses.temporal import TemporalConsistency
from trainer.models import NETWORKS, ReconstructionNetwork
from trainer.models.raft_flow import WHERE_TO_GET_WEIGHTS, RaftFlow
from trainer.run.checkpoint import Checkpoint, capture_rng, restore_rng
from trainer.run.distributed import Ranks
from trainer.weights import load_into
from v2v_client import Batch
from v2v_protocol.errors import UsageError


@dataclass(frozen=True, slots=True)
class Learner:
    """The parts of one run.

    Attributes:
        network: holds the weights.
        model: the same, wrapped for several ranks and compiled as asked: call it in the training step.
        loss: what is minimised.
        flow: where the temporal loss has its flow from; None: from the batch.
        optimizer, scheduler: the scheduler counts epochs.
        average: the averaged network, or None.
    """

    network: ReconstructionNetwork
    model: nn.Module
    loss: ReconstructionLoss
    flow: RaftFlow | None
    optimizer: torch.optim.Optimizer
    scheduler: torch.optim.lr_scheduler.LRScheduler
    average: AveragedNetwork | None

    @property
    def device(self) -> torch.device:
        """Where the network is."""
        return next(self.network.parameters()).device

    @property
    def trained(self) -> ReconstructionNetwork:
        """The network to look at: the averaged one where there is one."""
        return self.network if self.average is None else self.average.network

    def flow_of(self, batch: Batch, target: Tensor) -> Tensor | None:
        """The flow that the loss wants, [B, T - first_step, 2, H, W] px; None where it wants none."""
        if self.loss.temporal is None:
            return None
        first = self.loss.temporal.first_step
        if self.flow is None:
            return None if batch.flow is None else batch.flow[:, first:].float()
        before, now = target[:, first - 1 : -1].flatten(0, 1), target[:, first:].flatten(0, 1)
        pair = (before, now) if self.loss.temporal.as_published else (now, before)
        return torch.unflatten(self.flow(*pair), 0, (len(target), -1))

    def end_epoch(self) -> None:
        """The learning rate of the next one."""
        with warnings.catch_warnings():
            # PyTorch does not know of the steps that were made before a checkpoint.
            warnings.filterwarnings("ignore", "Detected call of `lr_scheduler.step", UserWarning)
            self.scheduler.step()

    def checkpoint(self, step: int, stream: Mapping[str, Any] | None, config: TrainConfig) -> Checkpoint:
        """Everything that decides the next losses; ``stream`` is the resume state of the last batch trained on."""
        return Checkpoint(
            step=step,
            epoch=0 if stream is None else stream["epoch"],
            model=self.network.state_dict(),
            optimizer=self.optimizer.state_dict(),
            scheduler=self.scheduler.state_dict(),
            ema=None if self.average is None else self.average.state_dict(),
            rng=capture_rng(self.device),
            stream=stream,
            config=config.to_dict(),
        )

    def restore(self, checkpoint: Checkpoint) -> None:
        """Go on from there; the configurations must agree (see :func:`trainer.run.resume.require_same_run`)."""
        self.network.load_state_dict(checkpoint.model)
        _restore_optimizer(self.optimizer, checkpoint.optimizer)
        if checkpoint.scheduler is not None:
            self.scheduler.load_state_dict(dict(checkpoint.scheduler))
        if self.average is not None and checkpoint.ema is not None:
            self.average.load_state_dict(checkpoint.ema)
        restore_rng(checkpoint.rng, self.device)


def build(config: TrainConfig, ranks: Ranks) -> Learner:
    """Reads every weight file that the configuration names, so that a missing one is noticed before anything runs.

    Raises:
        UsageError: a file or option is missing or wrong; the message names the key.
    """
    torch.manual_seed(config.compute.seed)
    network = _network(config)
    if config.compute.channels_last:
        network = network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    network = network.to(ranks.device)
    loss = _loss(config.loss).to(ranks.device)
    flow = _flow(config, ranks.device)
    optimizer = _optimizer(config.optimizer, network)
    scheduler = torch.optim.lr_scheduler.ExponentialLR(optimizer, config.optimizer.learning_rate_decay)
    decay = config.optimizer.ema_decay
    average = AveragedNetwork(network, decay) if decay else None
    model: nn.Module = network
    if ranks.world_size > 1:
        devices = [ranks.device] if ranks.device.type == "cuda" else None
        model = DistributedDataParallel(network, device_ids=devices)
    if config.compute.compile:
        model = torch.compile(model)  # type: ignore[assignment]
    return Learner(network, model, loss, flow, optimizer, scheduler, average)


def _restore_optimizer(optimizer: torch.optim.Optimizer, saved: Mapping[str, Any]) -> None:
    """Its moments and settings, for this device and memory format.

    PyTorch would take over the kernel of the saving device, and the memory order of the saved moments; a fused kernel
    goes through parameter, gradient and moments as through lists of numbers, and would mix them up.
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


def _network(config: TrainConfig) -> ReconstructionNetwork:
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
            raise UsageError(f"network.weights: {_what_would_fit(config) or error}") from error
    return network


def _what_would_fit(config: TrainConfig) -> str:
    """What to set for the weights that do not fit; "" where the file does not tell, or tells what is set."""
    weights, bins = config.network.weights, config.stream.resolved_recipe.bins
    found = fitting(weights)
    if found is None:
        return ""
    name, options = found
    wanted = {"stream.recipe.bins": options.pop("bins", bins), "network.name": name}
    signature = inspect.signature(NETWORKS[name]).parameters
    own = {key: value for key, value in config.network.options.items() if key in signature}
    changed = {key: value for key, value in options.items() if own.get(key, signature[key].default) != value}
    if changed:
        wanted["network.options"] = {**own, **changed}
    present = {"stream.recipe.bins": bins, "network.name": config.network.name}
    missing = [f"{key} = {value}" for key, value in wanted.items() if present.get(key) != value]
    return f"{weights} does not fit this network; set {', '.join(missing)}" if missing else ""


def _loss(config: LossConfig) -> ReconstructionLoss:
    lpips = temporal = None
    if config.lpips_weight:
        net = config.lpips_network
        for key, origin in (
            ("lpips_backbone", BACKBONES[net].weights_from),
            ("lpips_heads", HEADS_FROM.format(net=net)),
        ):
            if not getattr(config, key):
                raise UsageError(
                    f"loss.{key} is missing, loss.lpips_weight = {config.lpips_weight:g} needs it. Nothing is "
                    f"downloaded; get it from {origin}"
                )
        lpips = LPIPS.from_files(net, config.lpips_backbone, config.lpips_heads)
    if config.temporal_weight:
        temporal = TemporalConsistency(
            first_step=config.temporal_first_step,
            rule=config.temporal_rule,
            as_published=config.temporal_as_published,
        )
    return ReconstructionLoss(
        lpips=lpips,
        temporal=temporal,
        lpips_weight=config.lpips_weight,
        l1_weight=config.l1_weight,
        temporal_weight=config.temporal_weight,
    )


def _flow(config: TrainConfig, device: torch.device) -> RaftFlow | None:
    loss = config.loss
    if not loss.temporal_weight or loss.flow != "raft":
        return None
    if not loss.raft_weights:
        raise UsageError(
            f"loss.raft_weights is missing, loss.flow = raft needs it (or take loss.flow = stream). Nothing is "
            f"downloaded; get it from {WHERE_TO_GET_WEIGHTS[loss.raft_size]}"
        )
    return RaftFlow(loss.raft_size, loss.raft_weights, device, bfloat16=config.compute.precision == "bfloat16")


def _optimizer(config: OptimizerConfig, network: nn.Module) -> torch.optim.Optimizer:
    kind = torch.optim.Adam if config.name == "adam" else torch.optim.AdamW
    return kind(
        network.parameters(),
        lr=config.learning_rate,
        weight_decay=config.weight_decay,
        amsgrad=config.amsgrad,
        fused=next(network.parameters()).is_cuda,
    )
