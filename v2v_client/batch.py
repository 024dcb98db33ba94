"""Define the batch that a dataset yields, and draw batches and samples for notebooks.

``v2v_pictures`` is imported when a picture is drawn, because it needs more packages than a consumer does.
"""

from __future__ import annotations

import base64
import dataclasses
import importlib
import os
from collections.abc import ItemsView, KeysView, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Never

import numpy as np
import numpy.typing as npt
import torch
from torch.utils.data._utils.collate import default_collate_fn_map

from v2v_protocol.errors import UsageError
from v2v_protocol.recipe import Recipe
from v2v_protocol.sample import ARRAYS, Provenance, html_table
from v2v_protocol.settings import nearest

_SHOWN = 3


_OF_TENSORS = {
    "cuda": '; write .to("cuda")', "cpu": '; write .to("cpu")', "device": "; each array has its own",
    "half": "; write .to(torch.float16)", "float": "; write .to(torch.float32)", "size": "; write .voxels.shape",
    "to": "; its arrays are NumPy's: torch.from_numpy(sample.voxels), or a DataLoader, which makes batches of tensors",
    "shape": "; write .voxels.shape", "dtype": "; write .voxels.dtype", "values": "; write .arrays.values()",
}  # fmt: skip
"""Answers to names of PyTorch and of mappings."""


