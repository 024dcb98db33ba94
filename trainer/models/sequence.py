"""Define the base class of the networks: voxel sequences in, pictures or flow out, with explicit memory."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, ClassVar, Literal, NamedTuple, get_args

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from trainer.models.blocks import Loop
from v2v_protocol.errors import UsageError

Padding = Literal["bottom-right", "centred", "top-left"]
Settings = Mapping[str, str | int | float | bool | None]


class Guide(NamedTuple):
    """Hold true pictures that training mixes into a network's own last picture (HyperE2VID's curriculum).

    Attributes:
        pictures: [B, T, 1, H, W] in 0 .. 1; entry t is used at step t.
        share: their share in the mixture, 0 .. 1; the rest is the network's own picture.
    """

    pictures: Tensor
    share: float


def normalize_voxels(voxels: Tensor) -> Tensor:
    """Shift and scale the non-zero values of each voxel grid to mean 0 and (population) standard deviation 1.

    Zeros stay zeros. The deviation is taken as at least 1e-6, so the result is finite even for grids without events or
    with a single value. E2VID (Rebecq et al. 2019) and FireNet (Scheerlinck et al. 2020) were trained with this rule;
    V2V and the "+" networks take the unscaled counts. This function does not synchronise with the device.

    Args:
        voxels: [N, bins, H, W], floating point.
    """
    occupied = voxels != 0
    count = occupied.sum(dim=(1, 2, 3), keepdim=True).clamp_min(1)
    mean = voxels.sum(dim=(1, 2, 3), keepdim=True) / count
    centred = torch.where(occupied, voxels - mean, 0.0)
    deviation = (centred.square().sum(dim=(1, 2, 3), keepdim=True) / count).sqrt()
    return centred / deviation.clamp_min(1e-6)


class VoxelNetwork(nn.Module):
    """Map sequences of voxel grids to sequences of pictures or flow. Subclasses implement :meth:`unroll`.

    The memory is a value: it is passed in as ``state`` and returned, and the module keeps no state between calls. None
    is the state after a reset (zeros). Calls on consecutive parts of a sequence, each with the state returned by the
    previous call, give the same result as one call on the whole.

    ``forward`` takes the whole sequence, so that wrappers of it (DistributedDataParallel) see one call per training
    step. Memory of the activations is proportional to T: evaluate long recordings in short parts.

    A subclass sets these class attributes:
        task: name of its task in :data:`trainer.tasks.TASKS`.
        signature: names of tensors that identify its weight files; one of them is enough.
        lead_voxels: number of voxel grids after a reset before the first that has an output.
        computed: tensors of the state dict that a file may lack, because the network computes them.

    Attributes:
        bins: bins of a voxel grid.
        size_multiple: height and width are padded with zeros to a multiple of this, in px.
        padding: position of the padding: bottom and right (V2V), all sides (E2VID and its successors; the odd pixel
            goes to the top and the left), or top and left (E-RAFT). Near the border the outputs depend on it.
        normalizes: whether every voxel grid is passed through :func:`normalize_voxels` first.

    Raises:
        UsageError: ``padding`` is unknown.
    """

    task: ClassVar[str] = "reconstruction"
    signature: ClassVar[tuple[str, ...]] = ()
    lead_voxels: ClassVar[int] = 0
    computed: ClassVar[tuple[str, ...]] = ()

    def __init__(
        self, *, bins: int, size_multiple: int, normalizes: bool = False, padding: Padding = "bottom-right"
    ) -> None:
        super().__init__()
        if padding not in get_args(Padding):
            raise UsageError(f"{type(self).__name__} padding = {padding!r}: give one of {', '.join(get_args(Padding))}")
        self.bins = bins
        self.size_multiple = size_multiple
        self.normalizes = normalizes
        self.padding = padding

    @classmethod
    def recognises(cls, names: Iterable[str]) -> bool:
        """Return whether tensors of these names (see :meth:`own_name`) belong to this network."""
        return not set(cls.signature).isdisjoint(names)

    @classmethod
    def own_name(cls, name: str) -> str:
        """Return this implementation's name of a tensor that a published file calls ``name``."""
        return name

    @classmethod
    def own_tensor(cls, _name: str, tensor: Tensor) -> Tensor:
        """Return the part of a published tensor [...] that this network uses. ``_name`` is its name here."""
        return tensor

    @classmethod
    def from_state(cls, state: Mapping[str, Tensor], settings: Settings) -> dict[str, Any]:
        """Return the constructor arguments that match a file's weights.

        Args:
            state: the file's tensors, under the names of this implementation.
            settings: plain settings stored with them, see :class:`trainer.weights.WeightFile`.

        Raises:
            UsageError: the weights belong to a variant that is not implemented.
        """
        raise NotImplementedError

    def unroll(self, x: Tensor, state: Any, steps: int, guide: Guide | None) -> tuple[Tensor, Any]:
        """Run the network over a part of a sequence.

        Args:
            x: voxel grids [T*B, bins, H, W], time-major, H and W multiples of ``size_multiple``.
            state: memory before the first step; None after a reset.
            steps: T.
            guide: with pictures [T*B, 1, H, W]; most networks ignore it.

        Returns:
            Outputs [T*B, C, H, W], or [(T - lead_voxels)*B, C, H, W] after a reset, and the memory after the last step.
            Networks that refine an estimate may add leading dimensions, with the final estimate last.
        """
        raise NotImplementedError

    def forward(self, voxels: Tensor, state: Any = None, guide: Guide | None = None) -> tuple[Tensor, Any]:
        """Compute the outputs for a part of a sequence.

        Args:
            voxels: [B, T, bins, H, W], any dtype (the stream's int8 counts are converted here, on the device), not
                normalised.
            state: the state returned for the previous part, or None at the start of a sequence.
            guide: in training, true pictures to mix in.

        Returns:
            Pictures [B, T, 1, H, W], nominally in [0, 1] but not clamped, or flow [B, T, 2, H, W] (x, y) in px, in the
            dtype of the weights (also under autocast); and the state after the last step. After a reset the first
            ``lead_voxels`` grids have no output. In training, a network that refines its estimate returns all
            estimates: [updates, B, T, 2, H, W].

        Raises:
            UsageError: the voxels have another shape.
        """
        lead = self.lead_voxels if state is None else 0
        if voxels.ndim != 5 or voxels.shape[2] != self.bins or 0 in voxels.shape or voxels.shape[1] <= lead:
            raise UsageError(
                f"voxels of shape {list(voxels.shape)}: this network takes [B, T, {self.bins}, H, W], all above 0"
                + (f", T above {lead}" if lead else "")
            )
        batch, steps, _, height, width = voxels.shape
        edges = left, _, top, _ = self._edges(height, width)
        dtype = next(self.parameters()).dtype
        x = F.pad(voxels.transpose(0, 1).flatten(0, 1), edges).to(dtype)
        if self.normalizes:
            x = normalize_voxels(x)
        if guide is not None:
            guide = Guide(F.pad(guide.pictures.transpose(0, 1).flatten(0, 1), edges).to(dtype), guide.share)
        outputs, state = self.unroll(x, state, steps, guide)
        outputs = outputs[..., top : top + height, left : left + width]
        return torch.unflatten(outputs, -4, (steps - lead, batch)).transpose(-5, -4), state

    def compile_turns(self) -> None:
        """Compile one iteration of each loop, for training: see :class:`trainer.models.blocks.Loop`.

        Raises:
            UsageError: the network has no loop.
        """
        loops = [module for module in self.modules() if isinstance(module, Loop)]
        if not loops:
            raise UsageError(f"{type(self).__name__} has no loop over time of which one step could be compiled")
        torch._dynamo.config.recompile_limit = 64  # layers of a class share their code but differ in shape
        for loop in loops:
            loop.compile_turn()

    def _edges(self, height: int, width: int) -> tuple[int, int, int, int]:
        """Return the pixels to add: left, right, top, bottom."""
        right, below = -width % self.size_multiple, -height % self.size_multiple
        if self.padding == "bottom-right":
            return 0, right, 0, below
        if self.padding == "top-left":
            return right, 0, below, 0
        return right - right // 2, right // 2, below - below // 2, below // 2

    def forward_sequence(self, voxels: Tensor) -> Tensor:
        """Return the outputs for whole sequences, after a reset: [B, T, bins, H, W] -> [B, T, C, H, W]."""
        outputs: Tensor = self(voxels)[0]
        return outputs


def predict(layer: nn.Module, x: Tensor) -> Tensor:
    """Apply the last, 1x1 convolution to features [N, C, H, W].

    It runs outside autocast: a bfloat16 picture would have steps of 1/256 near white.
    """
    with torch.autocast(x.device.type, enabled=False):
        picture: Tensor = layer(x.to(next(layer.parameters()).dtype))
        return picture
