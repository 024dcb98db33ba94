"""The sidecars that a lease's arrays are made from, and the boxes and masks made from them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from functools import lru_cache
from importlib.resources.abc import Traversable
from types import MappingProxyType
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import ProtocolError, SidecarError, V2VError, VideoChanged, VideoError, VideoUnreadable
from v2v_protocol.messages import Lease
from v2v_protocol.sample import sidecar_endings
from v2v_server.corpus.sources.sidecar import open_sidecar, sidecar_id
from v2v_server.corpus.sources.source import VideoSource
from v2v_server.labels.formats import READERS, BoxTable, numbered_files, read_mask
from v2v_server.labels.views import kept_boxes, view_boxes, view_mask
from v2v_server.worker.arrays import SampleContext, fill_rows, makes

_KEPT = 4
"""Sidecars that stay in memory once they are read: siblings use them one after the other."""


_LONGEST_REASON = 500


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

    def seen(frame: int) -> npt.NDArray[np.float64]:
        corners, numbers = table.at(frame)
        inside, share = view_boxes(corners, clip.usable, context.params, context.recipe)
        kept = kept_boxes(inside, share)
        return np.concatenate([inside[kept], numbers[kept], share[kept, None]], axis=1)

    fill_rows(context, "boxes", out, map(seen, context.target_frames))


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


def sidecar_files(lease: Lease) -> dict[str, tuple[str, str]]:
    """Return id and fingerprint of each sidecar that a lease's arrays are made from and that can be used, by ending.

    Raises:
        ProtocolError: the lease is malformed.
    """
    stated = {ending: _stated(lease, ending) for ending in sidecar_endings(lease.arrays)}
    return {
        ending: (sidecar_id(lease.video, ending), fingerprint)
        for ending, (fingerprint, part) in stated.items()
        if fingerprint and not isinstance(part, str)
    }


def refused_sidecars(lease: Lease) -> dict[str, str]:
    """Return, by ending, why the catalogue does not use a sidecar that a lease's arrays are made from."""
    parts = {ending: _stated(lease, ending)[1] for ending in sidecar_endings(lease.arrays)}
    return {ending: part for ending, part in parts.items() if isinstance(part, str)}


def _stated(lease: Lease, ending: str) -> tuple[str, bytes | str]:
    """Return fingerprint and part of a sidecar, see ``Lease.sidecars``."""
    stated = lease.sidecars.get(ending, "")
    fingerprint, part = stated if isinstance(stated, list) and len(stated) == 2 else (stated, b"")
    if not isinstance(fingerprint, str) or not isinstance(part, bytes | str):
        raise ProtocolError(f"lease {lease.lease}: fingerprint {stated!r:.80} of the sidecar {ending}")
    return fingerprint, part


@contextmanager
def open_sidecars(lease: Lease, source: VideoSource) -> Iterator[dict[str, Traversable | None]]:
    """Lend the sidecars that a lease's arrays are made from, by ending, until the end of the context.

    Raises:
        SidecarError: one cannot be read, or differs from the catalogue.
        ProtocolError: the lease is malformed.
    """
    opened: dict[str, Traversable | None] = dict.fromkeys(sidecar_endings(lease.arrays))
    with ExitStack() as stack:
        for ending, (id, fingerprint) in sidecar_files(lease).items():
            try:
                table = cast(bytes, _stated(lease, ending)[1])
                opened[ending] = stack.enter_context(open_sidecar(source, id, fingerprint, table))
            except VideoError as error:
                here = isinstance(error, VideoChanged | VideoUnreadable)
                raise SidecarError(lease.video, ending, error.reason, here) from error
            except MemoryError as error:
                raise SidecarError(lease.video, ending, "reading it takes too much memory") from error
        yield opened


@contextmanager
def errors_of_sidecar(
    video: str,
    array: str,
    sidecars: Mapping[str, Traversable | None],
    refused: Mapping[str, str] = MappingProxyType({}),
) -> Iterator[None]:
    """Turn any error while an array is made from a sidecar into a SidecarError: a malformed file must end no worker.

    Args:
        video: catalogue id.
        array: name of the array.
        sidecars: what :func:`open_sidecars` lends.
        refused: see :func:`refused_sidecars`.

    Raises:
        SidecarError: the array cannot be made from its sidecar.
    """
    endings = sidecar_endings((array,))
    if problems := [refused[ending] for ending in endings if ending in refused]:
        there = [ending for ending in endings if ending in refused or sidecars.get(ending) is not None]
        why = problems[0] if len(there) == 1 else f"there are {len(there)}: keep one"
        raise SidecarError(video, " or ".join(there), why)
    try:
        yield
    except V2VError:
        raise
    except Exception as error:
        for ending in endings:
            if sidecars.get(ending) is not None:
                plain = "" if isinstance(error, ValueError) else f"{type(error).__name__}: "
                reason = f"{plain}{error}"[:_LONGEST_REASON]
                # A read error is this host's; any other repeats wherever the sidecar is read.
                here = isinstance(error, OSError) and not isinstance(error, FileNotFoundError)
                raise SidecarError(video, ending, reason, here) from error
        raise
