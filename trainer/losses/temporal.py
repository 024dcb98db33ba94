"""Compute temporal consistency: points that move with the flow keep their brightness between reconstructions.

For the step from t-1 to t, with pictures I (true) and P (reconstructed), and W the warp onto the grid of t:

    M = exp(-alpha (I_t - W(I_(t-1)))^2)                                            alpha = 50
    l = mean[ M |P_t - W(P_(t-1))| / (|P_t| + |W(P_(t-1))| + 1e-5) ]

(Lai et al., ECCV 2018; as in E2VID, E2VID+ and V2V.) M hides pixels whose true brightness does not follow the flow:
occlusions, and errors of the flow. Gradients reach both P_t and P_(t-1).

The published loss differs in three ways, which ``as_published`` selects. It uses negated forward flow in place of
backward flow. Pixels that come from outside the picture count (as black) unless M happens to hide them. P_(t-1) is
clamped to 0 .. 255, which on pictures in 0 .. 1 only removes negative values.
"""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor, nn

from trainer.losses.warp import inside, warp
from v2v_protocol.errors import UsageError

ALPHA = 50.0
"""Sharpness of the mask M for brightness in 0 .. 1."""


class TemporalConsistency(nn.Module):
    """Compute the loss over the steps ``first_step`` .. T-1 of a clip in one pass.

    Args:
        first_step: the first t that counts (L0), at least 1. Recurrent networks need some steps to settle.
        rule: how the steps are averaged. "half" divides their sum by T, so uncounted steps count as zeros (the paper's
            rule; at T = 40 and L0 = 20 it gives half of the other). "full" is the mean over the counted steps.
        as_published: see the module; ``flow`` is then the forward flow.

    Raises:
        UsageError: ``first_step`` is below 1, or the rule is unknown.
    """

    def __init__(
        self, *, first_step: int = 20, rule: Literal["half", "full"] = "half", as_published: bool = False
    ) -> None:
        super().__init__()
        if first_step < 1:
            raise UsageError(f"temporal first_step = {first_step}: give 1 or more, step 0 has no picture before it")
        if rule not in ("half", "full"):
            raise UsageError(f"temporal rule = {rule!r}: give half or full")
        self.first_step = first_step
        self.rule = rule
        self.as_published = as_published

    def forward(self, prediction: Tensor, target: Tensor, flow: Tensor) -> Tensor:
        """Compute the loss of a batch of clips.

        Args:
            prediction: [B, T, 1, H, W].
            target: true pictures in 0 .. 1, same shape.
            flow: [B, T - first_step, 2, H, W], px in (x, y); entry k belongs to t = first_step + k. Backward flow: on
                the grid of t, pointing to where each pixel was at t-1, so that I_(t-1)(x + flow(x)) = I_t(x). With
                ``as_published``, forward flow: on the grid of t-1, pointing to where each pixel is at t.

        Returns:
            A scalar, float32 or wider.

        Raises:
            UsageError: the shapes do not match, or no step is left to count.
        """
        if prediction.ndim != 5 or prediction.shape != target.shape:
            raise UsageError(f"prediction {list(prediction.shape)}, target {list(target.shape)}: both [B, T, 1, H, W]")
        batch, steps, _, height, width = prediction.shape
        counted = steps - self.first_step
        if counted < 1:
            raise UsageError(f"temporal first_step = {self.first_step} with clips of T = {steps}: no step is left")
        if flow.shape != (batch, counted, 2, height, width):
            raise UsageError(
                f"flow {list(flow.shape)}: give {[batch, counted, 2, height, width]}, from t = first_step on"
            )
        dtype = torch.promote_types(prediction.dtype, torch.float32)
        with torch.autocast(prediction.device.type, enabled=False):
            displacement = flow.flatten(0, 1).to(dtype) * (-1 if self.as_published else 1)
            now = torch.cat([target, prediction], dim=2)[:, self.first_step :].flatten(0, 1).to(dtype)
            before = torch.cat([target, prediction], dim=2)[:, self.first_step - 1 : -1].flatten(0, 1).to(dtype)
            if self.as_published:
                before = before.clamp(0, 255)
            true_now, predicted_now = now.chunk(2, dim=1)
            true_before, predicted_before = warp(before, displacement).chunk(2, dim=1)
            weight = torch.exp(-ALPHA * (true_now - true_before).square())
            if not self.as_published:
                weight = weight * inside(displacement)
            difference = (predicted_now - predicted_before).abs()
            error = weight * difference / (predicted_now.abs() + predicted_before.abs() + 1e-5)
            return error.mean() * (counted / steps if self.rule == "half" else 1.0)
