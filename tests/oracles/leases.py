"""Leases as a server grants them, and the samples that a worker makes of them."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from v2v_protocol.errors import CorpusError
from v2v_protocol.messages import Lease
from v2v_protocol.sample import DEFAULT_ARRAYS, Sample
from v2v_protocol.spec import StreamSpec
from v2v_server.broker.leases import Request
from v2v_server.corpus.catalogue import open_catalogue
from v2v_server.corpus.sources.folder import Folder
from v2v_server.schedule import Schedule, SequenceTable
from v2v_server.store.cache import Cache
from v2v_server.video.rows import Rows
from v2v_server.worker.job import SampleJob
from v2v_server.worker.making.make import make_sample
from v2v_server.worker.making.read import decode_for
from v2v_tools.remake import lease_for


@contextmanager
def open_leases(videos: Path, rows: str, spec: StreamSpec) -> Iterator[tuple[Path, Iterator[Lease]]]:
    """Yield the endless leases of seed 0, one sample each; each names the siblings still to come.

    Yields:
        the folder that the leases' videos are relative to, and the leases; valid inside the block.

    Raises:
        CorpusError: no video gives a sequence.
    """
    catalogue = open_catalogue(videos, rows=Rows.parse(rows), processes=0)
    try:
        table = SequenceTable(catalogue.videos, catalogue.rows, spec)
        if not table.count:
            raise CorpusError(f"--videos {videos}: no video gives a sequence of {spec.recipe.frames_needed} frames")
        schedule = Schedule(table, spec)
        spacing = max(1, spec.sibling_spacing)

        def leases() -> Iterator[Lease]:
            for number in itertools.count():
                epoch, index = divmod(number, schedule.count)
                view = index // spacing % spec.samples_per_decode
                siblings = tuple(index + spacing * more for more in range(1, spec.samples_per_decode - view))
                yield lease_for(
                    Request(b"", epoch, index), sequence=schedule.candidate(0, epoch, index, 0), catalogue=catalogue,
                    spec=spec, seed=0, arrays=DEFAULT_ARRAYS, siblings=siblings,
                )  # fmt: skip

        yield catalogue.folder, leases()
    finally:
        catalogue.close()


def whole_sample(lease: Lease, root: Path, cache: Cache | None = None) -> Sample:
    """Make the sample of a lease as a server worker does: decode, or read from a cache; view, simulate."""
    job = SampleJob.of(lease)
    (decoded,) = decode_for(job.clip, lease.indices, Folder(root), cache)
    return make_sample(job, decoded)
