"""Class masks: a PNG file for each frame, whose grey levels or palette indices are the classes.

The digits at the end of a file's name are its frame, from 0.
"""

from __future__ import annotations

import io
from importlib.resources.abc import Traversable

import numpy as np
import numpy.typing as npt

_GREY, _PALETTE = 0, 3
"""Colour types of a PNG file, its byte 25; byte 24 is the number of bits."""


def read_mask(file: Traversable, picture_px: tuple[int, int]) -> npt.NDArray[np.uint8]:
    """Read the mask of one frame: [height, width] uint8.

    Args:
        file: a PNG file of 8 bits a pixel or fewer, grey or with a palette.
        picture_px: height and width of the video's upright picture.

    Raises:
        ValueError: it is another kind of picture, or has another size.
    """
    from PIL import Image  # only samples with masks need it

    data = file.read_bytes()
    try:
        with Image.open(io.BytesIO(data), formats=["PNG"]) as picture:
            if (size := (picture.height, picture.width)) != picture_px:
                raise ValueError(f"has {size[1]}x{size[0]} px: the video has {picture_px[1]}x{picture_px[0]} px")
            if data[25] != _PALETTE and (data[25], data[24]) not in ((_GREY, 1), (_GREY, 8)):  # Pillow rescales others
                raise ValueError("is neither 8-bit grey nor a palette: write the classes as one of these")
            return np.asarray(picture).astype(np.uint8)
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:  # Pillow raises all of these
        raise ValueError(f"{file.name} {error}") from error
