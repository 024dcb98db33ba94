"""Leases without a server."""

from __future__ import annotations

from v2v_protocol.messages import Lease
from v2v_protocol.spec import StreamSpec
from v2v_server.broker import grants
from v2v_server.broker.leases import Request
from v2v_server.corpus.catalogue import Catalogue, complete_lease
from v2v_server.schedule.sequences import VideoSequence


def lease_for(
    request: Request,
    *,
    sequence: VideoSequence,
    catalogue: Catalogue,
    spec: StreamSpec,
    seed: int,
    arrays: tuple[str, ...],
    number: int = 1,
    siblings: tuple[int, ...] = (),
) -> Lease:
    """Build the lease that a server sends for a request; see :func:`v2v_server.broker.grants.lease_for`.

    Raises:
        IndexUnreadable, V2VError: as of :func:`v2v_server.corpus.catalogue.complete_lease`.
    """
    lease = grants.lease_for(
        request,
        sequence=sequence,
        facts=catalogue.facts,
        spec=spec,
        seed=seed,
        arrays=arrays,
        number=number,
        siblings=siblings,
    )
    return complete_lease(lease, catalogue, spec)
