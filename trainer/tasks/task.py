"""What the training loop asks of a task."""

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
    """What a task needs of the stream.

    Attributes:
        arrays: of each sample.
        lead_frames, lead_voxels: see :class:`v2v_protocol.recipe.Recipe`.
        flow_direction, flow_from: see :class:`v2v_protocol.spec.StreamSpec`.
    """

    arrays: tuple[str, ...]
    lead_frames: int = 0
    lead_voxels: int = 0
    flow_direction: str = "forward"
    flow_from: int = 0

    def recipe(self, configured: Recipe) -> Recipe:
        """The configured one with this task's leads."""
        return configured.replace(lead_frames=self.lead_frames, lead_voxels=self.lead_voxels)


@dataclass(frozen=True, slots=True, kw_only=True)
class Work:
    """One batch, ready for the network and for the loss.

    Attributes:
        voxels: [B, T + lead_voxels, bins, H, W]: what the network takes.
        guide: what it takes beside them in training, or None.
        truth: what its outputs are compared with, each [B, ...]; the task knows their names.
    """

    voxels: Tensor
    truth: Mapping[str, Tensor]
    guide: Guide | None = None

    def pieces(self, count: int) -> list[Work]:
        """Itself in ``count`` pieces of equally many samples: less memory, the same gradients."""
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
    """Scores a network on single recordings of a data set, within its cuts."""

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
        panels: names of what its films show side by side; none: they have no headings.

    Args:
        settings: an instance of it.
        network: that is trained.
        device: where it computes.
        bfloat16: networks that only judge or estimate run under autocast as well.

    Raises:
        UsageError: a weight file is missing or wrong; the message names the key.
    """

    Settings: ClassVar[type[Any]]
    panels: ClassVar[tuple[str, ...]] = ()

    @abc.abstractmethod
    def __init__(self, settings: Any, network: VoxelNetwork, device: torch.device, *, bfloat16: bool) -> None: ...

    @classmethod
    def check(cls, settings: Any, recipe: Recipe) -> None:
        """
        Raises:
            UsageError: settings that conflict with each other or with the recipe; the message names the keys.
        """
        del settings, recipe

    @property
    @abc.abstractmethod
    def asked(self) -> Asked:
        """What the stream must give."""

    @abc.abstractmethod
    def prepare(self, batch: Batch, epoch: int | None) -> Work:
        """A batch on the device as the network takes it, estimates that the loss needs included.

        Args:
            batch: of a stream as :attr:`asked`.
            epoch: of the training; None outside it.
        """

    @abc.abstractmethod
    def losses(self, prediction: Tensor, work: Work) -> dict[str, Tensor]:
        """
        Args:
            prediction: what the network made of the voxels of ``work``.
            work: of :meth:`prepare`.

        Returns:
            The weighted terms by name, detached, and their sum as "total", which is what to differentiate. Nothing is
            copied to the host.
        """

    @abc.abstractmethod
    def film(self, voxels: Tensor, prediction: Tensor, work: Work, sample: int) -> Image:
        """What the network saw of one sample, made of it, and should have made: [T, height, width, 3] uint8 RGB."""

    def recording_scorer(self, network: VoxelNetwork, voxels: VoxelSettings) -> RecordingScorer:
        """Return what scores ``network``, as it is at each call, on recordings in voxel grids of that kind.

        Raises:
            UsageError: this task has no such scores.
        """
        del network, voxels
        raise UsageError(f"run.validate: {type(self).__name__} does not score recordings; leave the key out")

    @torch.no_grad()
    @ieee_products()
    def judge(self, network: VoxelNetwork, batch: Batch, films: int) -> tuple[dict[str, float], list[Image]]:
        """Losses of a network on a batch that it is not trained on, and films of the first samples."""
        training = network.training
        network.eval()
        work = self.prepare(batch, None)
        prediction: Tensor = network(work.voxels)[0]
        losses = {name: float(value) for name, value in self.losses(prediction, work).items()}
        network.train(training)
        shown = range(min(films, len(prediction)))
        return losses, [self.film(work.voxels, prediction.float(), work, sample) for sample in shown]


def required_file(settings: Any, key: str, why: str, origin: str) -> str | Path:
    """The path of a weight file that a setting needs.

    Raises:
        UsageError: the key is empty.
    """
    path: str = getattr(settings, key)
    if not path:
        raise UsageError(f"loss.{key} is missing, {why} needs it. Nothing is downloaded; get it from {origin}")
    return path


def limited(default: float, low: float, high: float) -> Any:
    """A field of settings that is a number from ``low`` to ``high``, a whole one where ``default`` is."""
    return whole(default, int(low), int(high), "") if isinstance(default, int) else number(default, low, high, "")


def chosen(default: str, words: Mapping[str, Any]) -> Any:
    """A field of settings that is one of ``words``."""
    return word(default, words, "")
