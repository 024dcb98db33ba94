"""Any sample of any stream, made in this process: `v2v-simulate`, tests, and bug reports about a trainer's sample."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from v2v_pictures.camera import Camera, check_drawable
from v2v_pictures.files import write_png
from v2v_pictures.sheet import draw_sheet
from v2v_protocol.errors import CorpusError, SampleUnavailable, UsageError, VideoError, VideoUnreadable
from v2v_protocol.events import EventList
from v2v_protocol.messages import Lease
from v2v_protocol.programs import show
from v2v_protocol.progress import Progress
from v2v_protocol.sample import DEFAULT_ARRAYS, Refusal, RefusalKind, Sample, SampleId, array_layout
from v2v_protocol.spec import StreamSpec
from v2v_protocol.write_aside import write_aside_and_rename
from v2v_server.broker import dispatcher
from v2v_server.broker.dispatcher import next_candidate
from v2v_server.broker.leases import Request
from v2v_server.corpus.catalogue import Catalogue, complete_lease, open_catalogue
from v2v_server.quarantine import Quarantine, quarantine_path, read_quarantine
from v2v_server.schedule import MOST_CANDIDATES, Schedule, SequenceTable, VideoSequence
from v2v_server.store.pixels import VIDEOS, VideosKind
from v2v_server.system.process import usable_cores
from v2v_server.video.rows import Rows
from v2v_server.worker.produce import Decoded, decode_for, list_sample_events, make_sample, open_sidecars
from v2v_tools.event_files import check_event_file, write_events

_MOMENTS = 4
"""Voxel grids that a picture shows."""


@dataclass(frozen=True, slots=True)
class RemadeSample:
    """A sample, the lease it was made for, and the frames it was made of."""

    lease: Lease
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
        self._catalogue, self._spec, self._arrays = catalogue, spec, arrays
        self._quarantine, self._snapshot = quarantine or Quarantine(), snapshot
        table = SequenceTable(catalogue.videos, catalogue.rows, spec)
        if not table.count:
            raise CorpusError(f"no video gives a sequence: {'; '.join(map(str, table.refusals[:3]))}")
        self._schedule = Schedule(table, spec)
        self.count = self._schedule.count

    def sequence(self, seed: int, epoch: int, index: int) -> VideoSequence:
        """Return the sequence that the sample of this name is made from if it can be read."""
        return self._schedule.candidate(seed, epoch, index, 0)

    def sample(self, seed: int, epoch: int, index: int) -> Sample:
        """Make the sample of this name, candidates and refusals included: see :meth:`made`."""
        return self.made(seed, epoch, index).sample

    def events(self, seed: int, epoch: int, index: int) -> EventList:
        """List the events of a sample with the times of their crossings. Errors: :meth:`made`."""
        remade = self.made(seed, epoch, index)
        return list_sample_events(remade.lease, remade.decoded)

    def made(self, seed: int, epoch: int, index: int) -> RemadeSample:
        """Make the sample of this name, and return what it was made of too.

        Raises:
            UsageError: an index outside the epoch.
            SampleUnavailable: no candidate could give the sample.
            SidecarError: a file beside the video, which an array is made from, cannot be used.
            VideoUnreadable: this host cannot read a candidate's file, which a server may have read.
        """
        catalogue, spec = self._catalogue, self._spec
        SampleId(spec.digest, catalogue.facts.digest_under(spec.scene), 0, seed, epoch, index)
        if index >= self.count:
            raise UsageError(f"index {index}: the epoch has {self.count} samples, 0 .. {self.count - 1}")
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
            lease = lease_for(
                request, sequence=sequence, catalogue=catalogue, spec=spec, seed=seed, arrays=self._arrays
            )
            try:
                decoded = decode_for(lease, lease.indices, catalogue.source)[0]
                with open_sidecars(lease, catalogue.source) as sidecars:
                    return RemadeSample(lease, decoded, make_sample(lease, decoded, sidecars=sidecars))
            except VideoError as error:
                if isinstance(error, VideoUnreadable) and not _is_left_out(catalogue, lease.video):
                    raise
                request = next_candidate(request, Refusal(lease.video, error.frame, error.reason))
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


def simulate_to_file(
    source: str,
    *,
    out: Path,
    picture: Path | None,
    list_file: str | None,
    rows: str,
    spec: Mapping[str, Any],
    arrays: tuple[str, ...],
    seed: int,
    epoch: int,
    index: int,
    snapshot: int = 0,
    cache_dir: str | None = None,
    kind: VideosKind = VIDEOS,
    events: Path | None = None,
) -> None:
    """Make one sample and write it as .npz: the requested arrays and ``provenance``, a JSON text.

    Args:
        source, list_file, rows: the corpus, as for a server.
        out: the .npz file.
        picture: a .png file for a picture of the sample, or None.
        spec: fields of the StreamSpec; None in any takes the default.
        arrays, seed, epoch, index: see :func:`remake`.
        snapshot: number of the quarantine snapshot to make it under.
        cache_dir: folder of the catalogue index and the quarantine; None: the user's cache.
        kind: what a video is.
        events: a file for the sample's events (``event_files.py``), or None. Their clock is that of the video's frames.

    Raises:
        UsageError, CorpusError, SampleUnavailable, VideoUnreadable: see :func:`remake`; or a file cannot be written, or
            there is no such snapshot.
    """
    stream = StreamSpec.from_dict(spec)
    if picture is not None:
        check_drawable(arrays)
    if events is not None:
        check_event_file(events)
    scene = stream.scene != "off"
    catalogue = open_shown(source, list_file=list_file, rows=rows, scene=scene, cache_dir=cache_dir, kind=kind)
    quarantine = read_quarantine(quarantine_path(catalogue.source.name, cache_dir)) if snapshot else Quarantine()
    quarantine.entries(snapshot)  # before any work: whether there is such a snapshot
    for refusal in catalogue.refusals:
        show(f"cannot be used: {refusal}")
    remade = Remaker(catalogue, stream, arrays, quarantine, snapshot).made(seed, epoch, index)
    sample = remade.sample
    provenance = sample.provenance.to_dict()
    content: Mapping[str, Any] = {**sample.arrays, "provenance": json.dumps(provenance)}
    try:
        with write_aside_and_rename(out) as partial, partial.open("wb") as file:
            np.savez_compressed(file, **content)
        if picture is not None:
            camera = Camera.of(sample.arrays, sample.provenance, f"index {index}", stream.recipe)
            write_png(picture, draw_sheet([camera], f"seed {seed}, epoch {epoch}", moments=_MOMENTS))
        if events is not None:
            made = list_sample_events(remade.lease, remade.decoded)
            write_events(events, made)
            show(f"{len(made)} events written to {events}")
    except OSError as error:
        raise UsageError(f"{error.filename or out}: {error.strerror}") from error
    for name, why in sample.provenance.unlabelled.items():
        show(f"no {name}: {why}")
    params = sample.provenance.params
    show(
        f"{sample.provenance.video} from frame {sample.provenance.start_frame}: "
        + ", ".join(f"{name} {array.dtype}{list(array.shape)}" for name, array in sample.arrays.items())
        + f"; thresholds +{params.threshold_pos:.3f} -{params.threshold_neg:.3f}, noise {params.noise_sigma:.3f}, "
        f"{params.hot_pixel_count} hot pixels, {sample.provenance.saturated_bins} bins saturated; written to {out}"
    )


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
    """Build the lease that a server sends for a request; see :func:`v2v_server.broker.dispatcher.lease_for`.

    Raises:
        IndexUnreadable, V2VError: as of :func:`v2v_server.corpus.catalogue.complete_lease`.
    """
    lease = dispatcher.lease_for(
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
