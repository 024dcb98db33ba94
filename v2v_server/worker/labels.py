"""Fill boxes and masks from the files beside the video."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import lru_cache
from importlib.resources.abc import Traversable
from typing import Any

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import SidecarError
from v2v_protocol.sample import sidecar_endings
from v2v_server.labels.boxes import BoxTable
from v2v_server.labels.formats import READERS, numbered_files
from v2v_server.labels.masks import read_mask
from v2v_server.labels.views import kept_boxes, view_boxes, view_mask
from v2v_server.worker.arrays import SampleContext, makes

_KEPT = 4
"""Sidecars that stay in memory once they are read: siblings use them one after the other."""
_LARGEST_FILE_BYTES = 256 << 20


@dataclass(frozen=True)
class _LabelFile:
    """A sidecar of one video. Equal ones have equal bytes."""

    video: str
    ending: str
    fingerprint: str
    picture_px: tuple[int, int]
    opened: Traversable = field(compare=False)

    @classmethod
    def of(cls, context: SampleContext, array: str) -> _LabelFile:
        """Return the one sidecar that the array is made from.

        Raises:
            SidecarError: there is none, or more than one, or it is too large.
        """
        clip, endings = context.clip, sidecar_endings((array,))
        found = [ending for ending in endings if clip.sidecars.get(ending) is not None]
        if len(found) != 1:
            why = f"there are {len(found)}: keep one" if found else "is missing: add it beside the video"
            raise SidecarError(context.video, " or ".join(found or endings), why)
        (ending,) = found
        size = int(clip.fingerprints[ending].partition("-")[0])
        if not ending.endswith("/") and size > _LARGEST_FILE_BYTES:
            raise SidecarError(context.video, ending, f"has {size} bytes; the limit is {_LARGEST_FILE_BYTES}")
        opened = clip.sidecars[ending]
        assert opened is not None
        return cls(context.video, ending, clip.fingerprints[ending], clip.picture_px, opened)

    @contextmanager
    def errors(self) -> Iterator[None]:
        """Turn a ValueError, whose text is for people, into a SidecarError."""
        try:
            yield
        except ValueError as error:
            raise SidecarError(self.video, self.ending, str(error)) from error


@lru_cache(maxsize=_KEPT)
def _boxes_of(file: _LabelFile) -> BoxTable:
    return READERS[file.ending](file.opened, file.picture_px)


@makes("boxes")
def boxes(context: SampleContext, out: npt.NDArray[Any]) -> None:
    """Fill in the boxes of each delivered frame, [T, max_boxes, 7], the largest first."""
    file = _LabelFile.of(context, "boxes")
    with file.errors():
        table = _boxes_of(file)
        found = [table.at(frame) for frame in context.target_frames]
    out[...] = -1
    dropped = 0
    for rows, (corners, numbers) in zip(out, found, strict=True):
        seen, share = view_boxes(corners, context.clip.usable, context.params, context.recipe)
        kept = kept_boxes(seen, share)
        dropped += max(0, len(kept) - len(rows))
        kept = kept[: len(rows)]
        rows[: len(kept)] = np.concatenate([seen[kept], numbers[kept], share[kept, None]], axis=1)
    context.boxes_dropped = dropped


@makes("masks")
def masks(context: SampleContext, out: npt.NDArray[Any]) -> None:
    """Fill in the class mask of each delivered frame, [T, 1, H, W]."""
    file = _LabelFile.of(context, "masks")
    with file.errors():
        files = numbered_files(file.opened, ".png")
        view: Callable[[int], npt.NDArray[np.uint8]] = lru_cache(maxsize=1)(lambda frame: _mask(context, files, frame))
        for target, frame in zip(out[:, 0], context.target_frames, strict=True):
            target[...] = view(frame)  # a paused camera repeats its frame


def _mask(context: SampleContext, files: dict[int, Traversable], frame: int) -> npt.NDArray[np.uint8]:
    if frame not in files:
        raise ValueError(f"has no file of frame {frame}: add one")
    mask = read_mask(files[frame], context.clip.picture_px)
    return view_mask(mask, context.clip.usable, context.params, context.recipe)
