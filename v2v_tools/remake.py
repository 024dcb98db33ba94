"""Make any sample of any stream in this process: for `v2v-simulate`, `V2VDataset`, tests and bug reports."""

from __future__ import annotations

from dataclasses import dataclass

from v2v_protocol.errors import CorpusError, SampleUnavailable, UsageError, VideoError, VideoUnreadable
from v2v_protocol.events import EventList
from v2v_protocol.messages import Lease
from v2v_protocol.programs import counted
from v2v_protocol.progress import Progress
from v2v_protocol.sample import DEFAULT_ARRAYS, Refusal, RefusalKind, Sample, SampleId, array_layout
from v2v_protocol.spec import StreamSpec
from v2v_server.broker import assignment
from v2v_server.broker.candidates import next_candidate
from v2v_server.broker.leases import Request
from v2v_server.corpus.catalogue import Catalogue, complete_lease, open_catalogue
from v2v_server.kinds.kind import VideosKind
from v2v_server.quarantine import Quarantine
from v2v_server.schedule import MOST_CANDIDATES, Schedule, SequenceTable, VideoSequence
from v2v_server.system.process import usable_cores
from v2v_server.video.rows import Rows
from v2v_server.worker.job import SampleJob
from v2v_server.worker.making.make import list_sample_events, make_sample
from v2v_server.worker.making.read import Decoded, decode_for, open_sidecars


@dataclass(frozen=True, slots=True)
class RemadeSample:
    """A sample, its job, and the frames it was made of."""

    job: SampleJob
    decoded: Decoded
    sample: Sample


class Remaker:
    """Make samples of one stream by their names: the same bytes a server streams.

    Args:
        catalogue: the corpus.
        spec: the stream's spec.
        arrays: which arrays to make.
        quarantine, snapshot: the quarantine and the snapshot to make them under; the empty one by default.

    Attributes:
        catalogue, spec: as given.
        count: samples of an epoch.

    Raises:
        UsageError: unknown arrays.
        CorpusError: no video gives a sequence.
    """

    def __init__(
        self,
        catalogue: Catalogue,
        spec: StreamSpec,
        arrays: tuple[str, ...] = DEFAULT_ARRAYS,
        quarantine: Quarantine | None = None,
        snapshot: int = 0,
    ) -> None:
        array_layout(spec.recipe, spec.voxel_dtype, arrays)
        catalogue.facts.require_arrays(arrays)
        self.catalogue, self.spec, self._arrays = catalogue, spec, arrays
        self._quarantine, self._snapshot = quarantine or Quarantine(), snapshot
        table = SequenceTable(catalogue.videos, catalogue.rows, spec)
        if not table.count:
            raise CorpusError(f"no video gives a sequence: {'; '.join(map(str, table.refusals[:3]))}")
        self._schedule = Schedule(table, spec)
        self.count = self._schedule.count

    def job(self, seed: int, epoch: int, index: int) -> SampleJob:
        """Return the job of the sample of this name, from the video that it is made of if that can be read.

        Raises:
            IndexUnreadable, V2VError: see :func:`lease_for`.
        """
        return self._job(seed, Request(b"", epoch, index), self._schedule.candidate(seed, epoch, index, 0))

    def _job(self, seed: int, request: Request, sequence: VideoSequence) -> SampleJob:
        return SampleJob.of(
            lease_for(
                request, sequence=sequence, catalogue=self.catalogue, spec=self.spec, seed=seed, arrays=self._arrays
            )
        )

    def sample(self, seed: int, epoch: int, index: int) -> Sample:
        """Make the sample of this name, candidates and refusals included: see :meth:`made`."""
        return self.made(seed, epoch, index).sample

    def events(self, seed: int, epoch: int, index: int) -> EventList:
        """List the events of a sample with the times of their crossings. Errors: :meth:`made`."""
        remade = self.made(seed, epoch, index)
        return list_sample_events(remade.job.clip, remade.decoded)

    def made(self, seed: int, epoch: int, index: int) -> RemadeSample:
        """Make the sample of this name, and return what it was made of too.

        Raises:
            UsageError: an index outside the epoch.
            SampleUnavailable: no candidate could give the sample.
            SidecarError: a file beside the video, which an array is made from, cannot be used.
            VideoUnreadable: this host cannot read a candidate's file, which a server may have read.
        """
        catalogue, spec = self.catalogue, self.spec
        SampleId(spec.digest, catalogue.facts.digest_under(spec.scene), 0, seed, epoch, index)
        if index >= self.count:
            raise UsageError(f"index {index}: the epoch has {counted(self.count, 'sample')}, 0 .. {self.count - 1}")
        request = Request(b"", epoch, index, snapshot=self._snapshot)
        most = MOST_CANDIDATES if spec.on_bad_video == "substitute" else 1
        while request.candidate < most:
            sequence = self._schedule.candidate(seed, epoch, index, request.candidate)
            video = sequence.video
            condemned = self._quarantine.refusal(
                self._snapshot, video.id, video.fingerprint, sequence.start_frame, spec.digest
            )
            if condemned is not None:
                request = next_candidate(request, Refusal(video.id, None, condemned, RefusalKind.QUARANTINED))
                continue
            job = self._job(seed, request, sequence)
            try:
                decoded = decode_for(job.clip, (index,), catalogue.source)[0]
                with open_sidecars(job.clip, catalogue.source) as sidecars:
                    return RemadeSample(job, decoded, make_sample(job, decoded, sidecars=sidecars))
            except VideoError as error:
                if isinstance(error, VideoUnreadable) and not _is_left_out(catalogue, video.id):
                    raise
                request = next_candidate(request, Refusal(video.id, error.frame, error.reason))
        refusals = "; ".join(dict.fromkeys(map(str, request.refusals)))
        raise SampleUnavailable("unavailable", f"sample {index} of epoch {epoch}: {refusals}")


