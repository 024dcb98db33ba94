"""Dense inverse search (Kroeger et al., "Fast Optical Flow using Dense Inverse Search", ECCV 2016), by OpenCV.

Patches are matched from coarse to fine down to a finest scale, whose field is then enlarged: scale 2 is a quarter of
the picture's size. Scale 1 takes about four times as long and resolves motion that scale 2 blurs.
"""

from __future__ import annotations

from v2v_server.flow.estimator import Estimator, Field, Picture
from v2v_server.system.opencv import cv2

ULTRAFAST, FAST, MEDIUM = range(3)
"""OpenCV's numbers, DISOPTICAL_FLOW_PRESET_*: naming them here would load it."""

SMALLEST_SIDE_PX = 64
"""OpenCV refuses pictures below 12 pixels, and reads outside its buffers on some larger ones: 16x300, 24x600."""


def dis(
    preset: int, finest_scale: int, patch_stride_px: int | None = None, refinements: int | None = None
) -> Estimator:
    """An estimator with a preset's number of iterations, patch stride and refinement.

    Args:
        preset: ULTRAFAST, FAST or MEDIUM.
        finest_scale: the pyramid level that matching ends at; 0 is the full picture.
        patch_stride_px: distance of patches on each level; None: the preset's, 4 (medium: 3). Patches have 8 pixels.
        refinements: iterations of the variational refinement; None: the preset's, 5 (ultrafast: none).
    """
    search = cv2.DISOpticalFlow.create(preset)
    if patch_stride_px is not None:
        search.setPatchStride(patch_stride_px)

    if refinements is not None:
        search.setVariationalRefinementIterations(refinements)

    def estimate(first: Picture, second: Picture) -> Field:
        # A small picture makes OpenCV lower the finest scale, and leave it so for the pictures that follow.
        search.setFinestScale(finest_scale)
        field: Field = search.calc(first, second, None)  # type: ignore[call-overload]
        return field

    return estimate
