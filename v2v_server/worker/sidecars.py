"""The sidecars that a lease's arrays are made from."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from importlib.resources.abc import Traversable
from types import MappingProxyType
from typing import cast

from v2v_protocol.errors import ProtocolError, SidecarError, V2VError, VideoChanged, VideoError, VideoUnreadable
from v2v_protocol.messages import Lease
from v2v_protocol.sample import sidecar_endings
from v2v_server.corpus.sources.sidecar import open_sidecar, sidecar_id
from v2v_server.corpus.sources.source import VideoSource

_LONGEST_REASON = 500


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
