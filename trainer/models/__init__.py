"""Define the networks, one per file. Each maps voxel grids [B, T, bins, H, W] to a sequence of pictures or flow."""

from trainer.models.e2vid import E2VID
from trainer.models.eraft import ERAFT
from trainer.models.etnet import ETNet
from trainer.models.evflownet import EVFlowNet
from trainer.models.firenet import FireNet
from trainer.models.hypere2vid import HyperE2VID
from trainer.models.sequence import VoxelNetwork, normalize_voxels

NETWORKS: dict[str, type[VoxelNetwork]] = {
    "e2vid": E2VID,
    "hypere2vid": HyperE2VID,
    "etnet": ETNet,
    "firenet": FireNet,
    "evflownet": EVFlowNet,
    "eraft": ERAFT,
}
"""Networks by their names in configuration files."""

__all__ = [
    "E2VID",
    "ERAFT",
    "NETWORKS",
    "ETNet",
    "EVFlowNet",
    "FireNet",
    "HyperE2VID",
    "VoxelNetwork",
    "normalize_voxels",
]
