"""Test warp, temporal consistency, L1 and their sum: analytic motion, a NumPy oracle, signs, gradients."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from tests.trainer.models import numpy_networks as oracle
from trainer.losses.lpips import LPIPS
from trainer.losses.reconstruction import ReconstructionLoss, l1_loss
from trainer.losses.temporal import TemporalConsistency
from trainer.losses.warp import warp
from v2v_protocol.errors import UsageError

HEIGHT, WIDTH = 20, 24


def uniform(x: float, y: float, count: int = 1, height: int = HEIGHT, width: int = WIDTH) -> torch.Tensor:
    """Return a constant displacement, [count, 2, height, width] float64."""
    return torch.tensor([x, y], dtype=torch.float64).view(1, 2, 1, 1).expand(count, 2, height, width)


def moving(velocity: tuple[float, float], steps: int, *, offset: float = 0.5) -> torch.Tensor:
    """Return a texture that moves ``velocity`` px per step: [1, steps, 1, H, W] float64 in 0 .. 1."""
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH].astype(np.float64)
    frames = []
    for step in range(steps):
        u, v = x - velocity[0] * step, y - velocity[1] * step
        frames.append(offset + 0.2 * np.sin(0.9 * u + 0.3 * v) + 0.2 * np.cos(0.2 * u - 0.7 * v))
    return torch.from_numpy(np.stack(frames))[None, :, None]


def backward_flow(velocity: tuple[float, float], count: int) -> torch.Tensor:
    """Where each pixel was one step before: [1, count, 2, H, W]."""
    return uniform(-velocity[0], -velocity[1], count)[None]


# warp


def test_warp_equals_the_pixel_oracle_with_a_field_that_leaves_the_picture() -> None:
    rng = np.random.default_rng(0)
    pictures, field = rng.random((2, 3, 7, 9)), rng.uniform(-4, 4, (2, 2, 7, 9))
    result = warp(torch.from_numpy(pictures), torch.from_numpy(field)).numpy()
    for index in np.ndindex(2, 3):
        np.testing.assert_allclose(result[index], oracle.warp(pictures[index], field[index[0]]), rtol=0, atol=1e-12)


def test_autocast_leaves_coordinates_exact() -> None:
    picture = torch.rand(1, 1, 4, 300)
    with torch.autocast("cpu", torch.bfloat16):
        result = warp(picture, uniform(1, 0, height=4, width=300).float())
    torch.testing.assert_close(result[..., :-1], picture[..., 1:], rtol=0, atol=1e-4)


def test_warp_refuses_other_shapes() -> None:
    with pytest.raises(UsageError, match=r"give \[1, 2, 4, 5\]"):
        warp(torch.zeros(1, 1, 4, 5), torch.zeros(1, 2, 5, 4))


# temporal consistency


@pytest.mark.parametrize("velocity", [(2, 0), (-2, 0), (0, 2), (0, -2), (1, -2)])
@pytest.mark.parametrize("as_published", [False, True])
def test_the_sign_is_right_for_motion_both_ways(velocity: tuple[int, int], as_published: bool) -> None:
    """The picture is a blob on black, so that its edge does not matter in the published form."""
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH]
    frames = [
        np.clip(1 - ((x - 12 - velocity[0] * t) ** 2 + (y - 10 - velocity[1] * t) ** 2) / 9, 0, 1) for t in range(3)
    ]
    target = torch.from_numpy(np.stack(frames))[None, :, None]
    loss = TemporalConsistency(first_step=1, as_published=as_published)
    right = backward_flow(velocity, 2) * (-1 if as_published else 1)
    assert loss(target, target, right).item() < 1e-9
    assert loss(target, target, -right).item() > 1e-4
    assert loss(target, target, torch.zeros_like(right)).item() > 1e-4


@pytest.mark.parametrize("as_published", [False, True])
@pytest.mark.parametrize("rule", ["half", "full"])
def test_equals_the_numpy_loop_over_steps(as_published: bool, rule: str) -> None:
    rng = np.random.default_rng(3)
    batch, steps, first = 2, 5, 3
    prediction = rng.normal(0.4, 0.4, (batch, steps, 1, 7, 8))
    target = rng.random((batch, steps, 1, 7, 8)) * 0.3
    flow = rng.uniform(-2, 2, (batch, steps - first, 2, 7, 8))
    per_step = np.zeros((batch, steps))
    for b in range(batch):
        for t in range(first, steps):
            pair = slice(t - 1, t + 1)
            per_step[b, t] = oracle.temporal_step(
                tuple(prediction[b, pair, 0]),
                tuple(target[b, pair, 0]),
                flow[b, t - first] * (-1 if as_published else 1),
                as_published=as_published,
            )
    expected = per_step.mean() if rule == "half" else per_step[:, first:].mean()
    assert expected > 0.01
    arrays = [torch.from_numpy(array) for array in (prediction, target, flow)]
    loss = TemporalConsistency(first_step=first, rule=rule, as_published=as_published)  # type: ignore[arg-type]
    assert loss(*arrays).item() == pytest.approx(expected, rel=1e-12)
    assert loss(*(array.float() for array in arrays)).item() == pytest.approx(expected, rel=1e-4)


def test_half_rule_of_the_paper_is_half_of_the_full_one() -> None:
    target = moving((1, 0), 40)
    prediction = target + 0.1 * torch.rand_like(target)
    half, full = (
        TemporalConsistency(rule=rule)(prediction, target, backward_flow((1, 0), 20)) for rule in ("half", "full")
    )
    assert half.item() == pytest.approx(full.item() / 2, rel=1e-12)


def test_gradients_are_finite_and_reach_both_pictures_of_a_pair_and_no_other() -> None:
    target = moving((1, 0), 4)
    prediction = target + 0.1 * torch.rand_like(target)
    prediction[..., :5] = 0  # black in both pictures: there the loss has a corner
    prediction.requires_grad_()
    TemporalConsistency(first_step=3)(prediction, target, backward_flow((1, 0), 1)).backward()
    assert prediction.grad is not None
    assert prediction.grad.isfinite().all()
    reached = prediction.grad.abs().sum(dim=(0, 2, 3, 4)) > 0
    assert reached.tolist() == [False, False, True, True]


def test_temporal_loss_is_float32_under_autocast() -> None:
    target = moving((1, 0), 3).float()
    with torch.autocast("cpu", torch.bfloat16):
        loss = TemporalConsistency(first_step=1)(target.bfloat16(), target, backward_flow((1, 0), 2).half())
    assert loss.dtype == torch.float32


@pytest.mark.parametrize(
    ("prediction", "flow", "message"),
    [
        ((1, 3, 1, 4, 5), (1, 3, 2, 4, 5), r"give \[1, 2, 2, 4, 5\]"),
        ((1, 1, 1, 4, 5), (1, 0, 2, 4, 5), "no step is left"),
        ((3, 1, 4, 5), (1, 2, 2, 4, 5), "both"),
    ],
)
def test_temporal_refuses_other_shapes(prediction: tuple[int, ...], flow: tuple[int, ...], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        TemporalConsistency(first_step=1)(torch.zeros(prediction), torch.zeros(prediction), torch.zeros(flow))


@pytest.mark.parametrize(
    ("settings", "message"), [({"first_step": 0}, "first_step = 0"), ({"rule": "quarter"}, "half or full")]
)
def test_temporal_refuses_other_settings(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        TemporalConsistency(**settings)


# L1 and the sum


def test_l1_is_the_mean_absolute_difference() -> None:
    rng = np.random.default_rng(0)
    first, second = rng.random((2, 3, 1, 5, 4)), rng.random((2, 3, 1, 5, 4))
    result = l1_loss(torch.from_numpy(first), torch.from_numpy(second))
    assert result.item() == pytest.approx(np.abs(first - second).mean(), rel=1e-14)
    assert l1_loss(torch.from_numpy(first).bfloat16(), torch.from_numpy(second).float()).dtype == torch.float32
    with pytest.raises(UsageError, match="equal shapes"):
        l1_loss(torch.zeros(2, 3), torch.zeros(2, 1))


def test_the_sum_is_weighted_and_its_terms_are_reported() -> None:
    torch.manual_seed(0)
    metric = LPIPS("squeeze").double()
    for layer in range(7):
        metric.get_buffer(f"head{layer}").fill_(1.0)
    temporal = TemporalConsistency(first_step=1)
    target = moving((1, 0), 3)
    prediction = (target + 0.1 * torch.rand_like(target)).requires_grad_()
    flow = backward_flow((1, 0), 2)
    loss = ReconstructionLoss(lpips=metric, temporal=temporal, lpips_weight=2, l1_weight=3, temporal_weight=5)
    terms = loss(prediction, target, flow)
    assert set(terms) == {"lpips", "l1", "temporal", "total"}
    assert terms["lpips"].item() == pytest.approx(2 * metric(prediction, target).mean().item())
    assert terms["l1"].item() == pytest.approx(3 * l1_loss(prediction, target).item())
    assert terms["temporal"].item() == pytest.approx(5 * temporal(prediction, target, flow).item())
    parts = terms["lpips"] + terms["l1"] + terms["temporal"]
    assert terms["total"].item() == pytest.approx(parts.item())
    assert [name for name, term in terms.items() if term.requires_grad] == ["total"]
    terms["total"].backward()
    assert prediction.grad is not None


def test_terms_without_weight_are_absent() -> None:
    terms = ReconstructionLoss()(torch.zeros(1, 2, 1, 4, 4), torch.ones(1, 2, 1, 4, 4))
    assert {name: term.item() for name, term in terms.items()} == {"l1": 1, "total": 1}


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"l1_weight": 0}, "at least one above 0"),
        ({"lpips_weight": 1}, "LPIPS weight files"),
        ({"temporal_weight": 1}, "temporal_weight = 1"),
        ({"temporal_weight": 1, "temporal": TemporalConsistency(first_step=1)}, "needs the flow"),
    ],
)
def test_incomplete_sums_are_refused(parts: dict[str, Any], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        ReconstructionLoss(**parts)(torch.zeros(1, 2, 1, 4, 4), torch.zeros(1, 2, 1, 4, 4))
