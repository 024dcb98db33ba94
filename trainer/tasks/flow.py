"""Optical flow from events, trained with the L1 distance to flow between the frames.

Ordinary video has no true flow, so the target is an estimate: of the server's workers, or of RAFT on this device. Both
are on the grid of a step's earlier frame, [2, H, W] (x, y) in px over one voxel grid.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from trainer import pictures
from trainer.evaluation.data_sets import DataSet
from trainer.evaluation.flow import FlowRun, evaluate_flow
from trainer.evaluation.readers import Recording
from trainer.evaluation.voxelise import VoxelSettings
from trainer.evaluation.windows import flow_windows
from trainer.models.raft_flow import WHERE_TO_GET_WEIGHTS, RaftFlow
from trainer.models.sequence import VoxelNetwork
from trainer.tasks.task import Asked, Task, Work, chosen, limited, required_file
from v2v_client import Batch
from v2v_protocol.errors import UsageError
from v2v_protocol.recipe import Recipe


@dataclass(frozen=True, slots=True, kw_only=True)
class FlowTaskSettings:
    """The loss.

    Attributes:
        flow: "raft" on this device, or "stream": estimated by the server's workers, or exact where the stream shows
            photographs that move.
        raft_size, raft_weights: "small" or "large", and its weight file.
        valid: which pixels count: "all" (published), or "consistent": those that the stream's ``flow_valid`` admits.
            There forward and backward flow agree, or a point of a photograph is seen at both ends.
        gamma: for a network that refines its estimate, update i of n has weight gamma^(n - 1 - i); 0: only the last
            one counts (published).
    """

    flow: Literal["raft", "stream"] = "raft"
    raft_size: str = chosen("large", WHERE_TO_GET_WEIGHTS)
    raft_weights: str = ""
    valid: Literal["all", "consistent"] = "all"
    gamma: float = limited(0.8, 0, 1)


def flow_loss(prediction: Tensor, truth: Tensor, valid: Tensor | None, gamma: float) -> Tensor:
    """Return the mean absolute difference over both components and all pixels that count.

    Args:
        prediction: [B, T, 2, H, W], or [updates, B, T, 2, H, W]: see :class:`FlowTaskSettings`.
        truth: [B, T, 2, H, W].
        valid: [B, T, 1, H, W], 1 where a pixel counts; None: all do.
        gamma: see :class:`FlowTaskSettings`.

    Returns:
        A scalar, in float32 at least; 0 where nothing counts.
    """
    estimates = prediction if prediction.ndim > truth.ndim else prediction[None]
    if not gamma:
        estimates = estimates[-1:]
    difference = (estimates.to(torch.promote_types(estimates.dtype, torch.float32)) - truth).abs()
    if valid is None:
        means = difference.flatten(1).mean(dim=1)
    else:
        counted = (2 * valid.sum(dtype=difference.dtype)).clamp_min(1)
        means = (difference * valid).flatten(1).sum(dim=1) / counted
    count = len(means)
    weights = [gamma ** (count - 1 - number) for number in range(count)]  # 0 ** 0 is 1
    return torch.stack([weight * mean for weight, mean in zip(weights, means.unbind(), strict=True)]).sum()


class Flow(Task):
    """See :class:`trainer.tasks.task.Task`.

    Truth: ``flow`` [B, T, 2, H, W], and ``valid`` [B, T, 1, H, W] with ``loss.valid`` "consistent".
    """

    Settings = FlowTaskSettings
    panels = (pictures.EVENTS, "flow to find", "flow found")

    def __init__(
        self, settings: FlowTaskSettings, network: VoxelNetwork, device: torch.device, *, bfloat16: bool
    ) -> None:
        self.settings = settings
        self.device = device
        self._lead_voxels = network.lead_voxels
        self._raft: RaftFlow | None = None
        if settings.flow == "raft":
            origin = WHERE_TO_GET_WEIGHTS[settings.raft_size]
            weights = required_file(settings, "raft_weights", "loss.flow = raft (or take loss.flow = stream)", origin)
            self._raft = RaftFlow(settings.raft_size, weights, device, bfloat16=bfloat16)

    @classmethod
    def check(cls, _settings: FlowTaskSettings, recipe: Recipe) -> None:
        """See :meth:`Task.check`."""
        if recipe.grids_per_frame > 1:
            raise UsageError(
                f"stream.recipe.grids_per_frame = {recipe.grids_per_frame}: a flow network needs the flow of every "
                "voxel grid, and frames give that of a whole step; set grids_per_frame to 1 or 0"
            )

    @property
    def asked(self) -> Asked:
        """Flow, or the frames to estimate it from, including the one before the first voxel grid."""
        masks = ("flow_valid",) if self.settings.valid == "consistent" else ()
        if self._raft is None:
            return Asked(arrays=("voxels", "flow", *masks), lead_voxels=self._lead_voxels)
        return Asked(arrays=("voxels", "frames", *masks), lead_frames=1, lead_voxels=self._lead_voxels)

    def prepare(self, batch: Batch, _epoch: int | None) -> Work:
        """See :meth:`Task.prepare`."""
        arrays = {name: tensor.to(self.device) for name, tensor in batch.arrays.items()}
        if self._raft is None:
            flow = arrays["flow"].float()
        else:
            frames = arrays["frames"] / 255.0
            pairs = self._raft(frames[:, :-1].flatten(0, 1), frames[:, 1:].flatten(0, 1))
            flow = torch.unflatten(pairs, 0, (len(frames), -1))
        truth = {"flow": flow}
        if "flow_valid" in arrays:
            truth["valid"] = arrays["flow_valid"].float()
        return Work(voxels=arrays["voxels"], truth=truth)

    def losses(self, prediction: Tensor, work: Work) -> dict[str, Tensor]:
        """See :meth:`Task.losses`: the distance, and for reports the mean end-point error of the last estimate, px."""
        truth, valid = work.truth["flow"], work.truth.get("valid")
        with torch.autocast(prediction.device.type, enabled=False):
            total = flow_loss(prediction, truth, valid, self.settings.gamma)
            last = prediction.detach().float().reshape(-1, *truth.shape)[-1]
            error = torch.linalg.vector_norm(last - truth, dim=2).mean()
        return {"end_point_error_px": error, "total": total}

    def recording_scorer(self, network: VoxelNetwork, voxels: VoxelSettings) -> FlowScorer:
        """See :meth:`Task.recording_scorer`: AEE and 3PE as ``v2v-eval`` gives them; the baseline is no motion."""
        return FlowScorer(FlowRun(network, voxels, str(self.device)))

    def film(self, voxels: Tensor, prediction: Tensor, work: Work, sample: int) -> pictures.Image:
        """See :meth:`Task.film`: events, target and estimate; both flows in the colours of one scale."""
        truth, found = (x[sample].cpu().numpy() for x in (work.truth["flow"], prediction))
        events = pictures.draw_events(voxels[sample, -len(truth) :].cpu().numpy())
        scale = pictures.flow_scale(truth)
        return pictures.side_by_side([events, pictures.draw_flow(truth, scale), pictures.draw_flow(found, scale)])


@dataclass(frozen=True, slots=True)
class FlowScorer:
    """See :class:`trainer.tasks.task.RecordingScorer`."""

    run: FlowRun

    def check(self, path: Path, data_set: DataSet) -> None:
        """Check that the recording has flow in its time range."""
        with Recording(path) as recording:
            flow_windows(recording, data_set.time_ranges[path.stem])

    def score(self, path: Path, data_set: DataSet, *, baseline: bool) -> dict[str, float]:
        """Return means over the windows."""
        found = evaluate_flow(self.run, path, data_set.time_ranges[path.stem])
        zeros = {f"zeros_{name}": value for name, value in found["zeros"].means.items()} if baseline else {}
        return found["network"].means | zeros
