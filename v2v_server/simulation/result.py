"""The result of a simulation, and its display in a notebook."""

from __future__ import annotations

import base64
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import UsageError
from v2v_protocol.events import EventList
from v2v_protocol.sample import html_table
from v2v_server.simulation.kernels import ARRAYS, KernelInput, fill, list_events
from v2v_server.simulation.precision import Real


@dataclass(frozen=True, slots=True, repr=False, eq=False)
class Voxels:
    """Result of a simulation; ``voxels, saturated_bins = simulate(...)`` unpacks it.

    Attributes:
        voxels: [T, bins, H, W] signed event counts.
        saturated_bins: number of bins that were clipped to the range of the dtype.
        saturated: the same for every array that was made, by name.
        given: the inputs, and ``real``, the arithmetic: the other arrays and events are simulated from them on demand.
    """

    voxels: npt.NDArray[Any]
    saturated_bins: int
    saturated: Mapping[str, int]
    given: KernelInput
    real: Real

    @classmethod
    def of(cls, given: KernelInput, real: Real, out: Mapping[str, npt.NDArray[Any]] | None = None) -> Voxels:
        """Simulate a clip: fill the arrays of ``out``, or make the voxels.

        Raises:
            UsageError: an array of ``out`` has another form than ``KernelInput.form`` states.
        """
        arrays, saturated = fill(given, real, {"voxels": None} if out is None else out)
        return cls(arrays.get("voxels", np.empty(0)), saturated.get("voxels", 0), saturated, given, real)

    def __iter__(self) -> Iterator[Any]:
        return iter((self.voxels, self.saturated_bins))

    def array(self, name: str) -> npt.NDArray[Any]:
        """Simulate another array of the same clip.

        Args:
            name: "event_counts", [T, 2, bins, H, W]: negative (0) and positive (1) counts; or "voxels_bilinear",
                [T, bins, H, W]: each event is shared between the two bins next to its time.

        Raises:
            UsageError: there is no such array.
        """
        if name not in ARRAYS:
            raise UsageError(f"array {name!r}: choose one of {', '.join(ARRAYS)}")
        return cast("npt.NDArray[Any]", fill(self.given, self.real, {name: None})[0][name])

    def to_events(self, bin_us: float) -> EventList:
        """List the events (x, y, t, p) that the voxels count, with their times, for bins of ``bin_us`` microseconds.

        Raises:
            UsageError: the duration is out of range.
        """
        steps = len(self.given.step_seconds)
        return list_events(self.given, self.real, np.full(steps, bin_us * (len(self.given.edges.step) - 1) / steps))

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
