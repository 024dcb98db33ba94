"""Score the network on recordings during training; the ranks share the recordings."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from trainer.config import RunConfig
from trainer.evaluation.config import EvaluationConfig, folder_config, read_config
from trainer.evaluation.data_sets import DataSet
from trainer.evaluation.evaluate import find_recordings
from trainer.evaluation.score import mean_by_name
from trainer.evaluation.voxelise import VoxelSettings
from trainer.models import VoxelNetwork
from trainer.run.distributed import Ranks
from trainer.tasks import Task
from v2v_protocol.errors import UsageError, V2VError


class Validation:
    """Score a network on the recordings of ``run.validate``.

    Each rank scores a part of the recordings. A score is the mean over the recordings of a data set, then the mean over
    the data sets, whatever their sizes.

    Args:
        network: is scored as it is at each call; equal weights on all ranks.
        run: says which recordings.

    Raises:
        UsageError: no recordings, recordings that cannot be scored, or voxel grids that the network does not take.
    """

    def __init__(self, task: Task, network: VoxelNetwork, run: RunConfig, ranks: Ranks) -> None:
        self._network, self._ranks, self._data = network, ranks, Path(run.validate)
        if not self._data.exists():
            raise UsageError(f"run.validate = {self._data}: no such file or folder")
        config = _configuration(run, self._data)
        found = [
            (data_set, path) for data_set in config.data_sets for path in find_recordings(self._data, data_set).values()
        ]
        # All ranks share the list of the first, even if the folders of two hosts differ.
        self._items = ranks.from_first(found)
        if not self._items:
            wanted = ", ".join(f"{data_set.folder}/*.h5 ({data_set.name})" for data_set in config.data_sets)
            raise UsageError(f"run.validate = {self._data}: no recording of {wanted} there; v2v-convert makes them")
        voxels = config.voxels or VoxelSettings(bins=network.bins)
        if voxels.bins != network.bins:
            raise UsageError(
                f"run.validate_config = {run.validate_config}: voxel grids of {voxels.bins} bins, but the network "
                f"takes {network.bins}; change voxels.bins there"
            )
        self._scorer = task.recording_scorer(network, voxels)
        for data_set, path in self._share():
            self._scorer.check(path, data_set)

    def _share(self) -> list[tuple[DataSet, Path]]:
        """Return the recordings that this rank scores."""
        return list(self._items[self._ranks.rank :: self._ranks.world_size])

    def __call__(self, *, baseline: bool = False, stopping: Callable[[], bool] = bool) -> dict[str, float]:
        """Return the scores by name; the first decides which network is the best, lower is better. All ranks call it.

        Args:
            baseline: also score what needs no network, such as a constant grey.
            stopping: asked after each recording; if it is true on any rank, the result is empty.

        Raises:
            UsageError: a recording cannot be scored, on any rank, or the recordings have no score in common.
        """
        # Batch norm keeps its statistics in buffers, which differ between ranks; checkpoints hold those of the first.
        self._ranks.copy_from_first(self._network.buffers())
        training, failure = self._network.training, ""
        means: list[tuple[str, Mapping[str, float]]] = []
        try:
            for data_set, path in self._share():
                means.append((data_set.name, self._scorer.score(path, data_set, baseline=baseline)))
                if stopping():
                    break
        except (V2VError, OSError) as error:
            failure = str(error)  # raised on all ranks together: the others would wait for this one
        finally:
            self._network.train(training)
        shares = self._ranks.gather((means, failure))
        failures = [failure for _, failure in shares if failure]
        if failures:
            raise UsageError(f"run.validate = {self._data}: {failures[0]}")
        if sum(len(scored) for scored, _ in shares) < len(self._items):
            return {}
        by_data_set: dict[str, list[Mapping[str, float]]] = {}
        for number in range(len(self._items)):
            name, scores = shares[number % len(shares)][0][number // len(shares)]
            by_data_set.setdefault(name, []).append(scores)
        found = mean_by_name([mean_by_name(scores) for scores in by_data_set.values()])
        if not found:
            raise UsageError(
                f"run.validate = {self._data}: the recordings have no score in common; leave out those without "
                "pictures, or without known flow"
            )
        return found


def _configuration(run: RunConfig, data: Path) -> EvaluationConfig:
    if not run.validate_config:
        return folder_config(data)
    try:
        return read_config(run.validate_config)
    except UsageError as error:
        raise UsageError(f"run.validate_config: {error}") from error
