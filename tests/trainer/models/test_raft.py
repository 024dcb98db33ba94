"""Compare RAFT with recordings of torchvision's (``record_raft.py``), and test both layouts of its weights."""

from __future__ import annotations

import os
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.trainer.models.raft_pairs import HEIGHT, SAMPLED, WIDTH, formula_weights, pictures
from trainer.losses.warp import warp
from trainer.models.raft import RAFT, RAFT_SIZES
from trainer.models.raft_flow import RaftFlow
from v2v_protocol.errors import UsageError

RECORDED = np.load(Path(__file__).with_name("raft_torchvision.npz"))
PUBLISHED = (
    Path(os.environ.get("V2V_TEST_WEIGHTS", Path(__file__).parents[4] / "shared" / "data" / "weights"))
    / "raft-small_princeton.pth"
)

_TO_AUTHORS = (
    (r"^feature_encoder\.", "fnet."),
    (r"^context_encoder\.", "cnet."),
    (r"^(.net)\.convnormrelu\.0\.", r"\1.conv1."),
    (r"^(.net)\.convnormrelu\.1\.", r"\1.norm1."),
    (r"^(.net)\.conv\.", r"\1.conv2."),
    (r"\.convnormrelu(\d)\.0\.", r".conv\1."),
    (r"\.convnormrelu(\d)\.1\.", r".norm\1."),
    (r"motion_encoder\.convcorr(\d)\.0\.", r"encoder.convc\1."),
    (r"motion_encoder\.convflow(\d)\.0\.", r"encoder.convf\1."),
    (r"motion_encoder\.conv\.0\.", "encoder.conv."),
    (r"^mask_predictor\.convrelu\.0\.", "update_block.mask.0."),
    (r"^mask_predictor\.conv\.", "update_block.mask.2."),
)


def in_the_authors_layout(state: dict[str, Tensor], size: str) -> dict[str, Tensor]:
    """Rename a state dict as princeton-vl/RAFT saves it, from DataParallel, with the norm of each shortcut twice."""
    renamed = {}
    for name, value in state.items():
        for pattern, replacement in _TO_AUTHORS:
            name = re.sub(pattern, replacement, name)
        gates = r"recurrent_block\.convgru(\d)\.conv([zrq])"
        name = re.sub(gates, r"gru.conv\2" if size == "small" else r"gru.conv\2\1", name)
        if ".downsample.1." in name:
            renamed["module." + name.replace("downsample.1", "norm3")] = value
        renamed["module." + name] = value
    return renamed


def saved(folder: Path, size: str) -> Path:
    path = folder / f"{size}.pth"
    torch.save(formula_weights(RAFT(size).state_dict()), path)
    return path


@pytest.mark.parametrize("size", sorted(RAFT_SIZES))
def test_agrees_with_torchvision_in_both_layouts(size: str, tmp_path: Path) -> None:
    estimate = RaftFlow(size, saved(tmp_path, size))
    state = estimate._network.state_dict()
    torch.save(in_the_authors_layout(state, size), tmp_path / "authors.pth")
    authors = RaftFlow(size, tmp_path / "authors.pth")._network.state_dict()
    assert all(torch.equal(authors[name], tensor) for name, tensor in state.items())
    flow = estimate(*pictures())
    assert flow.shape == (2, 2, HEIGHT, WIDTH)
    recorded = RECORDED[f"{size}_formula"]
    assert np.abs(recorded).max() > 1.0  # there is something to agree on
    np.testing.assert_allclose(flow[SAMPLED].numpy(), recorded, atol=1e-3, rtol=0)


@pytest.mark.skipif(not PUBLISHED.is_file(), reason=f"no {PUBLISHED}; set V2V_TEST_WEIGHTS")
def test_published_weights_agree_with_torchvision_and_find_the_motion() -> None:
    flow = RaftFlow("small", PUBLISHED)(*pictures())
    np.testing.assert_allclose(flow[SAMPLED].numpy(), RECORDED["small_published"], atol=1e-3, rtol=0)
    error = (flow[0] - torch.tensor([6.0, -4.0])[:, None, None]).norm(dim=0)
    assert error[16:-16, 16:-16].median() < 0.25


