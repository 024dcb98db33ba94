"""Reconstruction networks. Every one takes [B, T, bins, H, W] voxel grids and gives [B, T, 1, H, W] pictures."""

from trainer.models.e2vid import E2VID
from trainer.models.firenet import FireNet
from trainer.models.sequence import ReconstructionNetwork, normalize_voxels

NETWORKS: dict[str, type[ReconstructionNetwork]] = {"e2vid": E2VID, "firenet": FireNet}
"""Networks by the name that a configuration file gives them."""

__all__ = ["E2VID", "NETWORKS", "FireNet", "ReconstructionNetwork", "normalize_voxels"]
