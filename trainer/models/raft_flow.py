"""Estimate optical flow in the trainer, with RAFT and without gradients.

Frames are [N, 1, H, W] in 0 .. 1, flow is [N, 2, H, W] (x, y) in px. Forward flow lies on the first picture's grid:
second(x + flow(x)) = first(x). ``trainer.losses.warp`` takes the flow from the later picture to the earlier one.
"""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor
from torch.nn import functional

from trainer.models.raft import DOWNSCALE, RAFT, SMALLEST_SIDE_PX, torchvision_name
from trainer.weights import read_tensors
from v2v_protocol.errors import UsageError

WHERE_TO_GET_WEIGHTS = {
    "small": "https://download.pytorch.org/models/raft_small_C_T_V2-01064c6d.pth (torchvision, 4 MB), or "
    "models/raft-small.pth of https://github.com/princeton-vl/RAFT (download_models.sh)",
    "large": "https://download.pytorch.org/models/raft_large_C_T_SKHT_V2-ff5fadd5.pth (torchvision, 21 MB), or "
    "models/raft-sintel.pth of https://github.com/princeton-vl/RAFT (download_models.sh)",
}


class RaftFlow:
    """Estimate flow by RAFT, without gradients, for any number of pairs.

    Frames are mapped to -1 .. 1 and repeated to three channels. They are padded at the bottom and the right with 0,
    which is mid-grey, to multiples of 8 and at least 128 px. The flow is that after twelve updates.

    Args:
        size: "small" or "large".
        weights: file in torchvision's or the authors' layout. It is not downloaded automatically.
        device: device to compute on.
        bfloat16: run the convolutions in bfloat16; correlation, positions and flow stay float32.
        pairs_at_once: bounds memory: a pair takes about 1.33 * 4 * (H W / 64)^2 bytes for the correlation (350 kB at
            128 x 128), and about 10 kB per pixel in the encoders of the large network. With many small batches a GPU
            waits for the processor: 64 pairs at a time launch four times as many kernels as 240.

    Raises:
        UsageError: the size is unknown, or the file is missing, unreadable or of another network.
    """

    def __init__(
        self,
        size: str,
        weights: str | Path,
        device: torch.device | str = "cpu",
        *,
        bfloat16: bool = False,
        pairs_at_once: int = 480,
    ) -> None:
        if size not in WHERE_TO_GET_WEIGHTS:
            raise UsageError(f"RAFT size {size!r}: choose one of {', '.join(WHERE_TO_GET_WEIGHTS)}")
        if pairs_at_once < 1:
            raise UsageError(f"RAFT pairs at once = {pairs_at_once}: give at least 1")
        network = RAFT(size)
        bottleneck = network.size.bottleneck
        found = _read_weights(Path(weights), size).items()
        state = {torchvision_name(name, bottleneck=bottleneck): tensor for name, tensor in found}
        _check_fit(state, network, Path(weights), size)
        network.load_state_dict(state, strict=True)
        self._network = network.to(device).eval().requires_grad_(False)
        self._device = torch.device(device)
        self._bfloat16 = bfloat16
        self._pairs_at_once = pairs_at_once

    @torch.no_grad()
    def __call__(self, first: Tensor, second: Tensor) -> Tensor:
        """Estimate the flow from each first picture to its second.

        Args:
            first, second: [N, 1, H, W], float in 0 .. 1 or uint8.

        Returns:
            [N, 2, H, W] float32 on the device, px.

        Raises:
            UsageError: the pictures have other shapes.
        """
        if first.shape != second.shape or first.ndim != 4 or first.shape[1] != 1:
            raise UsageError(f"RAFT takes two [N, 1, H, W]; got {list(first.shape)} and {list(second.shape)}")
        if not len(first):
            return torch.empty(0, 2, *first.shape[2:], device=self._device)
        chunks = [slice(start, start + self._pairs_at_once) for start in range(0, len(first), self._pairs_at_once)]
        return torch.cat([self._estimate(first[chunk], second[chunk]) for chunk in chunks])

    def _estimate(self, first: Tensor, second: Tensor) -> Tensor:
        height, width = first.shape[2:]
        with torch.autocast(self._device.type, torch.bfloat16, enabled=self._bfloat16):
            flow: Tensor = self._network(self._prepare(first), self._prepare(second))
        return flow[:, :, :height, :width]

    def _prepare(self, frames: Tensor) -> Tensor:
        frames = frames.to(self._device)
        scaled = frames.float() / 255.0 if frames.dtype == torch.uint8 else frames.float()
        height, width = frames.shape[2:]
        below, right = (max(SMALLEST_SIDE_PX, -(-side // DOWNSCALE) * DOWNSCALE) - side for side in (height, width))
        return functional.pad(2.0 * scaled - 1.0, (0, right, 0, below)).expand(-1, 3, -1, -1)


def _read_weights(path: Path, size: str) -> dict[str, Tensor]:
    try:
        return read_tensors(path)
    except UsageError as error:
        raise UsageError(f"RAFT weights: {error}. Get them from {WHERE_TO_GET_WEIGHTS[size]}") from error


def _check_fit(state: dict[str, Tensor], network: RAFT, path: Path, size: str) -> None:
    wanted = {name: tuple(value.shape) for name, value in network.state_dict().items()}
    given = {name: tuple(value.shape) for name, value in state.items()}
    wrong = sorted(name for name in wanted.keys() | given.keys() if wanted.get(name) != given.get(name))
    if wrong:
        name = wrong[0]
        raise UsageError(
            f"RAFT weights {path} do not fit the {size} network: {len(wrong)} of {len(wanted)} entries differ, "
            f"first {name} (shape {given.get(name, 'missing')}, expected {wanted.get(name, 'none')}). "
            f"Get them from {WHERE_TO_GET_WEIGHTS[size]}"
        )
