"""Gradients from a graph, on a stand-in for CUDA's that has its rules: the same operators on the same memory."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from tests.trainer.training import ALONE, configured
from trainer.captured import WARM_UP_STEPS, CapturedGradients
from trainer.config_file import load_config
from trainer.learner import Learner, build
from trainer.models.sequence import Guide
from trainer.tasks import Work

STEPS = WARM_UP_STEPS + 3


def tensors(value: Any) -> list[Tensor]:
    return [leaf for leaf in tree_leaves(value) if isinstance(leaf, Tensor)]


class Tape(TorchDispatchMode):
    """What was done, on which tensors. A recording does nothing: what was written into older memory can be put back."""

    def __init__(self) -> None:
        super().__init__()
        self.done: list[tuple[Any, Any, Any, list[Tensor]]] = []
        self._made: set[int] = set()
        self._before: dict[int, tuple[Tensor, Tensor]] = {}

    def __torch_dispatch__(self, function: Any, _types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        read = {tensor.untyped_storage().data_ptr() for tensor in tensors((args, kwargs))}
        for argument, value in zip(function._schema.arguments, args, strict=False):
            # Batch norm writes its statistics, and its schema does not say so.
            if argument.name.startswith("running_") or (argument.alias_info and argument.alias_info.is_write):
                for tensor in tensors(value):
                    if tensor.untyped_storage().data_ptr() not in self._made:
                        self._before.setdefault(id(tensor), (tensor, tensor.clone()))
        out = function(*args, **kwargs)
        fresh = [tensor for tensor in tensors(out) if tensor.untyped_storage().data_ptr() not in read]
        self._made.update(tensor.untyped_storage().data_ptr() for tensor in fresh)
        self.done.append((function, args, kwargs, fresh))
        return out

    def put_back(self) -> None:
        for tensor, value in self._before.values():
            tensor.copy_(value)

    def again(self) -> None:
        for function, args, kwargs, fresh in self.done:
            out = tensors(function(*args, **kwargs))
            read = {tensor.untyped_storage().data_ptr() for tensor in tensors((args, kwargs))}
            new = [tensor for tensor in out if tensor.untyped_storage().data_ptr() not in read]
            for mine, theirs in zip(fresh, new, strict=True):
                mine.copy_(theirs)


class FakeGraph:
    """See :class:`trainer.captured.Graph`."""

    def __init__(self) -> None:
        self.warmed_up = self.replayed = 0

    @contextlib.contextmanager
    def warming_up(self) -> Iterator[None]:
        self.warmed_up += 1
        yield

    @contextlib.contextmanager
    def recording(self) -> Iterator[None]:
        assert self.warmed_up == WARM_UP_STEPS
        self._tape = Tape()
        state = torch.get_rng_state()
        with self._tape:
            yield
        torch.set_rng_state(state)
        with torch.no_grad():
            self._tape.put_back()

    def replay(self) -> None:
        self.replayed += 1
        with torch.no_grad():
            self._tape.again()


def learner(folder: Path, network: str, *settings: str) -> Learner:
    options = {"firenet": "{base_channels: 2}", "etnet": "{base_channels: 2}", "hypere2vid": "{base_channels: 2}"}
    return build(
        load_config(configured(folder), [f"network.name={network}", f"network.options={options[network]}", *settings]),
        ALONE,
    )


def batch(step: int, guide: float | None) -> Work:
    torch.manual_seed(100 + step)
    frames = torch.rand(4, 3, 1, 16, 20)
    voxels = torch.randint(-3, 4, (4, 3, 2, 16, 20), dtype=torch.int8)
    return Work(voxels=voxels, truth={"frames": frames}, guide=None if guide is None else Guide(frames, guide))


CASES = [
    pytest.param("firenet", ["compute.pieces=2"], None, id="pieces"),
    pytest.param("firenet", ["compute.precision=bfloat16"], None, id="bfloat16"),
    pytest.param("etnet", [], None, id="dropout"),
    pytest.param("hypere2vid", [], 0.5, id="batch norm and guide"),
]


@pytest.mark.parametrize(("network", "settings", "guide"), CASES)
def test_a_captured_step_is_the_step(
    tmp_path: Path, network: str, settings: list[str], guide: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Losses, weights, averages and statistics of six different batches: three to warm up, one recorded, all new.

    The losses of a step stay as they are when the next is replayed.
    """
    monkeypatch.setattr("trainer.models.etnet.ENCODER_LAYERS", 1)  # the other two say nothing new
    eager, captured = (learner(tmp_path, network, *settings) for _ in range(2))
    graph = FakeGraph()
    captured = dataclasses.replace(captured, captured=CapturedGradients(captured.gradients, lambda: graph))
    losses = [[each.step(batch(step, guide), step, 0) for step in range(STEPS)] for each in (eager, captured)]
    assert (graph.warmed_up, graph.replayed) == (WARM_UP_STEPS, STEPS - WARM_UP_STEPS)
    for step, (expected, found) in enumerate(zip(*losses, strict=True)):
        torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-6, msg=f"step {step}")
    for name, tensor in eager.network.state_dict().items():
        torch.testing.assert_close(captured.network.state_dict()[name], tensor, rtol=1e-4, atol=1e-5, msg=name)
    for name, tensor in eager.trained.state_dict().items():
        torch.testing.assert_close(captured.trained.state_dict()[name], tensor, rtol=1e-4, atol=1e-5, msg=name)


def test_another_shape_or_guide_share_is_recorded_again(tmp_path: Path) -> None:
    trained = learner(tmp_path, "hypere2vid")
    graphs: list[FakeGraph] = []

    def new_graph() -> FakeGraph:
        graphs.append(FakeGraph())
        return graphs[-1]

    gradients = CapturedGradients(trained.gradients, new_graph)
    for share in (0.5, 0.25):
        for step in range(WARM_UP_STEPS + 2):
            gradients(batch(step, share))
    gradients(batch(0, None))
    assert [graph.replayed for graph in graphs] == [2, 2, 0]
