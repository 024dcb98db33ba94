"""bfloat16: weights are cast once, gradients of many uses are added up in float32. Scores are of IEEE's float32."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F
from torch.utils._python_dispatch import TorchDispatchMode

from tests.trainer.evaluation.h5_file import random_recording
from tests.trainer.evaluation.test_flow import constant
from tests.trainer.evaluation.test_flow import recording as flow_recording
from tests.trainer.training import ALONE, configured
from trainer.config import RunConfig
from trainer.config_file import load_config
from trainer.learner import build
from trainer.models import NETWORKS
from trainer.models.firenet import FireNet
from trainer.precision import bfloat16_products
from trainer.run.validation import Validation

CPU = torch.device("cpu")
USES = 600  # adding 1 to 256 gives 256 in bfloat16


class Casts(TorchDispatchMode):
    """Counts casts from float32 to bfloat16 by the shape of what is cast."""

    def __init__(self) -> None:
        super().__init__()
        self.shapes: Counter[tuple[int, ...]] = Counter()

    def __torch_dispatch__(self, function: Any, _types: Any, arguments: Any = (), named: Any = None) -> Any:
        if function is torch.ops.aten._to_copy.default and (named or {}).get("dtype") == torch.bfloat16:
            self.shapes[tuple(arguments[0].shape)] += 1
        return function(*arguments, **(named or {}))


def used_often(share: bool, *, view: bool) -> tuple[Tensor, int]:
    """The gradient of a weight that is used again and again, and how often it was cast."""
    weight = nn.Parameter(torch.ones(1, 3))
    with Casts() as casts, bfloat16_products(CPU, enabled=True, share=share):
        used = weight[:, 1:] if view else weight
        ones = torch.ones(1, used.shape[1])
        total = torch.stack([F.linear(ones, used).float() for _ in range(USES)]).sum()
    total.backward()  # type: ignore[no-untyped-call]
    assert weight.grad is not None
    return weight.grad, casts.shapes[tuple(used.shape)] - (0 if used.shape != ones.shape else USES)


@pytest.mark.parametrize("view", [False, True])
@pytest.mark.parametrize(("share", "most"), [(True, 1), (False, USES)])
def test_gradients_are_summed_in_float32(share: bool, most: int, view: bool) -> None:
    gradient, casts = used_often(share, view=view)
    assert gradient.dtype == torch.float32
    assert gradient[0, -1] == USES
    assert casts == most


def test_parts_outside_autocast_keep_their_weights() -> None:
    layer = nn.Conv2d(1, 1, 1)
    with bfloat16_products(CPU, enabled=True), torch.autocast("cpu", enabled=False):
        assert layer(torch.rand(1, 1, 4, 4)).dtype == torch.float32


@pytest.mark.parametrize(("name", "options"), [("firenet", {}), ("hypere2vid", {"base_channels": 4})])
def test_a_longer_pass_of_a_network_casts_no_weight_more_often(name: str, options: dict[str, Any]) -> None:
    network = NETWORKS[name](bins=5, **options)

    def casts_of_weights(steps: int) -> int:
        voxels = torch.ones(1, steps, 5, 16, 16, dtype=torch.int8)
        with Casts() as casts, bfloat16_products(CPU, enabled=True):
            network(voxels)[0].sum().backward()
        return sum(count for shape, count in casts.shapes.items() if shape[-2:] == (3, 3))

    assert casts_of_weights(5) == casts_of_weights(3) > 4
    assert all(weight.grad.dtype == torch.float32 for weight in network.parameters() if weight.grad is not None)


def allowed() -> tuple[bool, bool]:
    return torch.backends.cuda.matmul.allow_tf32, torch.backends.cudnn.allow_tf32


@pytest.fixture
def _as_before() -> Iterator[None]:
    before, benchmark = allowed(), torch.backends.cudnn.benchmark
    yield
    torch.backends.cudnn.benchmark = benchmark
    torch.backends.cuda.matmul.allow_tf32, torch.backends.cudnn.allow_tf32 = before


@pytest.mark.usefixtures("_as_before")
@pytest.mark.parametrize("task", ["reconstruction", "flow"])
def test_scores_within_a_training_of_shorter_products_are_of_full_ones(tmp_path: Path, task: str) -> None:
    """``compute.precision: tf32`` is for the training alone."""
    flow = task == "flow"
    settings = ["compute.precision=tf32", *(["network.name=evflownet", "loss.flow=stream"] if flow else [])]
    learner = build(load_config(configured(tmp_path), settings), ALONE)
    assert allowed() == (False, True)  # convolutions alone, as PyTorch does by itself
    network = constant(0, 0) if flow else FireNet(base_channels=2)
    path = tmp_path / "recordings" / "a.h5"
    _ = flow_recording(path) if flow else random_recording(path)
    seen = set()
    network.register_forward_hook(lambda *_: seen.add(allowed()))
    Validation(learner.task, network, RunConfig(validate=str(path.parent)), ALONE)()
    assert seen == {(False, False)}
    assert allowed() == (False, True)


@pytest.mark.usefixtures("_as_before")
@pytest.mark.parametrize("benchmark", [True, False])
def test_cudnn_times_its_algorithms_unless_the_configuration_says_otherwise(tmp_path: Path, benchmark: bool) -> None:
    build(load_config(configured(tmp_path), [f"compute.cudnn_benchmark={str(benchmark).lower()}"]), ALONE)
    assert torch.backends.cudnn.benchmark == benchmark
