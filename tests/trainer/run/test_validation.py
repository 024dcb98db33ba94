"""Validation during training scores recordings as `v2v-eval` does, and the ranks share them."""

from __future__ import annotations

import re
import threading
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from torch import Tensor

from tests.trainer.evaluation.h5_file import random_recording
from tests.trainer.evaluation.test_flow import constant, recording, run
from tests.trainer.training import ALONE
from trainer.config import RunConfig
from trainer.evaluation.config import parse_config
from trainer.evaluation.evaluate import Run, evaluate_sequence, find_recordings
from trainer.evaluation.flow import evaluate_flow
from trainer.evaluation.metrics import make_metrics
from trainer.evaluation.voxelise import VoxelSettings
from trainer.models import FireNet, VoxelNetwork
from trainer.run.distributed import Ranks
from trainer.run.validation import Validation
from trainer.tasks import Task
from trainer.tasks.flow import Flow, FlowTaskSettings
from trainer.tasks.reconstruction import Reconstruction, ReconstructionSettings
from v2v_protocol.errors import UsageError

CPU = torch.device("cpu")
DATA_SETS = [
    {"name": "first", "folder": "a", "sequences": {"0": [0, 0.1], "1": None}},
    {"name": "second", "folder": "b", "sequences": ["0", "absent"]},
]


def flow_task() -> Task:
    return Flow(FlowTaskSettings(flow="stream"), constant(0, 0), CPU, bfloat16=False)


def picture_task() -> Task:
    return Reconstruction(ReconstructionSettings(), None, CPU, bfloat16=False)


def network() -> FireNet:
    torch.manual_seed(3)
    return FireNet(bins=5, base_channels=4)


def two_sets(folder: Path, **more: Any) -> RunConfig:
    """Two recordings of one data set and one of another, with cuts, as a configuration of ``v2v-eval``."""
    for seed, name in enumerate(("a/0", "a/1", "b/0")):
        random_recording(folder / f"{name}.h5", seed=seed, images=8)
    (folder / "own.yaml").write_text(yaml.safe_dump({"data": DATA_SETS, **more}), encoding="utf-8")
    return RunConfig(validate=str(folder), validate_config=str(folder / "own.yaml"))


class Threads:
    """Ranks that are threads of this process."""

    def __init__(self, count: int) -> None:
        self.barrier = threading.Barrier(count, timeout=60)
        self.values: list[Any] = [None] * count

    def ranks(self) -> list[Ranks]:
        return [ThreadRanks(self, number) for number in range(len(self.values))]


class ThreadRanks(Ranks):
    """One of them."""

    def __init__(self, threads: Threads, number: int) -> None:
        super().__init__(number, len(threads.values), CPU)
        object.__setattr__(self, "threads", threads)

    def gather(self, value: Any) -> list[Any]:
        threads: Threads = self.threads  # type: ignore[attr-defined]
        threads.values[self.rank] = value
        threads.barrier.wait()
        values = list(threads.values)
        threads.barrier.wait()
        return values

    def from_first(self, value: Any) -> Any:
        return self.gather(value)[0]

    def copy_from_first(self, tensors: Iterable[Tensor]) -> None:
        for tensor in tensors:
            tensor.copy_(self.from_first(tensor))


def on_ranks(
    count: int,
    config: RunConfig,
    networks: Sequence[VoxelNetwork],
    stopping: Callable[[int], bool] = lambda _rank: False,
) -> list[Any]:
    """What each rank gets: its scores, or the error."""
    found: list[Any] = [None] * count

    def score(mine: Ranks) -> None:
        try:
            validate = Validation(picture_task(), networks[mine.rank], config, mine)
            found[mine.rank] = validate(baseline=True, stopping=lambda: stopping(mine.rank))
        except UsageError as error:
            found[mine.rank] = error

    threads = [threading.Thread(target=score, args=(mine,)) for mine in Threads(count).ranks()]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return found


def test_scores_of_flow_are_those_of_the_evaluation(tmp_path: Path) -> None:
    files = [recording(tmp_path / "recordings" / f"{name}.h5") for name in ("indoor", "outdoor")]
    scored = constant(0.3, 0.1)
    scored.train()
    validate = Validation(flow_task(), scored, RunConfig(validate=str(tmp_path / "recordings")), ALONE)
    expected = [evaluate_flow(run(constant(0.3, 0.1), as_published=False), file, None) for file in files]
    scores = validate(baseline=True)
    assert next(iter(scores)) == "aee_dense"  # decides
    for name, value in scores.items():
        predictor = "zeros" if name.startswith("zeros_") else "network"
        means = [each[predictor].means[name.removeprefix("zeros_")] for each in expected]
        assert value == pytest.approx(sum(means) / 2)
    assert scored.training
    with torch.no_grad():
        scored.unet.pred.conv2d.bias.add_(5.0)  # type: ignore[union-attr, operator]
    again = validate()
    assert again["aee_dense"] > scores["aee_dense"]
    assert not any(name.startswith("zeros_") for name in again)


