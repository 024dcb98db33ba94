"""The flow loss: analytic values, masks, and the weights of updates."""

from __future__ import annotations

import pytest
import torch

from trainer.tasks.flow import flow_loss


def uniform(x: float, y: float) -> torch.Tensor:
    return torch.tensor([float(x), float(y)]).view(1, 1, 2, 1, 1).expand(2, 3, 2, 4, 5)


def test_it_is_the_mean_absolute_difference_where_pixels_are_valid() -> None:
    truth, valid = uniform(1, -3).clone(), torch.ones(2, 3, 1, 4, 5)
    truth[:, :, :, :2] = 1000.0
    valid[:, :, :, :2] = 0
    assert float(flow_loss(uniform(0, 0), truth, valid, 0.0)) == pytest.approx(2)
    nothing = flow_loss(uniform(0, 0).clone().requires_grad_(), truth, torch.zeros_like(valid), 0.0)
    assert float(nothing.detach()) == 0
    nothing.backward()


@pytest.mark.parametrize(("gamma", "expected"), [(0.0, 3.0), (0.5, 0.25 * 1 + 0.5 * 2 + 3), (1.0, 6.0)])
def test_earlier_updates_weigh_less(gamma: float, expected: float) -> None:
    updates = torch.stack([uniform(1, 1), uniform(2, 2), uniform(3, 3)]).clone().requires_grad_()
    loss = flow_loss(updates, uniform(0, 0), None, gamma)
    assert float(loss.detach()) == pytest.approx(expected)
    (gradient,) = torch.autograd.grad(loss, updates)
    per_update = gradient.sum(dim=(1, 2, 3, 4, 5))
    assert per_update.tolist() == pytest.approx([gamma**2, gamma, 1.0])
