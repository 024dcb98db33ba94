"""Every shipped configuration, at reduced size, on a stream: it builds, trains, and minimises what it says."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from tests.client.fake_server import FakeServer
from tests.trainer.models import numpy_networks as oracle
from tests.trainer.training import ALONE
from trainer.config import TrainConfig
from trainer.config_file import load_config, shipped
from trainer.feed import Feed, stream
from trainer.learner import Learner, build
from trainer.losses.backbones import BACKBONES
from trainer.losses.lpips import LPIPS
from trainer.models.raft import RAFT
from trainer.run.distributed import Ranks
from trainer.run.reporting import Meter
from trainer.tasks import Work

NETWORKS: dict[str, dict[str, Any]] = {
    "e2vid": {"base_channels": 2, "encoders": 2}, "firenet": {"base_channels": 2}, "hypere2vid": {"base_channels": 2},
    "etnet": {"base_channels": 2}, "evflownet": {"base_channels": 2}, "eraft": {},
}  # fmt: skip
QUICK = ("e2vid", "finetune-cpu", "firenet-cpu", "tiny-cpu")
"""RAFT and E-RAFT have no reduced size, and most kinds of E2VID differ in a number."""
SHIPPED = [pytest.param(name, marks=[] if name in QUICK else [pytest.mark.slow]) for name in shipped()]
SIDES_PX = {"alex": 33}
OTHER_SIDE_PX = 17
"""The least that each network of LPIPS takes, and divides by nothing."""


@pytest.fixture(autouse=True)
def _two_updates(monkeypatch: pytest.MonkeyPatch) -> None:
    """Limit RAFT and E-RAFT to two updates; the other ten would test nothing more."""
    monkeypatch.setattr(RAFT.forward, "__defaults__", (2,))
    monkeypatch.setattr("trainer.models.eraft.UPDATES", 2)


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder for files of random numbers in place of the published ones."""
    return tmp_path_factory.mktemp("weights")


@cache
def lpips_files(folder: Path, net: str) -> dict[str, str]:
    """Write the files of a network of LPIPS; return the settings that name them."""
    backbone, heads = folder / net, folder / f"{net}-heads"
    torch.save({f"features.{key}": value for key, value in LPIPS(net).features.state_dict().items()}, backbone)
    torch.save(
        {f"lin{i}.model.1.weight": torch.rand(1, c, 1, 1) / c for i, c in enumerate(BACKBONES[net].channels)}, heads
    )
    return {"loss.lpips_backbone": str(backbone), "loss.lpips_heads": str(heads)}


def side_px(config: TrainConfig) -> int:
    return SIDES_PX.get(getattr(config.loss, "lpips_network", ""), OTHER_SIDE_PX)


def reduced(name: str, weights: Path) -> TrainConfig:
    """The configuration with a small network, few small voxel grids, and files that are there."""
    torch.manual_seed(5)
    config = load_config(name)
    side = side_px(config)
    recipe = {"voxels_per_clip": 3, "bins": 2, "crop_height_px": side, "crop_width_px": side}
    preset = config.stream.recipe["preset"] if isinstance(config.stream.recipe, Mapping) else config.stream.recipe
    settings = {
        "stream.recipe": {"preset": preset, **recipe}, "stream.batch_size": 2, "stream.loader_workers": 0,
        "stream.spec": {},
        "network.options": NETWORKS[config.network.name], "network.weights": "", "compute.device": "cpu",
    }  # fmt: skip
    loss = config.loss
    if getattr(loss, "lpips_weight", 0):
        settings |= lpips_files(weights, loss.lpips_network)
    if getattr(loss, "raft_weights", ""):
        settings["loss.raft_weights"] = str(weights / f"raft-{loss.raft_size}")
        torch.save(RAFT(loss.raft_size).state_dict(), settings["loss.raft_weights"])
    if getattr(loss, "temporal_weight", 0):
        settings["loss.temporal_first_step"] = min(2, loss.temporal_first_step)
    return load_config(name, [f"{key}={value!r}" for key, value in settings.items()])


def float64(tensor: Tensor) -> np.ndarray:
    return tensor.detach().double().numpy()


def reconstruction_loss(learner: Learner, prediction: Tensor, work: Work) -> float:
    """Sum over the terms of means over samples and steps, pair by pair."""
    loss, p, target = learner.config.loss, float64(prediction)[:, :, 0], float64(work.truth["frames"])[:, :, 0]
    total = loss.l1_weight * np.abs(p - target).mean()
    batch, steps = p.shape[:2]
    if loss.lpips_weight:
        metric = learner.task._loss.lpips  # type: ignore[attr-defined]
        backbone = {key: float64(value) for key, value in metric.features.state_dict().items()}
        heads = [float64(metric.get_buffer(f"head{i}")) for i in range(len(metric.backbone.channels))]
        pairs = [(p[b, t][None], target[b, t][None]) for b in range(batch) for t in range(steps)]
        total += np.mean([oracle.lpips(metric.net, *pair, backbone, heads) for pair in pairs])
    if loss.temporal_weight:
        flow, first = float64(work.truth["flow"]), loss.temporal_first_step
        sign = -1 if loss.temporal_as_published else 1
        terms = [
            oracle.temporal_step(
                (p[b, t - 1], p[b, t]), (target[b, t - 1], target[b, t]), sign * flow[b, t - first],
                as_published=loss.temporal_as_published,
            )
            for b in range(batch) for t in range(first, steps)
        ]  # fmt: skip
        total += np.sum(terms) / batch / (steps if loss.temporal_rule == "half" else steps - first)
    return float(total)