def test_data_sets_weigh_the_same_whatever_their_sizes(tmp_path: Path) -> None:
    config = two_sets(tmp_path)
    scores = Validation(picture_task(), network(), config, ALONE)()
    evaluation = Run(network(), VoxelSettings(bins=5), make_metrics(["mse", "correlation"], {}))
    means = [
        [evaluate_sequence(evaluation, path, data_set).means for path in find_recordings(tmp_path, data_set).values()]
        for data_set in parse_config({"data": DATA_SETS}, "").data_sets
    ]
    assert [len(each) for each in means] == [2, 1]

    def expected(name: str) -> float:
        return float(np.mean([np.mean([score[name] for score in each]) for each in means]))

    assert list(scores) == ["mse", "correlation_lacking"]
    assert scores["mse"] == pytest.approx(expected("mse"), rel=1e-12)
    assert scores["correlation_lacking"] == pytest.approx(1 - expected("correlation"), rel=1e-12)


def test_a_cut_and_the_kind_of_voxel_grid_change_the_scores(tmp_path: Path) -> None:
    found = [
        Validation(picture_task(), network(), two_sets(tmp_path, **more), ALONE)()["mse"]
        for more in (
            {},
            {"data": [{**DATA_SETS[0], "sequences": ["0", "1"]}, DATA_SETS[1]]},
            {"voxels": {"kind": "interpolated", "bins": 5}},
        )
    ]
    assert len(set(found)) == 3


@pytest.mark.parametrize("count", [2, 3, 5])
def test_ranks_share_the_recordings_and_have_the_scores_of_one(tmp_path: Path, count: int) -> None:
    """Also where there are more ranks than recordings, and where the buffers of the ranks differ."""
    config = two_sets(tmp_path)
    alone = Validation(picture_task(), network(), config, ALONE)(baseline=True)
    assert list(alone) == [
        "mse", "correlation_lacking", "constant_grey_mse", "constant_grey_correlation_lacking",
    ]  # fmt: skip
    networks = [network() for _ in range(count)]
    for number, each in enumerate(networks):
        each.register_buffer("statistics", torch.full((1,), float(number)))
    assert on_ranks(count, config, networks) == [alone] * count
    assert [float(each.get_buffer("statistics")) for each in networks] == [0.0] * count


def test_an_error_of_one_rank_is_raised_by_all(tmp_path: Path) -> None:
    config = two_sets(tmp_path)
    networks = [network() for _ in range(2)]
    with torch.no_grad():
        next(networks[1].parameters()).fill_(float("nan"))
    found = on_ranks(2, config, networks)
    assert all("run.validate = " in str(error) and "not finite" in str(error) for error in found)


@pytest.mark.parametrize("stopped", [0, 1])
def test_a_rank_that_is_to_stop_ends_the_validation_of_all(tmp_path: Path, stopped: int) -> None:
    """After the recording at hand; the rank that stops may have scored all of its own."""
    config = two_sets(tmp_path)
    found = on_ranks(2, config, [network(), network()], stopping=lambda rank: rank == stopped)
    assert found == ([{}] * 2 if stopped == 0 else on_ranks(2, config, [network(), network()]))


@pytest.mark.parametrize(
    ("task", "validate", "settings", "sets", "message"),
    [
        (flow_task, "sets", "", {}, "has 0 flow fields"),
        (flow_task, "nowhere", "", {}, "no such file or folder"),
        (picture_task, "nowhere", "", {}, "no such file or folder"),
        (picture_task, "empty", "", {}, "has no recordings"),
        (picture_task, "empty", "sets/own.yaml", {}, "no recording of a/*.h5 (first), b/*.h5 (second) there"),
        (picture_task, "sets", "absent.yaml", {}, "run.validate_config: no file absent.yaml"),
        (
            picture_task, "sets", "sets/own.yaml", {"voxels": {"kind": "discrete", "bins": 3}},
            "voxel grids of 3 bins, but the network takes 5",
        ),
        (picture_task, "sets", "sets/own.yaml", {"data": [{**DATA_SETS[0], "sequences": {"0": [50, 60]}}]}, "0.h5"),
    ],
)  # fmt: skip
def test_what_cannot_be_scored_is_refused_at_once(
    tmp_path: Path, task: Callable[[], Task], validate: str, settings: str, sets: dict[str, Any], message: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    Path("empty").mkdir()
    two_sets(Path("sets"), **sets)
    random_recording(Path("sets") / "c.h5")
    scored = constant(0, 0) if task is flow_task else network()
    with pytest.raises(UsageError, match=re.escape(message)):
        Validation(task(), scored, RunConfig(validate=validate, validate_config=settings), ALONE)
