"""Reconstruction: pictures from events, trained with LPIPS, L1 and temporal consistency."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from trainer import pictures
from trainer.evaluation.data_sets import DataSet
from trainer.evaluation.evaluate import Run, check_recording, evaluate_sequence
from trainer.evaluation.metrics import make_metrics
from trainer.evaluation.voxelise import VoxelSettings
from trainer.losses.backbones import BACKBONES
from trainer.losses.lpips import HEADS_FROM, LPIPS
from trainer.losses.reconstruction import ReconstructionLoss
from trainer.losses.temporal import TemporalConsistency
from trainer.models.raft_flow import WHERE_TO_GET_WEIGHTS, RaftFlow
from trainer.models.sequence import Guide, VoxelNetwork
from trainer.tasks.task import Asked, Task, Work, chosen, limited, required_file
from v2v_client import Batch
from v2v_protocol.errors import UsageError
from v2v_protocol.recipe import Recipe


@dataclass(frozen=True, slots=True, kw_only=True)
class ReconstructionSettings:
    """Hold the settings of the loss, a weighted sum. A term of weight 0 is not computed and needs no file.

    Attributes:
        l1_weight, lpips_weight, temporal_weight: weights of the terms.
        lpips_network: "vgg", "alex" or "squeeze".
        lpips_backbone, lpips_heads: its weight files.
        temporal_first_step, temporal_rule, temporal_as_published: see
            :class:`trainer.losses.temporal.TemporalConsistency`.
        flow: "raft" on this device, or "stream": estimated by the server's workers.
        raft_size, raft_weights: "small" or "large", and its weight file.
        voxels: the array that the network takes: "voxels", or "voxels_bilinear" (interpolated).
        guide_epochs: epochs in which a network that sees its own last picture (HyperE2VID) gets a mixture of that and
            the true one; the share of the true one falls linearly from 1 to 0. 0: it never gets the true one.
        guide_as_published: the true picture at step t is that of t, which is the target itself; else that of t-1.
    """

    l1_weight: float = limited(1.0, 0, 1e6)
    lpips_weight: float = limited(0.0, 0, 1e6)
    temporal_weight: float = limited(0.0, 0, 1e6)
    lpips_network: str = chosen("vgg", BACKBONES)
    lpips_backbone: str = ""
    lpips_heads: str = ""
    temporal_first_step: int = limited(20, 1, 1_000_000)
    temporal_rule: Literal["half", "full"] = "half"
    temporal_as_published: bool = False
    flow: Literal["raft", "stream"] = "raft"
    raft_size: str = chosen("small", WHERE_TO_GET_WEIGHTS)
    raft_weights: str = ""
    voxels: Literal["voxels", "voxels_bilinear"] = "voxels"
    guide_epochs: int = limited(0, 0, 1_000_000)
    guide_as_published: bool = False


class Reconstruction(Task):
    """See :class:`trainer.tasks.task.Task`.

    Truth: ``frames`` [B, T, 1, H, W] in 0 .. 1, and for the temporal loss ``flow`` [B, T - first_step, 2, H, W].
    """

    Settings = ReconstructionSettings
    panels = (pictures.EVENTS, "target", "reconstruction")

    def __init__(
        self, settings: ReconstructionSettings, _network: VoxelNetwork | None, device: torch.device, *, bfloat16: bool
    ) -> None:
        self.settings = settings
        self.device = device
        self._loss = _loss(settings).to(device)
        self._raft: RaftFlow | None = None
        if settings.temporal_weight and settings.flow == "raft":
            origin = WHERE_TO_GET_WEIGHTS[settings.raft_size]
            weights = required_file(settings, "raft_weights", "loss.flow = raft (or take loss.flow = stream)", origin)
            self._raft = RaftFlow(settings.raft_size, weights, device, bfloat16=bfloat16)

    @classmethod
    def check(cls, settings: ReconstructionSettings, recipe: Recipe) -> None:
        """See :meth:`Task.check`."""
        if not settings.l1_weight + settings.lpips_weight + settings.temporal_weight:
            raise UsageError("loss.l1_weight, lpips_weight and temporal_weight are all 0: nothing would be trained")
        if settings.temporal_weight and settings.temporal_first_step >= recipe.voxels_per_clip:
            raise UsageError(
                f"loss.temporal_first_step = {settings.temporal_first_step}: give less than "
                f"stream.recipe.voxels_per_clip = {recipe.voxels_per_clip}"
            )
        if settings.guide_epochs and recipe.grids_per_frame > 1:
            raise UsageError(
                f"stream.recipe.grids_per_frame = {recipe.grids_per_frame}: loss.guide_epochs = "
                f"{settings.guide_epochs} needs a picture for every voxel grid; set grids_per_frame to 1, or "
                "guide_epochs to 0"
            )

    @property
    def asked(self) -> Asked:
        """Arrays to request: frames, and flow if the stream estimates it."""
        if not self.settings.temporal_weight or self._raft is not None:
            return Asked(arrays=(self.settings.voxels, "frames"))
        # The loss needs to know where each pixel was; the released code takes negated forward flow for that.
        direction = "forward" if self.settings.temporal_as_published else "backward"
        return Asked(
            arrays=(self.settings.voxels, "frames", "flow"),
            flow_direction=direction,
            flow_from=self.settings.temporal_first_step,
        )

    def prepare(self, batch: Batch, epoch: int | None) -> Work:
        """See :meth:`Task.prepare`."""
        frames = batch.arrays["frames"].to(self.device) / 255.0
        truth = {"frames": frames}
        if self._loss.temporal is not None:
            truth["flow"] = self._flow(batch, frames)
        voxels = batch.arrays[self.settings.voxels].to(self.device)
        return Work(voxels=voxels, truth=truth, guide=self._guide(frames, epoch))

    def recording_scorer(self, network: VoxelNetwork, voxels: VoxelSettings) -> PictureScorer:
        """See :meth:`Task.recording_scorer`.

        Scores are LPIPS by the network that the loss names, if its files are given, MSE, and 1 - correlation as
        ``correlation_lacking``. The baseline is a blank picture in the mean grey of each target.
        """
        chosen, files = self.settings, {}
        if chosen.lpips_backbone and chosen.lpips_heads:
            files[chosen.lpips_network] = (chosen.lpips_backbone, chosen.lpips_heads)
        metrics = make_metrics([*(f"lpips_{net}" for net in files), "mse", "correlation"], files, str(self.device))
        return PictureScorer(Run(network, voxels, metrics, str(self.device)))

    def _flow(self, batch: Batch, frames: Tensor) -> Tensor:
        first = self.settings.temporal_first_step
        if self._raft is None:
            return batch.arrays["flow"].to(self.device)[:, first:].float()
        before, now = frames[:, first - 1 : -1].flatten(0, 1), frames[:, first:].flatten(0, 1)
        pair = (before, now) if self.settings.temporal_as_published else (now, before)
        return torch.unflatten(self._raft(*pair), 0, (len(frames), -1))

    def _guide(self, frames: Tensor, epoch: int | None) -> Guide | None:
        if epoch is None or epoch >= self.settings.guide_epochs:
            return None
        if not self.settings.guide_as_published:
            # The first step has no earlier picture, as after a reset.
            frames = torch.cat([torch.zeros_like(frames[:, :1]), frames[:, :-1]], dim=1)
        return Guide(frames, 1 - epoch / self.settings.guide_epochs)

    def losses(self, prediction: Tensor, work: Work) -> dict[str, Tensor]:
        """See :meth:`Task.losses`: terms "lpips", "l1", "temporal" with a weight above 0."""
        truth = work.truth["frames"]
        losses: dict[str, Tensor] = self._loss(_at_frames(prediction, truth, 1), truth, work.truth.get("flow"))
        return losses

    def film(self, voxels: Tensor, prediction: Tensor, work: Work, sample: int) -> pictures.Image:
        """See :meth:`Task.film`: events, target and reconstruction."""
        truth = work.truth["frames"][sample]
        seen, found = (_at_frames(each[sample], truth, 0).cpu().numpy() for each in (voxels, prediction))
        grey = (pictures.draw_grey(each[:, 0]) for each in (truth.cpu().numpy(), found))
        panels = [pictures.draw_events(seen), *grey]
        return pictures.side_by_side(panels)


@dataclass(frozen=True, slots=True)
class PictureScorer:
    """See :class:`trainer.tasks.task.RecordingScorer`."""

    run: Run

    def check(self, path: Path, data_set: DataSet) -> None:
        """Check that the recording has the pictures of its time range."""
        check_recording(self.run, path, data_set)

    def score(self, path: Path, data_set: DataSet, *, baseline: bool) -> dict[str, float]:
        """Return means over the pictures."""
        found = evaluate_sequence(replace(self.run, score_blank=baseline), path, data_set)
        scores = {"": found.means, "constant_grey_": found.blank}
        return {
            prefix + name.replace("correlation", "correlation_lacking"): 1 - value if name == "correlation" else value
            for prefix, means in scores.items()
            for name, value in means.items()
        }


def _at_frames(each_grid: Tensor, frames: Tensor, axis: int) -> Tensor:
    """Return what belongs to the voxel grids that end at a frame: every n-th of n for each frame, along an axis."""
    grids = each_grid.shape[axis] // frames.shape[axis]
    return torch.unflatten(each_grid, axis, (-1, grids)).select(axis + 1, -1)


def _loss(settings: ReconstructionSettings) -> ReconstructionLoss:
    lpips = temporal = None
    if settings.lpips_weight:
        net, why = settings.lpips_network, f"loss.lpips_weight = {settings.lpips_weight:g}"
        lpips = LPIPS.from_files(
            net,
            required_file(settings, "lpips_backbone", why, BACKBONES[net].weights_from),
            required_file(settings, "lpips_heads", why, HEADS_FROM.format(net=net)),
        )
    if settings.temporal_weight:
        temporal = TemporalConsistency(
            first_step=settings.temporal_first_step,
            rule=settings.temporal_rule,
            as_published=settings.temporal_as_published,
        )
    return ReconstructionLoss(
        lpips=lpips,
        temporal=temporal,
        lpips_weight=settings.lpips_weight,
        l1_weight=settings.l1_weight,
        temporal_weight=settings.temporal_weight,
    )
