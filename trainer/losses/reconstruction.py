"""Compute the training loss of the reconstruction networks: LPIPS + L1 + temporal consistency."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from trainer.losses.lpips import LPIPS
from trainer.losses.temporal import TemporalConsistency
from v2v_protocol.errors import UsageError


def l1_loss(prediction: Tensor, target: Tensor) -> Tensor:
    """Return the mean absolute difference over all elements of two tensors [...], in float32 or wider.

    Raises:
        UsageError: the shapes differ; broadcasting would hide that.
    """
    if prediction.shape != target.shape:
        raise UsageError(f"prediction {list(prediction.shape)} and target {list(target.shape)}: give equal shapes")
    dtype = torch.promote_types(prediction.dtype, torch.float32)
    return (prediction.to(dtype) - target.to(dtype)).abs().mean()


class ReconstructionLoss(nn.Module):
    """Sum the weighted terms. Terms with weight 0 are not computed.

    Args:
        lpips: the metric; required if ``lpips_weight`` is not 0.
        temporal: the loss; required if ``temporal_weight`` is not 0.
        lpips_weight, l1_weight, temporal_weight: 0 or more; 1 each in the paper.

    Raises:
        UsageError: a weight is negative, all are 0, or a weighted term is missing.
    """

    def __init__(
        self,
        *,
        lpips: LPIPS | None = None,
        temporal: TemporalConsistency | None = None,
        lpips_weight: float = 0.0,
        l1_weight: float = 1.0,
        temporal_weight: float = 0.0,
    ) -> None:
        super().__init__()
        weights = (lpips_weight, l1_weight, temporal_weight)
        if min(weights) < 0 or max(weights) == 0:
            raise UsageError(f"loss weights lpips, l1, temporal = {weights}: give 0 or more, and at least one above 0")
        if lpips_weight and lpips is None:
            raise UsageError(f"lpips_weight = {lpips_weight} without a network: give the LPIPS weight files, or 0")
        if temporal_weight and temporal is None:
            raise UsageError(
                f"temporal_weight = {temporal_weight} without a temporal loss: give one, or set the weight to 0"
            )
        self.lpips = lpips
        self.temporal = temporal
        self.lpips_weight = lpips_weight
        self.l1_weight = l1_weight
        self.temporal_weight = temporal_weight

    def forward(self, prediction: Tensor, target: Tensor, flow: Tensor | None = None) -> dict[str, Tensor]:
        """Compute the terms and their sum.

        Args:
            prediction: [B, T, 1, H, W], not clamped.
            target: pictures in 0 .. 1, same shape.
            flow: see :meth:`TemporalConsistency.forward`; only needed with ``temporal_weight``.

        Returns:
            The weighted terms by name ("lpips", "l1", "temporal", those with a weight), and their sum as "total". Only
            ``total`` has a gradient; the terms are detached. All stay on the device.

        Raises:
            UsageError: the shapes do not match, or flow is missing.
        """
        terms: dict[str, Tensor] = {}
        if self.lpips is not None and self.lpips_weight:
            terms["lpips"] = self.lpips_weight * self.lpips(prediction, target).mean()
        if self.l1_weight:
            terms["l1"] = self.l1_weight * l1_loss(prediction, target)
        if self.temporal is not None and self.temporal_weight:
            if flow is None:
                raise UsageError("flow is missing: temporal consistency needs the flow between target frames")
            terms["temporal"] = self.temporal_weight * self.temporal(prediction, target, flow)
        total = torch.stack(list(terms.values())).sum()
        return {name: term.detach() for name, term in terms.items()} | {"total": total}
