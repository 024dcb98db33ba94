"""The result of a simulation, and its display in a notebook."""

from __future__ import annotations

import base64
import os
from pathlib import Path
from typing import Any, NamedTuple

import numpy.typing as npt

from v2v_protocol.events import EventList, to_events
from v2v_protocol.tables import html_table


class Voxels(NamedTuple):
    """Result of a simulation.

    Attributes:
        voxels: [T, bins, H, W] signed event counts.
        saturated_bins: number of bins that were clipped to the range of the dtype.
    """

    voxels: npt.NDArray[Any]
    saturated_bins: int

    def to_events(self, bin_us: float) -> EventList:
        """Convert to events (x, y, t, p) with these counts, for bins of ``bin_us`` microseconds. Their times within a
        bin are invented, by the rule of ``v2v_protocol.events``.

        Raises:
            UsageError: the duration is out of range.
        """
        return to_events(self.voxels, bin_us)

    def show(self, path: str | os.PathLike[str] | None = None) -> Any:
        """Draw up to four voxel grids, bin by bin, as a picture that a notebook displays.

        Args:
            path: also write the picture to this PNG file; None writes no file.

        Returns:
            A PIL image.

        Raises:
            UsageError: the file cannot be written.
        """
        from PIL import Image

        from v2v_pictures.files import write_png

        image = self._picture()
        if path is not None:
            write_png(Path(path), image)
        return Image.fromarray(image)

    def __repr__(self) -> str:
        return f"Voxels({self.voxels.dtype}{list(self.voxels.shape)}, {self.saturated_bins} bins saturated)"

    def _picture(self) -> Any:
        from v2v_pictures.grids import draw_grids  # drawing is for people: a worker never loads it

        return draw_grids(self.voxels)

    def _repr_png_(self) -> bytes:
        from v2v_pictures.files import png_bytes

        return png_bytes(self._picture())

    def _repr_html_(self) -> str:
        shape = f"{self.voxels.dtype} {list(self.voxels.shape)}"
        table = html_table("Voxels", {"voxels": shape, "saturated_bins": self.saturated_bins})
        return f'{table}<img src="data:image/png;base64,{base64.b64encode(self._repr_png_()).decode()}">'