def open_shown(
    source: str, *, list_file: str | None, rows: str, cache_dir: str | None, kind: VideosKind, scene: bool = False
) -> Catalogue:
    """Call :func:`open_catalogue` on all cores, with progress on stderr."""
    with Progress("probing videos") as progress:
        return open_catalogue(
            source, list_file=list_file, rows=Rows.parse(rows), scene=scene, cache_dir=cache_dir, kind=kind,
            processes=usable_cores(), progress=progress, notice=progress.notice,
        )  # fmt: skip


def open_remaker(
    source: str,
    *,
    rows: str,
    list_file: str | None,
    cache_dir: str | None,
    kind: VideosKind,
    spec: StreamSpec,
    arrays: tuple[str, ...],
) -> Remaker:
    """Open a corpus and return its remaker. Errors: :func:`open_catalogue` and :class:`Remaker`."""
    scene = spec.scene != "off"
    catalogue = open_shown(source, list_file=list_file, rows=rows, scene=scene, cache_dir=cache_dir, kind=kind)
    return Remaker(catalogue, spec, arrays)


def remake(
    catalogue: Catalogue,
    spec: StreamSpec,
    *,
    seed: int,
    epoch: int,
    index: int,
    arrays: tuple[str, ...] = DEFAULT_ARRAYS,
    quarantine: Quarantine | None = None,
    snapshot: int = 0,
) -> Sample:
    """Make one sample. Arguments and errors: see :class:`Remaker`."""
    return Remaker(catalogue, spec, arrays, quarantine, snapshot).sample(seed, epoch, index)


def _is_left_out(catalogue: Catalogue, video: str) -> bool:
    """Return whether the video could not be prepared, so that a prepared folder has no file for it."""
    return catalogue.prepared is not None and not catalogue.path(video).exists()


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
    """Build the lease that a server sends for a request; see :func:`v2v_server.broker.assignment.lease_for`.

    Raises:
        IndexUnreadable, V2VError: as of :func:`v2v_server.corpus.catalogue.complete_lease`.
    """
    lease = assignment.lease_for(
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