class Drawn:
    """Give access to arrays by name, and give a notebook the picture that ``_picture`` draws, [height, width, 3] uint8
    RGB.
    """

    __slots__ = ()
    _KIND: ClassVar = "sample"

    arrays: Mapping[str, Any]

    def keys(self) -> KeysView[str]:
        """Return the names of the arrays. They make ``dict(batch)`` and ``network(**batch)`` work."""
        return self.arrays.keys()

    def items(self) -> ItemsView[str, Any]:
        """Return the names and the arrays."""
        return self.arrays.items()

    def __getitem__(self, name: str) -> Any:
        """Return the array called ``name``.

        Raises:
            KeyError: there is no array of that name.
        """
        if name not in self.arrays:
            raise KeyError(f"{name!r}: this {self._KIND} has {', '.join(self.arrays)}; index it by one of these names")
        return self.arrays[name]

    def __contains__(self, name: object) -> bool:
        """Return whether there is an array of that name."""
        return name in self.arrays

    __iter__ = None  # ambiguous: the length of a batch counts samples, the keys name arrays

    def __getattr__(self, name: str) -> Any:
        """Return the array of this name.

        Raises:
            UsageError: the dataset did not request this array.
            AttributeError: there is no such array; the message names the nearest attribute.
        """
        if name not in ARRAYS:
            answer = _OF_TENSORS.get(name, "")
            if ".to(" in answer and not hasattr(type(self), "to"):
                answer = _OF_TENSORS["to"]
            hint = answer or nearest(name, (*ARRAYS, *dir(type(self))))
            raise AttributeError(f"a {self._KIND.title()} has no {name!r}{hint}")
        return self._array(name)

    def __dir__(self) -> list[str]:
        """List the arrays among the attributes, for the completion of a notebook."""
        return [*object.__dir__(self), *self.arrays]

    def _array(self, name: str) -> Any:
        if name not in self.arrays:
            raise UsageError(
                f"{self._KIND}.{name}: this {self._KIND} has only {', '.join(self.arrays)}; create the dataset with "
                f"arrays={(*self.arrays, name)!r}, or check `{name!r} in {self._KIND}` first"
            )
        return self.arrays[name]

    def _picture(self) -> npt.NDArray[np.uint8]:
        raise NotImplementedError

    def show(self, path: str | os.PathLike[str] | None = None) -> Any:
        """Draw a picture of the sample, or of the first 3 samples of the batch, which a notebook displays.

        Args:
            path: PNG file to write as well; None writes no file.

        Returns:
            A PIL image.

        Raises:
            UsageError: there are no voxels or no frames, the file cannot be written, or pillow or av is not installed.
        """
        image = self._picture()
        if path is not None:
            _drawing("files").write_png(Path(path), image)
        return _imported("PIL.Image").fromarray(image)

    def _repr_png_(self) -> bytes | None:
        try:
            encoded: bytes = _drawing("files").png_bytes(self._picture())
        except UsageError:  # it cannot be drawn: the notebook then shows only text
            return None
        return encoded

    def _html_image(self) -> str:
        encoded = self._repr_png_()
        return "" if encoded is None else f'<img src="data:image/png;base64,{base64.b64encode(encoded).decode()}">'


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Batch(Drawn):
    """Hold the samples of one batch, in the order of the epoch.

    Each array that the dataset requested is an attribute and an item: ``batch.voxels``, ``batch["voxels"]``. The
    attribute of one that it did not request raises UsageError. With T frames of a clip:

    voxels            [B, T + lead_voxels, bins, H, W] in the spec's ``voxel_dtype``: signed counts, ON events positive.
                      Voxel t spans frames t - 1 -> t of the target sequence. With ``grids_per_frame`` n there are n
                      times as many, and :attr:`frame_grids` says which ends at which frame. With ``voxel_seconds``,
                      ``provenance[b].grid_seconds`` has their durations
    event_counts      [B, T, 2, bins, H, W], T as for voxels, of the same dtype: OFF (0) and ON (1) events
    voxels_bilinear   shaped like voxels, float16 (float32 if ``voxel_dtype`` is): each event shared between the two
                      bins next to its time
    time_surface      [B, T, 2, bins, H, W], T as for voxels, float16 or float32: age of the last OFF (0) and ON (1)
                      event at the end of each bin, s; infinity before the first in the clip
    frames            [B, T + lead_frames, 1, H, W] uint8, the simulated pixels
    frames_rgb        [B, T + lead_frames, 3, H, W] uint8, red, green and blue
    frames_u16        [B, T + lead_frames, 1, H, W] uint16, with the levels that the video stores
    frames_blurred    [B, T + lead_frames, 1, H, W] uint8, the frames exposed for ``exposure_seconds`` of the recipe
    frames_all        [B, steps + 1, 1, H, W] uint8, all frames that were simulated, the first included
    flow              [B, T, 2, H, W] float16, (x, y) px; flow[:, t] belongs to voxel t of the target sequence, and is
                      zero before ``flow_from``
    flow_valid        [B, T, 1, H, W] uint8, 1 where forward and backward flow agree; of photographs, where both see it
    tracks            [B, T + lead_frames, N, 3] float32, x and y (px of the crop) of points of photographs, and 1 where
                      they are seen
    masks             [B, T, 1, H, W] uint8, T as for frames: classes; 255 in a sample without labels
    boxes             a list, see :attr:`boxes`

    Attributes:
        arrays: the requested tensors by name (``v2v_protocol.sample.ARRAYS``).
        indices: place of each sample in the order of its epoch, 0 .. sequences - 1. In another epoch the same place has
            another clip: ``provenance`` names the video.
        epoch: epoch of the samples.
        provenance: origin of each sample.
        resume_state: the state after this batch, for :meth:`v2v_client.dataset.V2VStreamDataset.load_state_dict`.
            Save the state of the last batch you trained on. It is valid for any number of loader workers.
        wait_seconds: how long the consumer (with a DataLoader: the loader worker) waited for this batch.
        cpu_seconds: processor time that the server's workers spent on it.
        decodes: clips decoded for it; fewer than its samples if siblings share a decode.
        recipe: the virtual cameras that its samples were drawn from.
    """

    _KIND: ClassVar = "batch"

    arrays: Mapping[str, torch.Tensor]
    indices: tuple[int, ...]
    epoch: int
    provenance: tuple[Provenance, ...]
    resume_state: Mapping[str, Any]
    wait_seconds: float
    cpu_seconds: float
    decodes: int
    recipe: Recipe

    def __len__(self) -> int:
        return len(self.indices)

    def __repr__(self) -> str:
        arrays = "".join(
            f"{name}: {str(tensor.dtype).removeprefix('torch.')}{list(tensor.shape)} on {tensor.device}, "
            for name, tensor in self.arrays.items()
        )
        some = ", ".join(map(str, self.indices[:3])) + (", ..." if len(self) > 3 else "")
        return f"Batch({arrays}epoch {self.epoch}, indices {some})"

    def _picture(self) -> npt.NDArray[np.uint8]:
        count = min(_SHOWN, len(self))
        samples = [
            ({name: tensor[place].cpu().numpy() for name, tensor in self.arrays.items()}, self.provenance[place])
            for place in range(count)
        ]
        return draw_samples(samples, self.recipe, f"{count} of {len(self)} samples, epoch {self.epoch}")

    def _repr_html_(self) -> str:
        rows = {name: f"{tensor.dtype} {list(tensor.shape)} {tensor.device}" for name, tensor in self.arrays.items()}
        return html_table(f"Batch of {len(self)}, epoch {self.epoch}", rows) + self._html_image()

    @property
    def frame_grids(self) -> torch.Tensor:
        """Return the number of the voxel grid that ends at each frame: int64 [T + lead_frames].

        ``outputs[:, batch.frame_grids]`` are the outputs of a network at the frames. A lead frame before the first grid
        has -1.
        """
        return torch.tensor(self.recipe.frame_grids)

    @property
    def boxes(self) -> list[list[torch.Tensor]]:
        """Return the boxes: ``boxes[b][t]`` is float32 [n, 7] with the columns of ``v2v_protocol.sample.BOX_COLUMNS``.

        x0, y0, x1, y1 in px, class, track, and the visible share; the largest box first. Index t as for frames.
        ``self["boxes"]`` is the same as one tensor, [B, T, max_boxes, 7], with -1 where there is no box.

        Raises:
            UsageError: the dataset did not request this array.
        """
        return self.rows("boxes")

    def rows(self, name: str) -> list[list[torch.Tensor]]:
        """Return a label with rows in each frame: for each sample a list of [n, columns], without empty rows.

        Raises:
            UsageError: the dataset did not request this array.
        """
        label = self._array(name)
        counts = (label != ARRAYS[name].empty).any(-1).sum(-1).tolist()
        return [[frame[:count] for frame, count in zip(*clip, strict=True)] for clip in zip(label, counts, strict=True)]

    @property
    def labelled(self) -> tuple[bool, ...]:
        """Return, for each sample, whether all arrays that were requested could be made."""
        return tuple(origin.labelled for origin in self.provenance)

    @property
    def nbytes(self) -> int:
        """Return the size of all tensors in bytes."""
        return sum(tensor.nbytes for tensor in self.arrays.values())

    def pin_memory(self) -> Batch:
        """Return a copy in page-locked memory; this batch itself where there is no CUDA device, which alone copies
        faster from such memory. ``DataLoader(pin_memory=True)`` calls this.
        """
        if not torch.cuda.is_available():
            return self
        return dataclasses.replace(self, arrays={name: tensor.pin_memory() for name, tensor in self.arrays.items()})

    def to(
        self,
        device: torch.device | str | torch.dtype | None = None,
        dtype: torch.dtype | None = None,
        *,
        non_blocking: bool = False,
    ) -> Batch:
        """Return this batch with its tensors on ``device``, converted to ``dtype``. Either one may come alone.

        Args:
            non_blocking: True returns before the copy is done, if this batch is in page-locked memory or on a device.
                A copy from other memory is always completed first, because that memory is reused for new samples once
                this batch is dropped.

        Raises:
            UsageError: ``device`` is no device, or ``dtype`` no dtype.
        """
        if not isinstance(dtype, torch.dtype | None):
            raise UsageError(f"batch.to({device!r}, {dtype!r}): give a torch.dtype, or non_blocking=True by its name")
        if not isinstance(device, torch.device | torch.dtype | int | None):
            try:
                torch.device(device)
            except (RuntimeError, TypeError) as error:
                name = getattr(device, "__name__", str(device))
                meant = f"torch.{name}" if isinstance(getattr(torch, name, None), torch.dtype) else "a torch.dtype"
                raise UsageError(f'batch.to({device!r}): give a device, such as "cuda" or "cpu", or {meant}') from error

        def move(item: torch.Tensor) -> torch.Tensor:
            # PyTorch keeps page-locked memory until the copy is done, but does not track this library's memory.
            safe = non_blocking and (item.device.type != "cpu" or item.is_pinned())
            return item.to(*((device,) if dtype is None else (device, dtype)), non_blocking=safe)  # type: ignore[call-overload, no-any-return]

        return dataclasses.replace(self, arrays={name: move(item) for name, item in self.arrays.items()})


