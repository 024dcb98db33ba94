"""Build leases and check their results. Pure.

A lease holds everything that a worker on any host needs, and nothing else. Its result is checked before it is passed
on: a consumer trusts its server, but the server does not trust a worker, which may run another version, be broken or be
hostile. Only the small header is read. The arrays are measured, unless they lie in a slot of the consumer.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from v2v_protocol.arena import NO_SLOT
from v2v_protocol.errors import ProtocolError
from v2v_protocol.messages import Lease, SampleHeader
from v2v_protocol.sample import Form
from v2v_protocol.spec import StreamSpec
from v2v_protocol.wire import decode, largest_packed_bytes
from v2v_server.broker.leases import Request
from v2v_server.corpus.catalogue import Catalogue
from v2v_server.corpus.videos import VideoEntry
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
    packed: bool = False,
) -> Lease:
    """Build the lease for one request.

    Args:
        request: which sample, and which candidates failed before.
        sequence: the sequence that the request's candidate is made from.
        catalogue, spec, seed: parts of the sample's identity.
        arrays: names of the arrays to send.
        number: the lease's number.
        siblings: indices that are made from the same clip and follow in leases of their own.
        packed: whether the consumer asks for compressed arrays.

    Raises:
        IndexUnreadable: the catalogue's index cannot be read at the moment.
        V2VError: the index of this video is damaged, belongs to another file, or is too large to send.
    """
    video = sequence.video
    thresholds: tuple[float, ...] = ()
    if video.threshold_pos is not None and video.threshold_neg is not None:
        thresholds = (video.threshold_pos, video.threshold_neg)
    scene = b""
    if spec.scene != "off":
        scene = catalogue.scene(video.id).slice(sequence.start_frame, spec.recipe.frames_needed).to_bytes()
    return Lease(
        lease=number,
        spec=spec.canonical(),
        spec_digest=spec.digest,
        catalogue_digest=catalogue.digest_under(spec.scene),
        seed=seed,
        epoch=request.epoch,
        indices=(request.index, *siblings),
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
        candidate=request.candidate,
        quarantine=request.snapshot,
        refusals={"refusals": [refusal.to_dict() for refusal in request.refusals]},
        scene=scene,
        arena="" if request.slot is None else request.slot.arena,
        slot=NO_SLOT if request.slot is None else request.slot.number,
        packed=packed,
    )


_DECODE_SECONDS = 5e-8
"""For each pixel of a frame: ten times the time of a slow codec on a slow core. The other limits are as generous."""
_FLOW_SECONDS = 1e-6
_SIMULATION_SECONDS = 1e-7


def work_seconds(spec: StreamSpec, arrays: tuple[str, ...], video: VideoEntry) -> float:
    """Return an upper bound of the time for one sample, whole seconds.

    A frame of 1920 x 1080 is given 0.1 s, its flow 2 s.

    Args:
        spec, arrays: what is asked of the video.
        video: its catalogue entry; pictures are decoded whole.
    """
    recipe, picture_px = spec.recipe, video.width_px * video.height_px
    seconds = _DECODE_SECONDS * picture_px * recipe.frames_needed
    seconds += _SIMULATION_SECONDS * recipe.crop_height_px * recipe.crop_width_px * recipe.frames_needed
    if not {"flow", "flow_valid"}.isdisjoint(arrays):
        seconds += _FLOW_SECONDS * picture_px * (recipe.frames_needed - 1)
    return float(math.floor(seconds * spec.samples_per_decode))


def check_result(payload: Sequence[Any], request: Request, form: Form) -> SampleHeader:
    """Return the header of a result, after checking that its consumer will be able to read the sample.

    Args:
        payload: the frames behind the worker's Result: a whole SampleHeader message.
        request: what was asked.
        form: the expected form of the sample.

    Raises:
        ProtocolError: the result must not be passed on.
    """
    if not payload:
        raise ProtocolError("nothing follows it")
    header = decode(bytes(payload[0]))
    if not isinstance(header, SampleHeader) or (header.epoch, header.index) != (request.epoch, request.index):
        raise ProtocolError("its header names another sample than the lease")
    if (header.names, header.dtypes) != (form.names, form.dtypes):
        raise ProtocolError(f"it has {list(header.names)!r:.100} of {list(header.dtypes)!r:.100}")
    if header.quarantine != request.snapshot:
        raise ProtocolError(f"it was made under quarantine snapshot {header.quarantine}, not {request.snapshot}")
    slot = NO_SLOT if request.slot is None else request.slot.number
    if header.slot != slot:
        raise ProtocolError(f"it names slot {header.slot}, slot {slot} was lent")
    in_slot = slot != NO_SLOT and len(payload) == 1
    if header.shapes != form.shapes or not (in_slot or _fits(payload[1:], form.sizes, header.packed)):
        raise ProtocolError("its arrays have other shapes or sizes than the lease asks for")
    return header


def _fits(frames: Sequence[Any], sizes: tuple[int, ...], packed: bool) -> bool:
    """Return whether the frames may hold arrays of these sizes, bytes."""
    lengths = tuple(map(len, frames))
    if not packed:
        return lengths == sizes
    if len(lengths) != len(sizes):
        return False
    return all(0 < length <= largest_packed_bytes(size) for length, size in zip(lengths, sizes, strict=True))
