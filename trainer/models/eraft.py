"""Define E-RAFT: RAFT between the voxel grids of two windows (Gehrig et al., 3DV 2021).

It is the large RAFT (:mod:`trainer.models.raft`) with three changes. Pictures are voxel grids. The context comes from
the later grid, because the flow is that of its window. The search starts from the previous window's flow, propagated
along itself. So a sequence of T outputs takes T + 1 grids.

5,270,080 parameters with 5 bins, 5,332,800 with 15.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor

from trainer.models.raft import RAFT, correlation_pyramid, forward_splat, torchvision_name
from trainer.models.sequence import Guide, Padding, Settings, VoxelNetwork
from v2v_protocol.errors import UsageError

UPDATES = 12
SIZE_MULTIPLE_PX = 32
_SMALLEST_SIDE_PX = 64
"""With this size the coarsest of four correlations has one pixel."""


class ERAFTState(NamedTuple):
    """Hold the last voxel grid after padding [B, bins, H, W], and the flow to start from [B, 2, H / 8, W / 8]."""

    voxel: Tensor
    start: Tensor | None


class ERAFT(VoxelNetwork):
    """Estimate flow with E-RAFT. In training it returns the flow after each of 12 updates, otherwise after the last.

    Args:
        bins: bins of a voxel grid; the published network has 15.
        warm_start: start from the propagated flow of the previous window, else from zero flow.
        context_by_window: in training, compute the batch norm statistics of the context for each window separately, as
            the published code does, instead of over all windows of the batch.
        normalize_voxels: see :class:`VoxelNetwork`; True for the published network.
        padding: see :class:`VoxelNetwork`.

    Raises:
        UsageError: ``bins`` is below 1.
    """

    task = "flow"
    signature = ("raft.feature_encoder.convnormrelu.0.weight",)
    lead_voxels = 1

    def __init__(
        self,
        *,
        bins: int = 5,
        warm_start: bool = True,
        context_by_window: bool = False,
        normalize_voxels: bool = False,
        padding: Padding = "top-left",
    ) -> None:
        if bins < 1:
            raise UsageError(f"ERAFT bins = {bins}: give 1 or more")
        super().__init__(bins=bins, size_multiple=SIZE_MULTIPLE_PX, normalizes=normalize_voxels, padding=padding)
        self.raft = RAFT("large", inputs=bins)
        self.warm_start = warm_start
        self.context_by_window = context_by_window

    def unroll(
        self, x: Tensor, state: ERAFTState | None, steps: int, _guide: Guide | None
    ) -> tuple[Tensor, ERAFTState]:
        """Run the network, see :meth:`VoxelNetwork.unroll`."""
        start = None if state is None else state.start
        batch = len(x) // steps
        voxels = x if state is None else torch.cat([state.voxel, x])
        # The encoders have no memory, so they run on all windows at once.
        features = torch.split(self.raft.features(voxels), batch)
        windows = voxels[batch:]
        found = [
            self.raft.context(each) for each in (torch.split(windows, batch) if self.context_by_window else [windows])
        ]
        hidden, context = (torch.split(torch.cat(tensors), batch) for tensors in zip(*found, strict=True))
        outputs = []
        for step in range(len(features) - 1):
            pyramid = correlation_pyramid(features[step], features[step + 1])
            refined = list(self.raft.refine(pyramid, hidden[step], context[step], UPDATES, start))
            if self.warm_start:
                start = forward_splat(refined[-1][0].detach())
            outputs.append([self.raft.upsample(*each) for each in (refined if self.training else refined[-1:])])
        flow = torch.stack([torch.cat(of_update) for of_update in zip(*outputs, strict=True)])
        return flow if self.training else flow[0], ERAFTState(voxels[-batch:], start)

    def _edges(self, height: int, width: int) -> tuple[int, int, int, int]:
        left, right, top, bottom = super()._edges(height, width)
        return (
            left + max(0, _SMALLEST_SIDE_PX - left - width - right), right,
            top + max(0, _SMALLEST_SIDE_PX - top - height - bottom), bottom,
        )  # fmt: skip

    @classmethod
    def own_name(cls, name: str) -> str:
        """Translate the published names, which are those of RAFT's authors."""
        return name if name.startswith("raft.") else f"raft.{torchvision_name(name)}"

    @classmethod
    def from_state(cls, state: Mapping[str, Tensor], settings: Settings) -> dict[str, Any]:
        """Derive the number of bins from the tensors."""
        bins = state["raft.feature_encoder.convnormrelu.0.weight"].shape[1]
        return {"bins": bins, "normalize_voxels": bool(settings.get("normalize", bins == 15))}
