"""Several voxel grids in a step: the network sees them all, and losses compare it at the frames."""

from __future__ import annotations

import pytest
import torch

from trainer.config import TrainConfig
from trainer.models.firenet import FireNet
from trainer.tasks.reconstruction import Reconstruction, ReconstructionSettings
from trainer.tasks.task import Work
from v2v_protocol.errors import UsageError

CPU = torch.device("cpu")


def test_losses_and_films_take_the_grid_that_ends_at_each_frame() -> None:
    task = Reconstruction(ReconstructionSettings(lpips_weight=0.0, temporal_weight=0.0), None, CPU, bfloat16=False)
    voxels = torch.randint(-3, 4, (2, 6, 5, 16, 16), dtype=torch.int8)
    frames = torch.rand(2, 3, 1, 16, 16)
    prediction = torch.rand(2, 6, 1, 16, 16)
    work = Work(voxels=voxels, truth={"frames": frames})
    total = task.losses(prediction, work)["total"]
    torch.testing.assert_close(total, (prediction[:, 1::2] - frames).abs().mean())
    torch.testing.assert_close(task.losses(frames, work)["total"], torch.tensor(0.0))
    film = task.film(voxels, prediction, work, 1)
    alone = Work(voxels=voxels[:, 1::2], truth=work.truth)
    assert (film == task.film(alone.voxels, prediction[:, 1::2], alone, 1)).all()
    assert FireNet(bins=5)(voxels)[0].shape == (2, 6, 1, 16, 16)


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"network": {"name": "evflownet"}}, "grids_per_frame = 2: a flow network"),
        ({"network": {"name": "hypere2vid"}, "loss": {"guide_epochs": 3, "temporal_weight": 0.0}}, "guide_epochs = 3"),
    ],
)
def test_what_needs_a_frame_for_every_grid_is_refused(config: dict[str, object], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        TrainConfig.from_dict(config | {"stream": {"recipe": {"grids_per_frame": 2}}})
