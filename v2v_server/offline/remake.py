"""Any sample of any stream, made in this process: what `v2v-simulate` does, and how a test or a bug report remakes a
sample that a trainer saw."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from v2v_pictures.camera import Camera, check_drawable
from v2v_pictures.files import write_png
from v2v_pictures.sheet import draw_sheet
from v2v_protocol.errors import CorpusError, SampleUnavailable, UsageError, VideoError, VideoUnreadable
from v2v_protocol.refusal import Refusal, RefusalKind
from v2v_protocol.sample import DEFAULT_ARRAYS, Sample, SampleId, array_layout
from v2v_protocol.spec import StreamSpec
from v2v_server.broker.candidates import next_candidate
from v2v_server.broker.leases import Request
from v2v_server.broker.quarantine import Quarantine, quarantine_path, read_quarantine
from v2v_server.broker.terms import lease_for
from v2v_server.catalogue.catalogue import Catalogue, open_catalogue
from v2v_server.console.progress import catalogue_progress
from v2v_server.offline.event_files import check_event_file, write_events
from v2v_server.schedule.epoch import MOST_CANDIDATES, Schedule
from v2v_server.schedule.sequences import SequenceTable
from v2v_server.system.process import usable_cores
from v2v_server.video.rows import Rows
from v2v_server.worker.produce import decode_for, make_sample

_MOMENTS = 4
"""Voxel grids that a picture shows."""


class Remaker:
    """Makes samples of one stream, each by its name: the same bytes a server streams.

    Args:
        catalogue: the corpus.
        spec: the stream's spec.
        arrays: which arrays to make.
        quarantine, snapshot: the quarantine and the snapshot to make them under; the empty one by default.

    Attributes:
        count: samples of an epoch.

    Raises:
        UsageError: arrays nobody makes.
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
        self._catalogue, self._spec, self._arrays = catalogue, spec, arrays
        self._quarantine, self._snapshot = quarantine or Quarantine(), snapshot
        table = SequenceTable(catalogue.videos, catalogue.rows, spec)
        if not table.count:
            raise CorpusError(f"no video gives a sequence: {'; '.join(map(str, table.refusals[:3]))}")
        self._schedule = Schedule.of(table, spec)
        self.count = self._schedule.count

    def sample(self, seed: int, epoch: int, index: int) -> Sample:
        """The sample of this name, candidates and refusals included.

        Raises:
            UsageError: an index outside the epoch.
            SampleUnavailable: no candidate could give the sample.
            VideoUnreadable: this host cannot read a candidate's file, whatever a server made of it.
        """
        catalogue, spec = self._catalogue, self._spec
        SampleId(spec.digest, catalogue.digest_under(spec.scene), 0, seed, epoch, index)
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
                return make_sample(lease, decode_for(lease, lease.indices, catalogue.root)[0])
            except VideoError as error:
                if isinstance(error, VideoUnreadable) and not _is_left_out(catalogue, lease.video):
                    raise
                request = next_candidate(request, Refusal(lease.video, error.frame, error.reason))
        refusals = "; ".join(dict.fromkeys(map(str, request.refusals)))
        raise SampleUnavailable("unavailable", f"sample {index} of epoch {epoch}: {refusals}")


def open_shown(
    source: str, *, list_file: str | None, rows: str, cache_dir: str | None, scene: bool = False
) -> Catalogue:
    """:func:`open_catalogue` for somebody who waits: on all cores, and how far it is on stderr."""
    with catalogue_progress() as progress:
        return open_catalogue(
            source, list_file=list_file, rows=Rows.parse(rows), scene=scene, cache_dir=cache_dir,
            processes=usable_cores(), progress=progress, notice=progress.notice,
        )  # fmt: skip