def flow_loss(learner: Learner, prediction: Tensor, work: Work) -> float:
    """The last update, or all of them, each 0.8 of the next; over the valid pixels, if they are told."""
    p, truth, gamma = float64(prediction), float64(work.truth["flow"]), learner.config.loss.gamma
    counts = float64(work.truth["valid"]) if "valid" in work.truth else np.ones((*truth.shape[:2], 1, *truth.shape[3:]))
    shares = counts / (2 * counts.sum())
    if p.ndim == 5:
        return float((np.abs(p - truth) * shares).sum())
    errors = [(np.abs(each - truth) * shares).sum() for each in p]
    return float(sum(gamma ** (len(p) - 1 - i) * error for i, error in enumerate(errors)) if gamma else errors[-1])


@pytest.mark.parametrize("name", SHIPPED)
def test_a_shipped_configuration_builds_trains_and_minimises_its_loss(
    server: FakeServer, weights: Path, name: str
) -> None:
    config = reduced(name, weights)
    learner = build(config, ALONE)
    expect = flow_loss if learner.network.task == "flow" else reconstruction_loss
    before = [parameter.detach().clone() for parameter in learner.network.parameters()]
    dataset = stream(config, learner.task.asked, server.address)
    batches = iter(Feed(dataset, ALONE.device).epochs(0, 1))
    assert np.isfinite(float(learner.step(learner.task.prepare(next(batches), 0), 0, 0)["total"]))
    work = learner.task.prepare(next(batches), 0)
    assert work.voxels.shape == (2, 3 + learner.network.lead_voxels, 2, side_px(config), side_px(config))
    learner.network.train()
    torch.manual_seed(0)
    with torch.no_grad():
        prediction = learner.model(work.voxels, None, work.guide)[0]
        found = float(learner.task.losses(prediction, work)["total"])
    assert found == pytest.approx(expect(learner, prediction, work), rel=2e-4)
    assert np.isfinite(float(learner.step(work, 1, 0)["total"]))
    changed = [not torch.equal(a, b) for a, b in zip(before, learner.network.parameters(), strict=True)]
    assert sum(changed) > 0.9 * len(changed)
    assert (work.guide is not None) == (name == "hypere2vid")


class Waits(TorchDispatchMode):
    """Notes what would make a processor wait for the device: values that are read, and copies to it or from it.

    The device is "meta", which has shapes and no values.
    """

    def __init__(self) -> None:
        super().__init__()
        self.seen: list[str] = []
        self.operators = 0

    def __torch_dispatch__(self, function: Any, _types: Any, args: Any = (), kwargs: Any = None) -> Any:
        out = function(*args, **(kwargs or {}))
        name = function.name()
        self.operators += 1
        if name in ("aten::_local_scalar_dense", "aten::nonzero", "aten::masked_select") and args[0].is_meta:
            self.seen.append(name)
        if name in ("aten::_to_copy", "aten::copy_"):
            source = args[0] if name == "aten::_to_copy" else args[1]
            if source.device != out.device:
                self.seen.append(f"{name} {source.device} -> {out.device} {list(out.shape)}")
        return out


@pytest.mark.parametrize("name", SHIPPED)
def test_a_step_neither_synchronises_with_the_device_nor_copies_to_it(
    server: FakeServer, weights: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From the batch on the device to the reading of the meter."""
    monkeypatch.setattr(torch, "autocast", lambda *_, **__: contextlib.nullcontext())  # it does not know this device
    config = reduced(name, weights)
    learner = build(config, Ranks(0, 1, torch.device("meta")))
    batch = next(iter(stream(config, learner.task.asked, server.address)))
    on_device = batch.to("meta")
    meter = Meter(ALONE)
    meter.add(learner.step(learner.task.prepare(on_device, 0), 0, 0))  # the optimiser makes its moments
    with Waits() as waits:
        meter.add(learner.step(learner.task.prepare(on_device, 0), 1, 0))
    assert waits.operators > 250
    assert waits.seen == []
    with Waits() as waits:
        torch.zeros(3, device="meta").copy_(torch.zeros(3))
    assert waits.seen == ["aten::copy_ cpu -> meta [3]"], "nothing is noticed"
