"""What a worker makes: jobs, read from a lease at the worker's edge. Nothing behind them knows the wire.

A sample that is decoded beside others is made from the clip job of the first lease, and says in its provenance what its
own lease says. Siblings have equal clip jobs, whatever else their leases say.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import PurePosixPath
from typing import NamedTuple

from v2v_protocol.errors import ProtocolError, UsageError, VideoError
from v2v_protocol.messages import Lease
from v2v_protocol.persisted import parse_json
from v2v_protocol.sample import Layout, Refusal, array_layout, sidecar_endings
from v2v_protocol.spec import StreamSpec
from v2v_server.corpus.scenes.scene import Scene
from v2v_server.video.frame_index import FrameIndex
from v2v_server.video.rows import Rows


class Sidecar(NamedTuple):
    """A sidecar that the catalogue lets be used.

    Attributes:
        fingerprint: as catalogued.
        table: the files of a folder that the clip needs, see :func:`v2v_server.corpus.sources.sidecars.open_sidecar`.
    """

    fingerprint: str
    table: bytes


@dataclass(frozen=True)
class ClipJob:
    """What is decoded of a video, and what its samples are drawn and made by. Jobs of equal clips are equal.

    The index and the scene are read when a sample is made: if they are damaged, its lease fails, and no worker ends.

    Attributes:
        spec, seed, epoch: of the stream; they and its index name a sample.
        arrays: names of the arrays to make.
        video: catalogue id; the file lies below the root of the source.
        fingerprint: expected fingerprint of the file.
        state: state of the file when it was catalogued, see ``VideoSource.expected``; empty if unknown.
        rows: usable rows of the picture.
        width_px, height_px: of the upright picture, before rows.
        frames_per_second: average rate; 0 if unknown.
        thresholds: (positive, negative) that the corpus states for the video; None if it states none.
        start_frame: first frame of the sequence.
        index_bytes: ``FrameIndex.to_bytes()`` of at least the needed part of the file.
        scene_bytes: ``Scene.to_bytes()`` of the needed part; empty if the spec does not use scenes.
        sidecars: those that the arrays are made from, by ending; one that is missing or refused is left out.
        refused_sidecars: reason by ending, for each that the catalogue does not use.

    Raises:
        ProtocolError: the video's id leads out of the corpus folder.
    """

    spec: StreamSpec
    seed: int
    epoch: int
    arrays: tuple[str, ...]
    video: str
    fingerprint: str
    state: tuple[int, ...]
    rows: Rows
    width_px: int
    height_px: int
    frames_per_second: float
    thresholds: tuple[float, float] | None
    start_frame: int
    index_bytes: bytes
    scene_bytes: bytes
    sidecars: Mapping[str, Sidecar]
    refused_sidecars: Mapping[str, str]

    def __post_init__(self) -> None:
        path = PurePosixPath(self.video)
        if path.is_absolute() or ".." in path.parts:
            raise ProtocolError(f"video id {self.video!r} leads out of the corpus folder")

    @classmethod
    def of(cls, lease: Lease) -> ClipJob:
        """Read the clip of a lease.

        Raises:
            ProtocolError, UsageError: the lease is malformed.
        """
        stated = {ending: _stated(lease, ending) for ending in sidecar_endings(lease.arrays)}
        return cls(
            spec=_spec(lease.spec),
            seed=lease.seed,
            epoch=lease.epoch,
            arrays=lease.arrays,
            video=lease.video,
            fingerprint=lease.fingerprint,
            state=lease.notes.state,
            rows=Rows.parse(lease.rows),
            width_px=lease.width_px,
            height_px=lease.height_px,
            frames_per_second=lease.frames_per_second,
            thresholds=(lease.thresholds[0], lease.thresholds[1]) if lease.thresholds else None,
            start_frame=lease.start_frame,
            index_bytes=lease.frame_index,
            scene_bytes=lease.scene,
            sidecars={
                ending: Sidecar(fingerprint, part)
                for ending, (fingerprint, part) in stated.items()
                if fingerprint and isinstance(part, bytes)
            },
            refused_sidecars={ending: part for ending, (_, part) in stated.items() if isinstance(part, str)},
        )

    @property
    def layout(self) -> Layout:
        """Return dtype and shape of each array of a sample.

        Raises:
            UsageError: an unknown array.
        """
        return array_layout(self.spec.recipe, self.spec.voxel_dtype, self.arrays)

    def frame_index(self, count: int, before: int = 0) -> FrameIndex:
        """Decode the index, which has at least ``count`` frames from the start of the sequence on, and ``before`` it.

        Raises:
            VideoError: the index is damaged; its server may not have checked it.
        """
        try:
            index = FrameIndex.from_bytes(self.index_bytes)
            index.position(self.start_frame - before, before + count)
        except (ProtocolError, UsageError) as error:
            raise VideoError(self.video, None, f"its index from the server is damaged: {error}") from error
        return index

    @cached_property
    def scene(self) -> Scene | None:
        """What the sequence shows; None with scene "off".

        Raises:
            VideoError: the scene is damaged.
        """
        try:
            return None if self.spec.scene == "off" else Scene.from_bytes(self.scene_bytes)
        except ProtocolError as error:
            raise VideoError(self.video, None, f"its scene from the server is damaged: {error}") from error


class Stamp(NamedTuple):
    """What the provenance of a sample takes from its own lease. Attributes: :class:`v2v_protocol.sample.Provenance`."""

    spec_digest: str
    catalogue_digest: str
    candidate: int
    refusals: tuple[Refusal, ...]
    quarantine: int
    remark: str


@dataclass(frozen=True, slots=True)
class SampleJob:
    """One sample to make.

    Attributes:
        clip: what it is made from; that of a sibling's lease is equal.
        index: global index in the epoch.
        stamp: whose sample it is, for its provenance.
    """

    clip: ClipJob
    index: int
    stamp: Stamp

    @classmethod
    def of(cls, lease: Lease) -> SampleJob:
        """Read the sample of a lease, which is the first of its indices.

        Raises:
            ProtocolError, UsageError: the lease is malformed.
        """
        refusals = tuple(map(Refusal.from_dict, lease.refusals["refusals"]))
        stamp = Stamp(
            lease.spec_digest, lease.catalogue_digest, lease.candidate, refusals, lease.quarantine, lease.remark
        )
        return cls(ClipJob.of(lease), lease.indices[0], stamp)


@lru_cache(maxsize=16)
def _spec(canonical: bytes) -> StreamSpec:
    try:
        return StreamSpec.from_dict(parse_json(canonical))
    except ValueError as error:
        raise ProtocolError(f"lease.spec is not JSON: {error}") from error


def _stated(lease: Lease, ending: str) -> tuple[str, bytes | str]:
    """Return fingerprint and part of a sidecar, see ``Lease.sidecars``."""
    stated = lease.sidecars.get(ending, "")
    fingerprint, part = stated if isinstance(stated, list) and len(stated) == 2 else (stated, b"")
    if not isinstance(fingerprint, str) or not isinstance(part, bytes | str):
        raise ProtocolError(f"lease {lease.lease}: fingerprint {stated!r:.80} of the sidecar {ending}")
    return fingerprint, part
