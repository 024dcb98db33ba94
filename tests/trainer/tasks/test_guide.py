"""HyperE2VID's curriculum: how much of which true picture the network is shown, and what it does with it."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch

from tests.client.fake_server import FakeServer
from trainer.models import HyperE2VID
from trainer.models.hypere2vid import HyperState
from trainer.models.sequence import Guide
from trainer.tasks.reconstruction import Reconstruction, ReconstructionSettings
from v2v_client import Batch, V2VStreamDataset

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def batch() -> Iterator[Batch]:
    recipe = {"voxels_per_clip": 4, "bins": 2, "crop_height_px": 16, "crop_width_px": 20}
    with FakeServer() as server:
        yield next(iter(V2VStreamDataset(server.address, batch_size=2, arrays=("voxels", "frames"), recipe=recipe)))


@pytest.mark.parametrize(("epoch", "share"), [(0, 1.0), (4, 0.75), (15, 1 / 16), (16, None), (80, None), (None, None)])
def test_the_guides_share_falls_from_1_to_0_in_training_only(
    batch: Batch, epoch: int | None, share: float | None
) -> None:
    task = Reconstruction(ReconstructionSettings(guide_epochs=16), None, CPU, bfloat16=False)
    guide = task.prepare(batch, epoch).guide
    assert (None if guide is None else guide.share) == share


@pytest.mark.parametrize("as_published", [False, True])
def test_the_target_itself_is_shown_only_as_published(batch: Batch, as_published: bool) -> None:
    settings = ReconstructionSettings(guide_epochs=16, guide_as_published=as_published)
    work = Reconstruction(settings, None, CPU, bfloat16=False).prepare(batch, 0)
    frames = work.truth["frames"]
    assert frames.shape == (2, 4, 1, 16, 20)
    assert work.guide is not None
    if as_published:
        assert torch.equal(work.guide.pictures, frames)
    else:
        assert torch.equal(work.guide.pictures[:, 1:], frames[:, :-1])
        assert not work.guide.pictures[:, 0].any(), "as after a reset"


@pytest.mark.parametrize("share", [0.25, 1.0])
def test_the_network_sees_the_mixture_in_place_of_its_own_last_picture(share: float) -> None:
    """Step by step, with the mixture put into its memory; sides that need no padding."""
    torch.manual_seed(0)
    network = HyperE2VID(base_channels=2).eval()
    voxels, pictures = torch.randint(-3, 4, (2, 3, 5, 16, 32)).float(), torch.rand(2, 3, 1, 16, 32)
    state = HyperState((None,) * 3, torch.zeros(2, 1, 16, 32))  # type: ignore[arg-type]
    with torch.no_grad():
        found, _ = network(voxels, None, Guide(pictures, share))
        for step in range(3):
            mixed = (1 - share) * state.picture + share * pictures[:, step]
            expected, state = network(voxels[:, step : step + 1], state._replace(picture=mixed))
            torch.testing.assert_close(found[:, step], expected[:, 0], rtol=0, atol=1e-6)
        unguided, _ = network(voxels)
    assert (found - unguided).abs().max() > 1e-4


def test_pieces_of_a_batch_are_shown_their_own_pictures(batch: Batch) -> None:
    work = Reconstruction(ReconstructionSettings(guide_epochs=16), None, CPU, bfloat16=False).prepare(batch, 0)
    assert work.guide is not None
    for number, piece in enumerate(work.pieces(2)):
        assert piece.guide is not None
        torch.testing.assert_close(piece.guide.pictures, work.guide.pictures[number : number + 1])