def refuse(self: Any, name: str, value: object) -> Never:
    """Refuse to assign to a frozen dataclass with arrays, and say what to do, in place of Python's own message.

    Raises:
        FrozenInstanceError: always.
    """
    raise dataclasses.FrozenInstanceError(
        f"{self._KIND}.{name} = ...: a {self._KIND} cannot be changed; keep the array in a variable, or in a dict, "
        f"dict({self._KIND}, {name}=...)"
    )


Batch.__setattr__ = refuse  # type: ignore[method-assign]


def _collate(batches: Any, *, collate_fn_map: Any) -> Any:
    raise UsageError(
        "DataLoader collates samples, but V2VStreamDataset yields whole batches: use "
        "DataLoader(dataset, batch_size=None, ...) and V2VStreamDataset(..., batch_size=...)"
    )


# PyTorch's registry of collate functions for custom types.
default_collate_fn_map[Batch] = _collate


def draw_samples(
    samples: Sequence[tuple[Mapping[str, npt.NDArray[Any]], Provenance]], recipe: Recipe, title: str
) -> npt.NDArray[np.uint8]:
    """Draw a sheet of samples: frame, bins, flow, and activity over time.

    Args:
        samples: arrays and provenance of each, at least one.
        recipe: their virtual cameras.

    Returns:
        [height, width, 3] uint8 RGB.

    Raises:
        UsageError: voxels or frames are not among the arrays, or pillow or av is not installed.
    """
    camera, sheet = _drawing("camera"), _drawing("sheet")
    cameras = [camera.Camera.of(arrays, provenance, "", recipe) for arrays, provenance in samples]
    drawn: npt.NDArray[np.uint8] = sheet.draw_sheet(cameras, title)
    return drawn


def _drawing(name: str) -> Any:
    return _imported(f"v2v_pictures.{name}")


def _imported(module: str) -> Any:
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        raise UsageError(f"drawing a picture needs the package {error.name}: pip install pillow av") from error
