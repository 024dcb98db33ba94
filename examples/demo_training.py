"""Compare the demo's trained network with its first weights and the best grey picture, and draw its pictures."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from trainer.config_file import load_config
from trainer.models import NETWORKS, VoxelNetwork
from trainer.pictures import add_header, write_png
from trainer.run.checkpoint import LAST
from trainer.tasks import Reconstruction
from trainer.weights import load_into
from v2v_client import Batch, V2VStreamDataset

_SAMPLES = 16
_SEED = 1
_SIDE_PX = 128
_COLUMNS, _ROWS = 2, 5
_FIRST_SHOWN = 4
"""First step of a clip to draw. Earlier, little has moved, so the network cannot know the scene."""


def judge(address: str, configuration: str, run: Path, picture: Path) -> bool:
    """Compare the trained network with its first weights and a constant, on cameras that it was not trained on.

    The constant is the mean of the frames it is compared with, which a real predictor could not know. Both errors are
    mean absolute differences, the training loss.

    Args:
        address: the server's.
        configuration: the configuration of the run.
        run: folder of the run.
        picture: PNG to write, with voxels, targets and reconstructions.

    Returns:
        whether the network is better.
    """
    config = load_config(configuration)
    torch.set_num_threads(config.compute.threads)
    recipe = config.stream.resolved_recipe.replace(crop_height_px=_SIDE_PX, crop_width_px=_SIDE_PX)
    dataset = V2VStreamDataset(address, batch_size=2, recipe=recipe, seed=_SEED)
    batches: list[Batch] = []
    while len(batches) * 2 < _SAMPLES:
        batches += dataset
    target = torch.cat([batch.arrays["frames"] for batch in batches]) / 255.0
    voxels = torch.cat([batch.arrays["voxels"] for batch in batches])

    network = NETWORKS[config.network.name](bins=recipe.bins, **config.network.options)
    load_into(network, config.network.weights)
    before = _error(network, voxels, target)
    load_into(network, run / LAST, ema=True)
    loss = _error(network, voxels, target)
    constant = float((target.mean() - target).abs().mean())
    print(
        f"mean absolute error on {len(target)} new samples of {_SIDE_PX} x {_SIDE_PX}: {before:.4f} with the shipped "
        f"weights, {loss:.4f} after the training; constant-mean predictor: {constant:.4f} ({loss / constant:.0%} of it)"
    )
    task = Reconstruction(config.loss, network, torch.device("cpu"), bfloat16=False)
    shown = [film for batch in batches[:_COLUMNS] for film in task.judge(network, batch, _COLUMNS)[1]][:_COLUMNS]
    picks = np.linspace(_FIRST_SHOWN, len(shown[0]) - 1, _ROWS).round().astype(int)
    sheet = np.concatenate([np.concatenate(list(film[picks]), axis=0) for film in shown], axis=1)
    write_png(picture, add_header(sheet, task.panels * len(shown), "After a minute of training", time_runs_down=True))
    print(f"picture: {picture} (events, target, reconstruction; time runs down)")
    return loss < constant


def _error(network: VoxelNetwork, voxels: torch.Tensor, target: torch.Tensor) -> float:
    """Return the mean absolute error of the network's pictures."""
    with torch.no_grad():
        prediction = torch.cat([network.forward_sequence(piece) for piece in torch.split(voxels, 2)])
    return float((prediction - target).abs().mean())
