"""The sidecars that a lease's arrays are made from."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from importlib.resources.abc import Traversable

from v2v_protocol.errors import ProtocolError, SidecarError, V2VError, VideoError
from v2v_protocol.messages import Lease
from v2v_protocol.sample import sidecar_endings
from v2v_server.corpus.sources.sidecar import open_sidecar, sidecar_id
from v2v_server.corpus.sources.source import VideoSource

_LONGEST_REASON = 500


def sidecar_files(lease: Lease) -> dict[str, tuple[str, str]]:
    """Return id and fingerprint of each sidecar that a lease's arrays are made from and that the video has, by ending.

    Raises:
        ProtocolError: the lease is malformed.
    """
    found = {}
    for ending in sidecar_endings(lease.arrays):
        fingerprint = lease.sidecars.get(ending)
        if fingerprint is not None and not isinstance(fingerprint, str):
            raise ProtocolError(f"lease {lease.lease}: fingerprint {fingerprint!r:.80} of the sidecar {ending}")
        if fingerprint:
            found[ending] = sidecar_id(lease.video, ending), fingerprint
    return found


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
                opened[ending] = stack.enter_context(open_sidecar(source, id, fingerprint))
            except VideoError as error:
                raise SidecarError(lease.video, ending, error.reason, here=True) from error
        yield opened


@contextmanager
def errors_of_sidecar(video: str, array: str, sidecars: Mapping[str, Traversable | None]) -> Iterator[None]:
    """Turn any error while an array is made from a sidecar into a SidecarError: a malformed file must end no worker.

    Args:
        video: catalogue id.
        array: name of the array.
        sidecars: what :func:`open_sidecars` lends.

    Raises:
        SidecarError: the array cannot be made from its sidecar.
    """
    try:
        yield
    except (V2VError, MemoryError):
        raise
    except Exception as error:
        for ending in sidecar_endings((array,)):
            if sidecars.get(ending) is not None:
                reason = f"{type(error).__name__}: {error}"[:_LONGEST_REASON]
                # A read error is this host's; any other repeats wherever the sidecar is read.
                here = isinstance(error, OSError) and not isinstance(error, FileNotFoundError)
                raise SidecarError(video, ending, reason, here) from error
        raise
