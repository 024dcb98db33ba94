"""Draw batches and samples for notebooks.

``v2v_pictures`` is imported when a picture is drawn, because it needs more packages than a consumer does.
"""

from __future__ import annotations

import base64
import dataclasses
import importlib
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import UsageError
from v2v_protocol.recipe import Recipe
from v2v_protocol.sample import Provenance


def draw_samples(
    samples: Sequence[tuple[Mapping[str, npt.NDArray[Any]], Provenance]], recipe: Recipe | None, title: str
) -> npt.NDArray[np.uint8]:
    """Draw a sheet of samples: frame, bins, flow, and activity over time.

    Args:
        samples: arrays and provenance of each, at least one.
        recipe: None if it is unknown. Then pauses cannot be placed: they are not marked, and the title says so.

    Returns:
        [height, width, 3] uint8 RGB.

    Raises:
        UsageError: voxels or frames are not among the arrays, or pillow or av is not installed.
    """
    camera, sheet = _drawing("camera"), _drawing("sheet")
    cameras = []
    for arrays, provenance in samples:
        if recipe is None and provenance.params.pauses:
            provenance = dataclasses.replace(provenance, params=dataclasses.replace(provenance.params, pauses=()))
            title = title.removesuffix(_UNMARKED) + _UNMARKED
        cameras.append(camera.Camera.of(arrays, provenance, "", recipe))
    drawn: npt.NDArray[np.uint8] = sheet.draw_sheet(cameras, title)
    return drawn


_UNMARKED = " (pauses are not marked)"


def to_png(image: npt.NDArray[np.uint8]) -> bytes:
    """Encode the picture as PNG."""
    encoded: bytes = _drawing("files").png_bytes(image)
    return encoded


def try_png(draw: Callable[[], npt.NDArray[np.uint8]]) -> bytes | None:
    """Return the drawn picture as PNG, or None if it cannot be drawn: the notebook then shows only text."""
    try:
        return to_png(draw())
    except UsageError:
        return None


def html_image(encoded: bytes | None) -> str:
    """Return an HTML image element for a PNG, or "" for None."""
    return "" if encoded is None else f'<img src="data:image/png;base64,{base64.b64encode(encoded).decode()}">'


def to_pil_image(image: npt.NDArray[np.uint8], path: str | os.PathLike[str] | None) -> Any:
    """Return the picture as a PIL image, which a notebook displays.

    Args:
        path: PNG file to write as well; None writes no file.

    Raises:
        UsageError: the file cannot be written, or pillow or av is not installed.
    """
    if path is not None:
        _drawing("files").write_png(Path(path), image)
    return _imported("PIL.Image").fromarray(image)


def _drawing(name: str) -> Any:
    return _imported(f"v2v_pictures.{name}")


def _imported(module: str) -> Any:
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        raise UsageError(f"drawing a picture needs the package {error.name}: pip install pillow av") from error