def test_chunking_and_dtype_do_not_change_the_flow(tmp_path: Path) -> None:
    path = saved(tmp_path, "small")
    first, second = pictures()
    whole = RaftFlow("small", path)(first, second)
    np.testing.assert_allclose(RaftFlow("small", path, pairs_at_once=1)(first, second), whole, atol=1e-3)
    grey = [(255 * frames[:1]).round().to(torch.uint8) for frames in (first, second)]
    np.testing.assert_allclose(RaftFlow("small", path)(*grey), whole[:1], atol=1e-3)
    assert not whole.requires_grad
    assert RaftFlow("small", path)(first[:0], second[:0]).shape == (0, 2, HEIGHT, WIDTH)


def test_small_pictures_are_padded_to_what_the_pyramid_needs(tmp_path: Path) -> None:
    first, second = (frames[:, :, :20, :90] for frames in pictures())
    flow = RaftFlow("small", saved(tmp_path, "small"))(first, second)
    assert flow.shape == (2, 2, 20, 90)
    padded = [torch.full((2, 1, 128, 128), 0.5) for _ in range(2)]  # mid-grey is 0 in -1 .. 1
    for whole, part in zip(padded, (first, second), strict=True):
        whole[:, :, :20, :90] = part
    np.testing.assert_allclose(flow, RaftFlow("small", tmp_path / "small.pth")(*padded)[:, :, :20, :90], atol=1e-5)


@pytest.mark.skipif(not PUBLISHED.is_file(), reason=f"no {PUBLISHED}; set V2V_TEST_WEIGHTS")
@pytest.mark.slow
def test_bfloat16_stays_near() -> None:
    """It uses weights that estimate flow, because those of the formula amplify every rounding."""
    exact = RaftFlow("small", PUBLISHED)(*pictures())
    near = RaftFlow("small", PUBLISHED, bfloat16=True)(*pictures())
    assert near.dtype == torch.float32
    assert 0 < (near[0] - exact[0]).norm(dim=0).median() < 0.1


@pytest.mark.parametrize(
    ("size", "content", "message"),
    [
        ("small", None, r"no file .*a\.pth.*download\.pytorch\.org.*raft_small"),
        ("large", {}, r"do not fit the large network: \d+ of \d+ entries differ"),
        ("small", {"more": torch.zeros(1)}, r"1 of \d+ entries differ, first more"),
        ("small", [1], r"state dict.*raft_small"),
        ("medium", None, "'medium'"),
    ],
)
def test_unsuitable_weights_are_refused_with_a_source(tmp_path: Path, size: str, content: object, message: str) -> None:
    """A dict is added to the entries of the small network."""
    if isinstance(content, dict):
        content = formula_weights(RAFT("small").state_dict()) | content
    if content is not None:
        torch.save(content, tmp_path / "a.pth")
    with pytest.raises(UsageError, match=message):
        RaftFlow(size, tmp_path / "a.pth")


def test_unsuitable_pictures_and_pieces_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="pairs at once = 0"):
        RaftFlow("small", saved(tmp_path, "small"), pairs_at_once=0)
    with pytest.raises(UsageError, match=r"\[2, 3, 8, 8\]"):
        RaftFlow("small", tmp_path / "small.pth")(torch.zeros(2, 3, 8, 8), torch.zeros(2, 3, 8, 8))


@pytest.mark.skipif(not PUBLISHED.is_file(), reason=f"no {PUBLISHED}; set V2V_TEST_WEIGHTS")
def test_flow_from_the_later_picture_brings_the_earlier_one_onto_it() -> None:
    first, second = (frames[:1] for frames in pictures())
    backward = RaftFlow("small", PUBLISHED)(second, first)
    inner = np.s_[..., 16:-16, 16:-16]
    assert (warp(first, backward) - second)[inner].abs().mean() < 0.3 * (first - second)[inner].abs().mean()
