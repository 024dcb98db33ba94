"""Boxes beside the video, as the camera sees them."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from functools import lru_cache
from importlib.resources.abc import Traversable
from typing import Any

import numpy as np
import numpy.typing as npt

from v2v_server.labels import READERS, BoxTable, kept_boxes, view_boxes
from v2v_server.worker.arrays.context import SampleContext, fill_rows, makes, only_sidecar
from v2v_server.worker.job import ClipJob

_KEPT = 4
"""Tables that stay in memory once they are read: siblings use them one after the other."""


@lru_cache(maxsize=_KEPT)
def _table(ending: str, fingerprint: str, picture_px: tuple[int, int], opened: Any) -> BoxTable:
    """Read boxes. Equal fingerprints mean equal files; of a folder each clip has a part, which equals itself only."""
    return READERS[ending](opened, picture_px)


def read_ahead(clip: ClipJob, sidecars: Mapping[str, Traversable | None]) -> None:
    """Read the boxes of a clip, if it has them and they are asked for, so that they are at hand when its sample is
    made. Errors come again then.

    Args:
        clip: whose boxes they are.
        sidecars: its opened sidecars, by ending.
    """
    with suppress(Exception):
        ending, opened = only_sidecar("boxes", clip.video, sidecars)
        _table(ending, clip.sidecars[ending].fingerprint, (clip.height_px, clip.width_px), opened)


@makes("boxes")
def boxes(context: SampleContext, out: npt.NDArray[Any]) -> int:
    """Fill in the boxes of each delivered frame, [T, max_boxes, 7], the largest first."""
    clip = context.clip
    ending, opened = only_sidecar("boxes", context.video, clip.sidecars)
    table = _table(ending, clip.fingerprints[ending], clip.picture_px, opened)

    def seen(frame: int) -> npt.NDArray[np.float64]:
        corners, numbers = table.at(frame)
        inside, share = view_boxes(corners, clip.usable, context.params, context.recipe)
        kept = kept_boxes(inside, share)
        return np.concatenate([inside[kept], numbers[kept], share[kept, None]], axis=1)

    return fill_rows("boxes", out, map(seen, context.target_frames))
