"""The interface between the training loop and a task."""

from __future__ import annotations

import abc
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Protocol

import torch
from torch import Tensor

from trainer.evaluation.data_sets import DataSet
from trainer.evaluation.voxelise import VoxelSettings
from trainer.models.sequence import Guide, VoxelNetwork
from trainer.pictures import Image
from trainer.precision import ieee_products
from v2v_client import Batch
from v2v_protocol.errors import UsageError
from v2v_protocol.recipe import Recipe
from v2v_protocol.settings import number, whole, word


@dataclass(frozen=True, slots=True, kw_only=True)
class Asked:
    """What a task needs from the stream.

    Attributes:
        arrays: names of the arrays of each sample.
        lead_frames, lead_voxels: see :class:`v2v_protocol.recipe.Recipe`.
        flow_direction, flow_from: see :class:`v2v_protocol.spec.StreamSpec`.
    """

    arrays: tuple[str, ...]
    lead_frames: int = 0
    lead_voxels: int = 0
    flow_direction: str = "forward"
    flow_from: int = 0

    def recipe(self, configured: Recipe) -> Recipe:
        """Return the configured recipe with this task's leads."""
        return configured.replace(lead_frames=self.lead_frames, lead_voxels=self.lead_voxels)


@dataclass(frozen=True, slots=True, kw_only=True)
class Work:
    """One batch, ready for the network and for the loss.

    Attributes:
        voxels: [B, T + lead_voxels, bins, H, W], input of the network.
        guide: second input of the network in training, or None.
        truth: targets of the loss by a name of the task, each [B, ...].
    """

    voxels: Tensor
    truth: Mapping[str, Tensor]
    guide: Guide | None = None

    def pieces(self, count: int) -> list[Work]:
        """Return the batch in ``count`` pieces of equal size: less memory, the same gradients."""
        if count == 1:
            return [self]
        voxels = self.voxels.chunk(count)
        truth = {name: tensor.chunk(count) for name, tensor in self.truth.items()}
        pictures = None if self.guide is None else self.guide.pictures.chunk(count)
        return [
            Work(
                voxels=voxels[i],
                truth={name: parts[i] for name, parts in truth.items()},
                guide=None if self.guide is None or pictures is None else Guide(pictures[i], self.guide.share),
            )
            for i in range(count)
        ]


class RecordingScorer(Protocol):
    """Score a network on single recordings of a data set, within its time ranges."""

    def check(self, path: Path, data_set: DataSet) -> None:
        """Check, without running the network, that a recording can be scored.

        Raises:
            UsageError: it cannot, and why.
        """

    def score(self, path: Path, data_set: DataSet, *, baseline: bool) -> Mapping[str, float]:
        """Return the scores by name, lower is better, the decisive one first.

        With ``baseline``, scores of what needs no network follow.

        Raises:
            UsageError: the recording is damaged, or the output of the network is not finite.
        """


class Task(abc.ABC):
    """One task.

    A subclass has as class attribute:
        Settings: frozen dataclass of the keys of section ``loss``.
        panels: names of the columns of its films; empty: no headings.

    Args:
        settings: an instance of ``Settings``.
        network: the network to train.
        bfloat16: also run networks of the loss, such as RAFT, under autocast.

    Raises:
        UsageError: a weight file is missing or wrong; the message names the key.
    """

    Settings: ClassVar[type[Any]]
    panels: ClassVar[tuple[str, ...]] = ()

    @abc.abstractmethod
    def __init__(self, settings: Any, network: VoxelNetwork, device: torch.device, *, bfloat16: bool) -> None: ...

    @classmethod
    def check(cls, settings: Any, recipe: Recipe) -> None:
        """Check the settings against each other and against the recipe.

        Raises:
            UsageError: they conflict; the message names the keys.
        """
        del settings, recipe

    @property
    @abc.abstractmethod
    def asked(self) -> Asked:
        """What the stream must deliver."""

    @abc.abstractmethod
    def prepare(self, batch: Batch, epoch: int | None) -> Work:
        """Move a batch to the device and estimate what the loss needs, such as flow.

        Args:
            batch: from a stream as in :attr:`asked`.
            epoch: of the training; None outside it.
        """

    @abc.abstractmethod
    def losses(self, prediction: Tensor, work: Work) -> dict[str, Tensor]:
        """Compute the loss without copying anything to the host.

        Args:
            prediction: output of the network for the voxels of ``work``, [B, T, C, H, W], or with more
                dimensions in front (:meth:`VoxelNetwork.unroll`).

        Returns:
            The weighted terms by name, detached, and their sum as "total", which is not detached.
        """

    @abc.abstractmethod
    def film(self, voxels: Tensor, prediction: Tensor, work: Work, sample: int) -> Image:
        """Draw input, [B, T, bins, H, W], target and output of one sample: [T, height, width, 3] uint8 RGB."""

    def recording_scorer(self, network: VoxelNetwork, voxels: VoxelSettings) -> RecordingScorer:
        """Return a scorer of recordings; each call scores the weights that ``network`` has then.

        Raises:
            UsageError: this task has no such scores.
        """
        del network, voxels
        raise UsageError(f"run.validate: {type(self).__name__} does not score recordings; leave the key out")

    @torch.no_grad()
    @ieee_products()
    def judge(self, network: VoxelNetwork, batch: Batch, films: int) -> tuple[dict[str, float], list[Image]]:
        """Return the losses of a network on a held-out batch, and films of the ``films`` samples that move most."""
        training = network.training
        network.eval()
        work = self.prepare(batch, None)
        prediction: Tensor = network(work.voxels)[0]
        losses = {name: float(value) for name, value in self.losses(prediction, work).items()}
        network.train(training)
        shown = liveliest(batch, films)
        return losses, [self.film(work.voxels, prediction.float(), work, sample) for sample in shown]


def liveliest(batch: Batch, count: int) -> list[int]:
    """Return the samples of a batch in whose frames most changes, in order: a still crop shows nothing.

    Args:
        count: number of samples wanted; there are fewer if the batch has fewer. Without frames they are the first.
    """
    if "frames" not in batch.arrays:
        return list(range(min(count, len(batch.indices))))
    changes = batch.arrays["frames"].float().diff(dim=1).abs().mean(dim=(1, 2, 3, 4))
    return sorted(changes.argsort(descending=True, stable=True)[:count].tolist())


def required_file(settings: Any, key: str, why: str, origin: str) -> str | Path:
    """Return the path of a weight file that a setting needs.

    Raises:
        UsageError: the key is empty.
    """
    path: str = getattr(settings, key)
    if not path:
        raise UsageError(f"loss.{key} is missing, {why} needs it. Nothing is downloaded; get it from {origin}")
    return path


def limited(default: float, low: float, high: float) -> Any:
    """Make a field for a number from ``low`` to ``high``, for a whole number if ``default`` is one."""
    return whole(default, int(low), int(high), "") if isinstance(default, int) else number(default, low, high, "")


def chosen(default: str, words: Mapping[str, Any]) -> Any:
    """Make a field for one of ``words``."""
    return word(default, words, "")
