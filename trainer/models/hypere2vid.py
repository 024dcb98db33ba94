"""Define HyperE2VID: E2VID whose first decoder has another kernel at every pixel (Ercan et al., TIP 2024).

The kernels depend on a context, the voxel grid concatenated with the network's own last picture:

context        bilinear to 1/4 of the size, conv3                             5 + 1 -> 32
coefficients   conv3, batch norm, tanh, conv3, batch norm, tanh              32 -> 64 -> 6 x 12
atoms          6 kernels of 5 x 5 at each pixel: sums of 12 fixed Fourier-Bessel functions, by the coefficients
decoder 0      bilinear upsampling, convolution with the atoms (256 -> 256 x 6), conv1 (-> 128), ReLU

Everything else is E2VID. 10,149,881 parameters, and 574 values that are not trained (the functions, and the statistics
of batch norm). Only the decoders loop over time, because only they see the last picture. Attribute names are those of
the published state dicts.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from scipy.special import jn_zeros, jv  # type: ignore[import-untyped]
from torch import Tensor, nn
from torch.nn import functional as F

from trainer.models.blocks import Loop, LSTMState
from trainer.models.e2vid import E2VID
from trainer.models.sequence import Guide, Padding, Settings, predict

ATOMS = 6
_SIDE_PX = 5
PER_SCALE = 6
CONTEXT_CHANNELS = 32
HIDDEN_CHANNELS = 64
CONTEXT_SCALE = 0.25


def fourier_bessel(reach: int, bandwidth: float) -> npt.NDArray[np.float64]:
    """Return the smoothest functions on a disc, sampled at integer pixels.

        psi(rho, phi) = J_k(z rho) / |J_(k+1)(z)| * {1, sqrt(2) cos(k phi), sqrt(2) sin(k phi)},  z a zero of J_k

    for rho < 1, else 0; rho is the distance to the centre in units of R = reach + 1/2. The functions are sorted by z;
    k = 0 gives one function, other k give two. (Qiu et al., "DCFNet", ICML 2018.)

    Args:
        reach: pixels from the centre to the edge.
        bandwidth: a zero counts if the next one of its J_k is at most pi R bandwidth.

    Returns:
        [n, 2 reach + 1, 2 reach + 1], n at most (2 reach + 1)^2 - 1, with a mean square norm of 1 over the functions.
    """
    radius = reach + 0.5
    places = np.arange(-reach - 1, reach + 2) / radius
    row, column = np.meshgrid(places, places, indexing="ij")
    rho, phi = np.hypot(row, column), np.arctan2(column, row)
    zeros = []
    for order in range(16):
        of_order = jn_zeros(order, 17)
        zeros += [
            (zero, order) for zero, following in itertools.pairwise(of_order) if following <= np.pi * radius * bandwidth
        ]
    functions = []
    for zero, order in sorted(zeros):
        radial = np.where(rho < 1, jv(order, zero * rho) / abs(jv(order + 1, zero)), 0)
        if order:
            functions += [radial * np.sqrt(2) * angular(order * phi) for angular in (np.cos, np.sin)]
        else:
            functions.append(radial)
    kept = np.stack(functions[: (2 * reach + 1) ** 2 - 1])[:, 1:-1, 1:-1]
    scaled: npt.NDArray[np.float64] = kept / np.sqrt((kept**2).sum(axis=(1, 2)).mean())
    return scaled


def bases() -> Tensor:
    """Return the fixed functions [12, 25]: six of a 3 x 3 neighbourhood, then six of 5 x 5."""
    narrow = np.pad(fourier_bessel(1, 2.0)[:PER_SCALE], ((0, 0), (1, 1), (1, 1)))
    wide = fourier_bessel(2, 1.5)[:PER_SCALE]
    return torch.from_numpy(np.concatenate([narrow, wide]).reshape(2 * PER_SCALE, _SIDE_PX**2)).float()


class _ContextFusion(nn.Module):
    def __init__(self, inputs: int) -> None:
        super().__init__()
        self.conv = nn.Conv2d(inputs, CONTEXT_CHANNELS, 3, padding=1)

    def forward(self, voxel: Tensor, picture: Tensor) -> Tensor:
        both = torch.cat([voxel, picture], dim=1)
        small = F.interpolate(both, scale_factor=CONTEXT_SCALE, mode="bilinear", align_corners=False)
        context: Tensor = self.conv(small)
        return context


class _AtomGeneration(nn.Module):
    """Map the context to coefficients of the fixed functions, [B, atoms, functions, h, w]."""

    bases: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("bases", bases())
        outputs = ATOMS * len(self.bases)
        self.bases_net = nn.Sequential(
            nn.Conv2d(CONTEXT_CHANNELS, HIDDEN_CHANNELS, 3, padding=1),
            nn.BatchNorm2d(HIDDEN_CHANNELS),
            nn.Tanh(),
            nn.Conv2d(HIDDEN_CHANNELS, outputs, 3, padding=1),
            nn.BatchNorm2d(outputs),
            nn.Tanh(),
        )

    def forward(self, context: Tensor) -> Tensor:
        return torch.unflatten(self.bases_net(context), 1, (ATOMS, len(self.bases)))


class _DynamicConv(nn.Module):
    """Convolve with the atoms of each pixel, then apply a 1 x 1 convolution over all of their results."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.compositional_coefficients = nn.Parameter(torch.empty(outputs, inputs * ATOMS, 1, 1))
        self.bias = nn.Parameter(torch.zeros(outputs))
        nn.init.kaiming_normal_(self.compositional_coefficients, mode="fan_out", nonlinearity="relu")

    def forward(self, x: Tensor, coefficients: Tensor, functions: Tensor) -> Tensor:
        # An atom is a sum of functions, and convolution is linear. So the fixed functions are applied first, to the
        # whole picture at once, and the sum over them is taken at each pixel. This avoids 25 copies of x.
        kernels = functions.view(-1, 1, _SIDE_PX, _SIDE_PX).to(x.dtype)
        filtered = F.conv2d(x.flatten(0, 1).unsqueeze(1), kernels, padding=_SIDE_PX // 2)
        filtered = torch.unflatten(filtered, 0, x.shape[:2])
        by_atom = torch.einsum("bckhw,bmkhw->bcmhw", filtered, coefficients.to(filtered.dtype))
        return F.conv2d(by_atom.flatten(1, 2), self.compositional_coefficients, self.bias)


class DynamicDecoder(nn.Module):
    """Apply upsampling by 2, dynamic convolution, ReLU."""

    def __init__(self, bins: int, inputs: int, outputs: int) -> None:
        super().__init__()
        self.context_fusion = _ContextFusion(bins + 1)
        self.dynamic_atom_generation = _AtomGeneration()
        self.dynamic_conv = _DynamicConv(inputs, outputs)

    def forward(self, x: Tensor, voxel: Tensor, picture: Tensor) -> Tensor:
        """Decode one time step to [B, outputs, H / 4, W / 4].

        Args:
            x: [B, inputs, H / 8, W / 8].
            voxel: [B, bins, H, W].
            picture: [B, 1, H, W], the network's last picture.
        """
        coefficients = self.dynamic_atom_generation(self.context_fusion(voxel, picture))
        x = F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=False)
        return F.relu(self.dynamic_conv(x, coefficients, self.dynamic_atom_generation.bases))


