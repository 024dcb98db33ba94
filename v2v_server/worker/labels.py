"""Fill boxes and masks from the files beside the video."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import lru_cache
from importlib.resources.abc import Traversable
from typing import Any

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import SidecarError
from v2v_protocol.messages import Lease
from v2v_protocol.sample import sidecar_endings
from v2v_server.labels.boxes import BoxTable
from v2v_server.labels.formats import READERS, numbered_files
from v2v_server.labels.masks import read_mask
from v2v_server.labels.views import kept_boxes, view_boxes, view_mask
from v2v_server.worker.arrays import SampleContext, makes
from v2v_server.worker.sidecars import sidecar_files

_KEPT = 4
"""Sidecars that stay in memory once they are read: siblings use them one after the other."""


def _only_sidecar(array: str, video: str, sidecars: Mapping[str, Traversable | None]) -> tuple[str, Any]:
    """Return the one sidecar that the array is made from, and its ending.

    Raises:
        SidecarError: there is none, or more than one.
    """
    endings = sidecar_endings((array,))
    found = [(ending, opened) for ending in endings if (opened := sidecars.get(ending)) is not None]
    if len(found) != 1:
        why = f"there are {len(found)}: keep one" if found else "is missing: add it beside the video"
        raise SidecarError(video, " or ".join(ending for ending, _ in found) or " or ".join(endings), why)
    return found[0]


@lru_cache(maxsize=_KEPT)
def _boxes_of(ending: str, fingerprint: str, picture_px: tuple[int, int], opened: Any) -> BoxTable:
    """Read boxes. Equal fingerprints mean equal files; of a folder each clip has a part, which equals itself only."""
    return READERS[ending](opened, picture_px)


def read_ahead(lease: Lease, sidecars: Mapping[str, Traversable | None]) -> None:
    """Read the boxes of a lease, so that they are at hand when its sample is made. Errors come again then."""
    if "boxes" in lease.arrays:
        with suppress(Exception):
            ending, opened = _only_sidecar("boxes", lease.video, sidecars)
            _boxes_of(ending, sidecar_files(lease)[ending][1], (lease.height_px, lease.width_px), opened)


@makes("boxes")
def boxes(context: SampleContext, out: npt.NDArray[Any]) -> None:
    """Fill in the boxes of each delivered frame, [T, max_boxes, 7], the largest first."""
    clip = context.clip
    ending, opened = _only_sidecar("boxes", context.video, clip.sidecars)
    table = _boxes_of(ending, clip.fingerprints[ending], clip.picture_px, opened)
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
    files = numbered_files(_only_sidecar("masks", context.video, context.clip.sidecars)[1], ".png")
    view: Callable[[int], npt.NDArray[np.uint8]] = lru_cache(maxsize=1)(lambda frame: _mask(context, files, frame))
    for target, frame in zip(out[:, 0], context.target_frames, strict=True):
        target[...] = view(frame)  # a paused camera repeats its frame


def _mask(context: SampleContext, files: dict[int, Traversable], frame: int) -> npt.NDArray[np.uint8]:
    if frame not in files:
        raise ValueError(f"has no file of frame {frame}: add one")
    mask = read_mask(files[frame], context.clip.picture_px)
    return view_mask(mask, context.clip.usable, context.params, context.recipe)
