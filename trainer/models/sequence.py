"""What every network shares: voxel sequences in, pictures or flow out, memory handed in and out."""

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
    """True pictures that training mixes into what a network sees of its own past (HyperE2VID's curriculum).

    Attributes:
        pictures: [B, T, 1, H, W] in 0 .. 1; entry t is seen at step t.
        share: of them in the mixture, 0 .. 1; the rest is the network's own picture.
    """

    pictures: Tensor
    share: float


def normalize_voxels(voxels: Tensor) -> Tensor:
    """Shift and scale the non-zero values of each voxel grid to mean 0 and (population) standard deviation 1.

    Zeros stay zeros. A grid without events, or with one value only, becomes all zeros or stays finite (the deviation is
    taken as at least 1e-6). The rule under which E2VID (Rebecq et al. 2019) and FireNet (Scheerlinck et al. 2020) were
    trained; V2V and the "+" networks take the counts as they are. Nothing here waits for the device.

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
    """A network from sequences of voxel grids to sequences of pictures or flow. Subclasses give :meth:`unroll`.

    The memory is a value: it goes in as ``state`` and comes out again, and the module keeps nothing between calls. None
    is the state after a reset (zeros). Calls on pieces of a sequence, each given the state that the one before
    returned, equal one call on the whole.

    ``forward`` takes the whole sequence, so that wrappers which hook into it (DistributedDataParallel) see one call per
    training step. Memory of the activations is proportional to T: evaluate long recordings in short pieces.

    A subclass states, as class attributes:
        task: name in :data:`trainer.tasks.TASKS`: what it is trained for.
        signature: tensors by which a file of its weights is recognised; one of them is enough.
        lead_voxels: voxel grids in front of the first that has an output, after a reset.
        computed: tensors of the state dict that a file may lack, because the network makes them by itself.

    Attributes:
        bins: bins of a voxel grid.
        size_multiple: height and width are padded with zeros to a multiple of this.
        padding: where: at the bottom and the right (V2V), on all sides (E2VID and its successors; the odd pixel goes to
            the top and the left), or at the top and the left (E-RAFT). Near the border the outputs depend on it.
        normalizes: True puts every voxel grid through :func:`normalize_voxels` first.
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
        """Whether tensors of these names (ours, see :meth:`own_name`) are of this network."""
        return not set(cls.signature).isdisjoint(names)

    @classmethod
    def own_name(cls, name: str) -> str:
        """The name here of a tensor that a published file calls ``name``."""
        return name

    @classmethod
    def own_tensor(cls, _name: str, tensor: Tensor) -> Tensor:
        """What is used of a published tensor, under its own name."""
        return tensor

    @classmethod
    def from_state(cls, state: Mapping[str, Tensor], settings: Settings) -> dict[str, Any]:
        """The arguments under which a file's weights fit.

        Args:
            state: its tensors, under our names.
            settings: plain settings that the file holds beside them, see :class:`trainer.weights.WeightFile`.

        Raises:
            UsageError: a variant that is not built here.
        """
        raise NotImplementedError

    def unroll(self, x: Tensor, state: Any, steps: int, guide: Guide | None) -> tuple[Tensor, Any]:
        """
        Args:
            x: voxel grids [T*B, bins, H, W], time-major, H and W multiples of ``size_multiple``.
            state: memory before the first step.
            steps: T.
            guide: its pictures [T*B, 1, H, W]; most networks have no use for it.

        Returns:
            Outputs [T*B, C, H, W], or [T - lead_voxels ...] after a reset, and the memory after the last step. More
            dimensions may stand in front: estimates of which the last one counts.
        """
        raise NotImplementedError

    def forward(self, voxels: Tensor, state: Any = None, guide: Guide | None = None) -> tuple[Tensor, Any]:
        """Outputs for a piece of a sequence.

        Args:
            voxels: [B, T, bins, H, W], any dtype (int8 counts as they come from the stream are converted here, on the
                device); not normalised.
            state: what the call on the piece before returned, or None at the start of a sequence.
            guide: in training, true pictures to mix in.

        Returns:
            Pictures [B, T, 1, H, W], nominally in [0, 1] but not clamped, or flow [B, T, 2, H, W] (x, y) in px, in the
            dtype of the weights (also under autocast); and the state after the last step. After a reset the first
            ``lead_voxels`` grids have no output. A network that improves its estimate step by step gives all of them in
            training, in front: [updates, B, T, 2, H, W].

        Raises:
            UsageError: another shape.
        """
        lead = self.lead_voxels if state is None else 0
        if voxels.ndim != 5 or voxels.shape[2] != self.bins or 0 in voxels.shape or voxels.shape[1] <= lead:
            raise UsageError(
                f"voxels of shape {list(voxels.shape)}: this network takes [B, T, {self.bins}, H, W], none of them 0"
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
        """Compile one turn of each loop, for training: see :class:`trainer.models.blocks.Loop`.

        Raises:
            UsageError: there is no loop.
        """
        loops = [module for module in self.modules() if isinstance(module, Loop)]
        if not loops:
            raise UsageError(f"{type(self).__name__} has no loop over time of which one step could be compiled")
        torch._dynamo.config.recompile_limit = 64  # layers of a kind share their code, and each is a shape of its own
        for loop in loops:
            loop.compile_turn()

    def _edges(self, height: int, width: int) -> tuple[int, int, int, int]:
        """Pixels to add: left, right, top, bottom."""
        right, below = -width % self.size_multiple, -height % self.size_multiple
        if self.padding == "bottom-right":
            return 0, right, 0, below
        if self.padding == "top-left":
            return right, 0, below, 0
        return right - right // 2, right // 2, below - below // 2, below // 2

    def forward_sequence(self, voxels: Tensor) -> Tensor:
        """The outputs for whole sequences from the state after a reset: [B, T, bins, H, W] -> [B, T, C, H, W]."""
        outputs: Tensor = self(voxels)[0]
        return outputs


def predict(layer: nn.Module, x: Tensor) -> Tensor:
    """The last, 1x1 convolution, outside autocast: a bfloat16 picture would have steps of 1/256 near white."""
    with torch.autocast(x.device.type, enabled=False):
        picture: Tensor = layer(x.to(next(layer.parameters()).dtype))
        return picture
