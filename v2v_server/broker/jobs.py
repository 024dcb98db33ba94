"""From an index to the lease that describes the work: everything a worker on any host needs, and nothing else."""

from __future__ import annotations

import dataclasses
import math

from v2v_protocol.arena import NO_SLOT
from v2v_protocol.messages import Lease
from v2v_protocol.spec import StreamSpec
from v2v_server.broker.leases import Task
from v2v_server.catalogue.catalogue import Catalogue
from v2v_server.schedule.sequences import Sequence


def describe(
    task: Task,
    *,
    number: int,
    sequence: Sequence,
    quarantine: int,
    catalogue: Catalogue,
    spec: StreamSpec,
    seed: int,
    arrays: tuple[str, ...],
    deadline_seconds: float,
    siblings: tuple[int, ...] = (),
) -> Lease:
    """The lease for one task.

    Args:
        task: which sample, and what was tried before.
        number: of the lease.
        sequence: what the task's candidate is made from.
        quarantine: number of the quarantine snapshot that let it pass.
        catalogue, spec, seed: of the sample's identity.
        arrays: to be sent.
        deadline_seconds: see :class:`v2v_protocol.messages.Lease`.
        siblings: indices that are made from the same clip and follow in leases of their own.

    Raises:
        CorpusError: the catalogue's index can no longer be read.
    """
    video = sequence.video
    thresholds: tuple[str, ...] = ()
    if video.threshold_pos is not None and video.threshold_neg is not None:
        thresholds = (video.threshold_pos.hex(), video.threshold_neg.hex())
    scene = b""
    if spec.scene != "off":
        scene = catalogue.scene(video.id).slice(sequence.start_frame, spec.recipe.frames_needed).to_bytes()
    return Lease(
        lease=number,
        reply_to=task.session,
        spec=spec.canonical(),
        spec_digest=spec.digest,
        catalogue_digest=catalogue.digest_under(spec.scene),
        seed=seed,
        epoch=task.epoch,
        indices=(task.index, *siblings),
        arrays=arrays,
        video=video.id,
        fingerprint=video.fingerprint,
        rows=str(catalogue.rows),
        width_px=video.width_px,
        height_px=video.height_px,
        frames_per_second=0.0 if math.isnan(video.frames_per_second) else video.frames_per_second,
        thresholds=thresholds,
        start_frame=sequence.start_frame,
        frame_index=catalogue.frame_index_bytes(video.id, sequence.start_frame, spec.recipe.frames_needed),
        candidate=task.candidate,
        quarantine=quarantine,
        refusals={"refusals": [dataclasses.asdict(refusal) for refusal in task.refusals]},
        deadline_seconds=deadline_seconds,
        scene=scene,
        arena="" if task.slot is None else task.slot.arena,
        slot=NO_SLOT if task.slot is None else task.slot.number,
    )
