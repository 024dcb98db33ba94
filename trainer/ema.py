"""Exponential moving average of a network's weights: often better pictures than the last weights, for one copy of them.

    average <- average + (1 - d) (weights - average),    d = min(decay, (1 + n) / (10 + n)) at update n = 1, 2, ...

The ramp lets the random first weights go: a decay of 0.999 alone would still hold a third of them after 1000 updates.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping

import torch
from torch import Tensor

from trainer.models import ReconstructionNetwork
from v2v_protocol.errors import UsageError


def decay_at(update: int, decay: float) -> float:
    """d of update n (from 1)."""
    return min(decay, (1 + update) / (10 + update))


class AveragedNetwork:
    """The average of a network.

    Args:
        network: unwrapped; its present weights are the first average.
        decay: d after the ramp, in 0 .. 1, 1 excluded.

    Attributes:
        network: a copy that holds the average, without gradients: call it for pictures.

    Raises:
        UsageError: ``decay`` outside its range.
    """

    def __init__(self, network: ReconstructionNetwork, decay: float) -> None:
        if not 0 <= decay < 1:
            raise UsageError(f"ema_decay = {decay}: give 0 or more and less than 1")
        self.network = copy.deepcopy(network).requires_grad_(False)
        self._decay = decay

    @torch.no_grad()
    def update(self, network: ReconstructionNetwork, update: int) -> None:
        """Take in the weights after optimiser step number ``update`` (from 1). Nothing waits for the device."""
        share = 1 - decay_at(update, self._decay)
        fresh = network.state_dict()
        for name, average in self.network.state_dict().items():
            if average.is_floating_point():
                average.lerp_(fresh[name], share)
            else:
                average.copy_(fresh[name])  # a counter has no average

    def state_dict(self) -> dict[str, Tensor]:
        """The averaged weights, under the network's names."""
        return dict(self.network.state_dict())

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Go on from these."""
        self.network.load_state_dict(state)
