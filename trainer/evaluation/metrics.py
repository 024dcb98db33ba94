"""Compute distances between a reconstruction and the picture of the sensor. A metric is one entry of METRICS.

| name | definition |
|---|---|
| ``mse`` | mean squared difference, grey values in 0 .. 1 |
| ``ssim_range2`` | SSIM as the paper computes it: 7x7 uniform window, sample covariance, data range 2 |
| ``ssim`` | the same with data range 1, which is the range of the values; gives lower values |
| ``correlation`` | Pearson's: 1 if only brightness and contrast differ, 0 for a blank picture |
| ``lpips_alex``, ``lpips_squeeze``, ``lpips_vgg`` | LPIPS v0.1 |

Reconstructions are clamped to 0 .. 1 first, but not rounded to 8 bits. The paper's tables hold ``mse``, ``ssim_range2``
and ``lpips_alex``.

SSIM (Wang et al. 2004), as ``skimage.metrics.structural_similarity`` defines it, with means mu, (co)variances s of the
sample kind (N - 1) over each window that lies wholly in the picture, and C1 = (0.01 R)^2, C2 = (0.03 R)^2 for range R:

    mean of  (2 mu_a mu_b + C1) (2 s_ab + C2) / ((mu_a^2 + mu_b^2 + C1) (s_aa + s_bb + C2))
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from skimage.metrics import structural_similarity

from trainer.losses.backbones import BACKBONES
from trainer.losses.lpips import LPIPS
from v2v_protocol.errors import UsageError

GreyImage = npt.NDArray[np.float64]
"""[H, W]."""
Metric = Callable[[GreyImage, GreyImage], float]

LpipsFiles = Mapping[str, tuple[str | Path, str | Path]]
"""Files of backbone and heads by network."""
SSIM_WINDOW_PX = 7


class MetricEntry(NamedTuple):
    """A metric that can be asked for.

    Attributes:
        title: of its column in tables.
        make: build it from the files of LPIPS and the PyTorch device.
    """

    title: str
    make: Callable[[LpipsFiles, str], Metric]


def mse(prediction: GreyImage, target: GreyImage) -> float:
    """Return the mean squared difference."""
    return float(np.mean((prediction - target) ** 2))


def correlation(prediction: GreyImage, target: GreyImage) -> float:
    """Return Pearson's correlation; 0 if either picture is blank."""
    ours, truth = prediction - prediction.mean(), target - target.mean()
    scale = float(np.sqrt((ours**2).sum() * (truth**2).sum()))
    return float((ours * truth).sum()) / scale if scale > 1e-12 else 0.0


def ssim(prediction: GreyImage, target: GreyImage, *, data_range: float) -> float:
    """Return the SSIM that the module defines, for values that span ``data_range``.

    Raises:
        UsageError: the pictures are smaller than the window.
    """
    if min(target.shape) < SSIM_WINDOW_PX:
        raise UsageError(f"SSIM of a picture of {target.shape[0]} x {target.shape[1]}: give at least 7 x 7")
    similarity: float = structural_similarity(  # type: ignore[no-untyped-call]
        prediction, target, win_size=SSIM_WINDOW_PX, data_range=data_range
    )
    return float(similarity)


def lpips_metric(net: str, files: LpipsFiles, device: str = "cpu") -> Metric:
    """Create LPIPS with weights from files, see :meth:`trainer.losses.lpips.LPIPS.from_files`.

    Raises:
        UsageError: the network has no files.
    """
    if net not in files:
        raise UsageError(
            f"lpips_{net} needs weights that this project does not contain: give --lpips {net} BACKBONE HEADS "
            f"(backbone: {BACKBONES[net].weights_from}, heads: {net}.pth of LPIPS v0.1), or leave it out with --metrics"
        )
    network = LPIPS.from_files(net, *files[net]).to(device)

    def distance(prediction: GreyImage, target: GreyImage) -> float:
        pair = [torch.from_numpy(picture.astype(np.float32))[None].to(device) for picture in (prediction, target)]
        with torch.no_grad():
            return float(network(*pair))

    return distance


METRICS: dict[str, MetricEntry] = {
    "mse": MetricEntry("MSE", lambda *_: mse),
    "ssim_range2": MetricEntry("SSIM (range 2)", lambda *_: functools.partial(ssim, data_range=2.0)),
    "ssim": MetricEntry("SSIM", lambda *_: functools.partial(ssim, data_range=1.0)),
    "correlation": MetricEntry("correlation", lambda *_: correlation),
    **{f"lpips_{net}": MetricEntry(f"LPIPS {net}", functools.partial(lpips_metric, net)) for net in BACKBONES},
}
"""All metrics by name."""


def make_metrics(names: Sequence[str], lpips_files: LpipsFiles, device: str = "cpu") -> dict[str, Metric]:
    """Create metrics by name.

    Args:
        names: names in METRICS.
        lpips_files: files of backbone and heads by network ("alex", "squeeze", "vgg").
        device: PyTorch device for LPIPS.

    Raises:
        UsageError: a name is unknown, or LPIPS has no files.
    """
    for name in names:
        if name not in METRICS:
            raise UsageError(f"metric {name!r}: give some of {', '.join(METRICS)}")
    return {name: METRICS[name].make(lpips_files, device) for name in names}