def open_remaker(
    source: str,
    *,
    rows: str,
    list_file: str | None,
    cache_dir: str | None,
    spec: StreamSpec,
    arrays: tuple[str, ...],
) -> Remaker:
    """From what a user names; errors as of :func:`open_catalogue` and :class:`Remaker`."""
    scene = spec.scene != "off"
    catalogue = open_shown(source, list_file=list_file, rows=rows, scene=scene, cache_dir=cache_dir)
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
    """One sample of an identity. Arguments and errors: see :class:`Remaker`."""
    return Remaker(catalogue, spec, arrays, quarantine, snapshot).sample(seed, epoch, index)


def _is_left_out(catalogue: Catalogue, video: str) -> bool:
    """Whether a prepared folder only keeps the video's place, because it could not be prepared: no server has it."""
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
    events: Path | None = None,
) -> None:
    """Makes one sample and writes it as .npz: the asked arrays and ``provenance``, a JSON text.

    Args:
        source, list_file, rows: the corpus, as for a server.
        out: the .npz file; a name that does not end so gets it added.
        picture: a .png file to draw it into, or None.
        spec: fields of the StreamSpec; None in any takes the default.
        arrays, seed, epoch, index: see :func:`remake`.
        snapshot: number of the quarantine snapshot to make it under.
        cache_dir: folder of the catalogue index and the quarantine; None: the user's cache.
        events: a file for events made of the voxels (``event_files.py``), or None. Their clock is the video's average
            rate.

    Raises:
        UsageError, CorpusError, SampleUnavailable, VideoUnreadable: see :func:`remake`; or a file cannot be written, or
            there is no such snapshot.
    """
    stream = StreamSpec.from_dict(spec)
    if picture is not None:
        check_drawable(arrays)
    if events is not None:
        check_event_file(events)
        if "voxels" not in arrays:
            raise UsageError("--events needs the array voxels")
    scene = stream.scene != "off"
    catalogue = open_shown(source, list_file=list_file, rows=rows, scene=scene, cache_dir=cache_dir)
    quarantine = read_quarantine(quarantine_path(catalogue.root, cache_dir)) if snapshot else Quarantine()
    quarantine.entries(snapshot)  # before any work: whether there is such a snapshot
    for refusal in catalogue.refusals:
        print(f"cannot be used: {refusal}")
    sample = remake(
        catalogue,
        stream,
        seed=seed,
        epoch=epoch,
        index=index,
        arrays=arrays,
        quarantine=quarantine,
        snapshot=snapshot,
    )
    if not out.name.endswith(".npz"):
        out = Path(f"{out}.npz")  # as numpy would, which does not say so
    provenance = sample.provenance.to_dict()
    content: Mapping[str, Any] = {**sample.arrays, "provenance": json.dumps(provenance)}
    try:
        np.savez_compressed(out, **content)
        if picture is not None:
            camera = Camera.of(sample.arrays, sample.provenance, f"index {index}", stream.recipe.frames_per_bin)
            write_png(picture, draw_sheet([camera], f"seed {seed}, epoch {epoch}", moments=_MOMENTS))
        if events is not None:
            made = sample.to_events(_bin_us(catalogue, sample, stream))
            write_events(events, made)
            print(f"{len(made)} events written to {events}; their times within a bin are invented")
    except OSError as error:
        raise UsageError(f"{error.filename or out}: {error.strerror}") from error
    params = sample.provenance.params
    print(
        f"{sample.provenance.video} from frame {sample.provenance.start_frame}: "
        + ", ".join(f"{name} {array.dtype}{list(array.shape)}" for name, array in sample.arrays.items())
        + f"; thresholds +{params.threshold_pos:.3f} -{params.threshold_neg:.3f}, noise {params.noise_sigma:.3f}, "
        f"{params.hot_pixel_count} hot pixels, {sample.provenance.saturated_bins} bins saturated; written to {out}"
    )


def _bin_us(catalogue: Catalogue, sample: Sample, spec: StreamSpec) -> float:
    (video,) = (video for video in catalogue.videos if video.id == sample.provenance.video)
    if not video.frames_per_second > 0:
        raise UsageError(f"{video.id}: its frame rate is unknown, and events need times")
    return 1e6 * spec.recipe.frames_per_bin * spec.recipe.frame_stride / video.frames_per_second