class HyperState(NamedTuple):
    """Hold one :class:`LSTMState` per encoder, and the last picture [B, 1, H, W]."""

    encoders: tuple[LSTMState, ...]
    picture: Tensor


class HyperE2VID(Loop, E2VID):
    """Reconstruct pictures with HyperE2VID.

    Args:
        bins: bins of a voxel grid.
        base_channels: channels of the head; each of three encoders doubles them.
        normalize_voxels, padding: see :class:`VoxelNetwork`.
    """

    signature = ("unetrecurrent.decoders.0.dynamic_conv.compositional_coefficients",)

    def __init__(
        self,
        *,
        bins: int = 5,
        base_channels: int = 32,
        normalize_voxels: bool = False,
        padding: Padding = "bottom-right",
    ) -> None:
        super().__init__(bins=bins, base_channels=base_channels, normalize_voxels=normalize_voxels, padding=padding)
        self.unetrecurrent.decoders[0] = DynamicDecoder(bins, 8 * base_channels, 4 * base_channels)

    def unroll(  # type: ignore[override]
        self, x: Tensor, state: HyperState | None, steps: int, guide: Guide | None
    ) -> tuple[Tensor, HyperState]:
        """Run the network, see :meth:`VoxelNetwork.unroll`."""
        net = self.unetrecurrent
        features, skips, after = net.encode(x, None if state is None else state.encoders, steps)
        voxels = x.chunk(steps)
        picture = torch.zeros_like(voxels[0][:, :1]) if state is None else state.picture
        shown = None if guide is None else guide.pictures.chunk(steps)
        # In the order of the decoders, from the coarsest skip to the head, each split into its time steps.
        by_step = zip(voxels, features.chunk(steps), *(skip.chunk(steps) for skip in reversed(skips)), strict=True)
        pictures = []
        for step, (voxel, z, *added) in enumerate(by_step):
            if guide is not None and shown is not None:
                picture = torch.lerp(picture, shown[step], guide.share)
            pictures.append(self.turn(voxel, picture, z, *added))
            picture = pictures[-1].detach()
        return torch.cat(pictures), HyperState(after, picture)

    def _turn(self, voxel: Tensor, picture: Tensor, z: Tensor, *added: Tensor) -> Tensor:
        """Return the picture of one time step. ``added`` are the skip connections, in the order of use."""
        net = self.unetrecurrent
        z = net.decoders[0](z + added[0], voxel, picture)
        for decoder, skip in zip(list(net.decoders)[1:], added[1:-1], strict=True):
            z = decoder(z + skip)
        return predict(net.pred, z + added[-1])

    @classmethod
    def from_state(cls, state: Mapping[str, Tensor], settings: Settings) -> dict[str, Any]:
        """Derive the arguments as E2VID does; HyperE2VID fixes all others."""
        arguments = super().from_state(state, settings)
        return {name: arguments[name] for name in ("bins", "base_channels", "normalize_voxels", "padding")}
