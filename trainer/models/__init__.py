"""The networks, one a file. Every one takes [B, T, bins, H, W] voxel grids and gives a sequence of pictures or flow."""

from trainer.models.e2vid import E2VID
from trainer.models.firenet import FireNet
from trainer.models.sequence import VoxelNetwork, normalize_voxels

NETWORKS: dict[str, type[VoxelNetwork]] = {"e2vid": E2VID, "firenet": FireNet}
"""Networks by the name that a configuration file gives them."""

__all__ = ["E2VID", "NETWORKS", "FireNet", "VoxelNetwork", "normalize_voxels"]
