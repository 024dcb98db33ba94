"""Admit a consumer: check what its Hello asks for, and work out its session and credit."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping

from v2v_protocol import NUMERICS_VERSION
from v2v_protocol.errors import CorpusError, LimitExceeded, UsageError
from v2v_protocol.liveness import Liveness
from v2v_protocol.messages import LARGEST_ARRAY_BYTES, Hello, Welcome
from v2v_protocol.recipe import Recipe
from v2v_protocol.sample import array_layout, layout_bytes
from v2v_protocol.spec import StreamSpec
from v2v_server.broker.leases import clean_name
from v2v_server.broker.session import Session
from v2v_server.broker.state import Broker
from v2v_server.lease_memory import MOST_CLIP_BYTES
from v2v_server.schedule import Schedule, SequenceTable, suitable_kind

MOST_BATCH_SIZE = 65_536
MOST_CREDIT = 400
"""Less than ``router.MOST_QUEUED``, the number of queued messages at which a consumer is disconnected."""
MOST_TABLES = 16
"""Sequence tables cached for later consumers. A session keeps its own, which is small."""
_LONGEST_SECRET_BYTES = 64


def owner_digest(user: str, secret: bytes) -> bytes:
    """Return a digest of the owner of a session or worker name: its key, if there are keys, and its secret.

    Raises:
        LimitExceeded: the secret is too long.
    """
    if len(secret) > _LONGEST_SECRET_BYTES:
        raise LimitExceeded(f"the secret has {len(secret)} bytes; the limit is {_LONGEST_SECRET_BYTES}")
    return hashlib.blake2b(secret, key=hashlib.sha256(user.encode()).digest()).digest() if secret else b""


def suggested_credit(batch_size: int, workers: int, samples_per_decode: int) -> int:
    """Return how many samples a consumer should have outstanding: one batch ahead, and two for each worker.

    With K samples per decode the count is in blocks of ``batch_size`` clips with K samples each. A worker gets the
    siblings of a clip together only if all of them have been requested. So the credit covers the blocks in work (two
    clips for each worker) and one more. It is then raised by a seventh, because our client asks only when an eighth of
    its credit is free.
    """
    ahead = 2 * max(1, workers)
    if samples_per_decode == 1:
        return max(2 * batch_size, ahead)
    under_way = batch_size * samples_per_decode * (1 + -(-ahead // batch_size))
    return under_way + -(-under_way // 7)


def admit(broker: Broker, identity: bytes, hello: Hello, now: float) -> tuple[Session, Welcome]:
    """Open the session that a consumer asks for, and return it with the reply.

    Args:
        identity: the consumer's routing id.
        hello: its message.
        now: monotonic time, seconds.

    Raises:
        UsageError, CorpusError: the request cannot be served.
    """
    if not 1 <= hello.batch_size <= MOST_BATCH_SIZE:
        raise UsageError(f"batch_size = {hello.batch_size}: give 1 to {MOST_BATCH_SIZE}")
    spec = StreamSpec.from_dict(hello.spec, broker.default_spec)
    spec = spec.spaced(hello.stride or hello.batch_size)
    layout = array_layout(spec.recipe, spec.voxel_dtype, hello.arrays)
    _check_sizes(broker, spec.recipe, layout)
    broker.facts.require_arrays(hello.arrays)
    newest = broker.quarantine.latest
    quarantine = newest if hello.quarantine is None else hello.quarantine
    if quarantine > newest:
        raise CorpusError(
            f"quarantine snapshot {quarantine} was asked for, this server has 0 .. {newest}: the stream follows "
            "entries that this server has not read. Replace this server's quarantine file with that of the "
            "stream's earlier server (v2v-quarantine --videos DIR prints its path), and restart this server; if "
            'they are the same file, just restart. To continue without these entries, set "quarantine" of the '
            "saved state to None: the sequences that they refused then return"
        )
    table = _table(broker, spec)
    schedule = Schedule(table, spec)
    if not schedule.count:
        raise UsageError(
            f"{table.count} sequences do not fill a block of sibling_spacing = {spec.sibling_spacing}: use a "
            "smaller batch size, fewer ranks or loader workers, samples_per_decode = 1, or more videos"
        )
    # It keeps all workers busy, present or expected, within its bounds.
    workers = max(len(broker.registry.members), broker.expected_workers)
    suggested = suggested_credit(hello.batch_size, workers, spec.samples_per_decode)
    session = Session(
        identity=identity,
        spec=spec,
        seed=hello.seed,
        arrays=hello.arrays,
        batch_size=hello.batch_size,
        schedule=schedule,
        credit=min(suggested, MOST_CREDIT, broker.max_credit_bytes // layout_bytes(layout)),
        liveness=Liveness(now, gone_seconds=broker.session_idle_seconds),
        quarantine=quarantine,
        since=now,
        packed=hello.packed,
        name=clean_name(hello.name),
        host=clean_name(hello.host),
    )
    return session, Welcome(
        spec=spec.to_dict(),
        spec_digest=spec.digest,
        catalogue_digest=broker.facts.digest_under(spec.scene),
        numerics_version=NUMERICS_VERSION,
        sequences=schedule.count,
        credit=session.credit,
        quarantine=quarantine,
        sidecars=broker.facts.sidecars_digest(hello.arrays),
    )


def _check_sizes(broker: Broker, recipe: Recipe, layout: Mapping[str, tuple[str, tuple[int, ...]]]) -> None:
    remedy = "ask for fewer voxels_per_clip or a smaller crop"
    for name, (dtype, shape) in layout.items():
        size = layout_bytes({name: (dtype, shape)})
        if size > LARGEST_ARRAY_BYTES:
            raise UsageError(
                f"array {name} {dtype}{list(shape)} of one sample is {size} bytes; the limit is "
                f"{LARGEST_ARRAY_BYTES}: {remedy}"
            )
    # The view of an enlarged picture may be larger than the picture, which the sequences are bounded by. How many
    # frames a duration has depends on the video.
    view = (recipe.steps + 1) * recipe.crop_height_px * recipe.crop_width_px
    if view > MOST_CLIP_BYTES and not recipe.is_timed:
        raise UsageError(
            f"the {recipe.steps + 1} frames of {recipe.crop_width_px}x{recipe.crop_height_px} px of one sample "
            f"are {view >> 20} MiB; the limit is {MOST_CLIP_BYTES >> 20} MiB: {remedy}"
        )
    if layout_bytes(layout) > broker.max_credit_bytes:
        raise UsageError(
            f"one sample is {layout_bytes(layout)} bytes; the server's --max-credit-bytes is "
            f"{broker.max_credit_bytes}: raise it, or {remedy}"
        )


def _table(broker: Broker, spec: StreamSpec) -> SequenceTable:
    recipe = spec.recipe
    # The sequences depend only on these fields, so one table serves many specs.
    geometry = (
        recipe.frames_needed,
        spec.samples_per_decode,
        recipe.frames_per_sequence,
        recipe.frame_stride,
        recipe.voxel_seconds[1],
        recipe.crop_height_px,
        recipe.crop_width_px,
        recipe.resize_scale,
        recipe.light,
        recipe.exposure_seconds,
        spec.flow_margin_px,
        spec.levels_per_step,
        spec.voxel_dtype,
        spec.max_sequences_per_video,
        spec.scene,
        spec.kept_defects,
        spec.still_share,
        spec.quiet_share,
    )
    suitable_kind(broker.facts.videos, spec)  # a table is also one of specs that such videos do not suit
    table = broker.tables.get(geometry)
    if table is None:
        table = SequenceTable(broker.facts.videos, broker.facts.rows, spec, broker.columns)
        if not table.count:
            raise UsageError(f"none of the {len(table.refusals)} videos gives a sequence; {table.refusals[0]}")
        while len(broker.tables) >= MOST_TABLES:
            del broker.tables[next(iter(broker.tables))]
        broker.tables[geometry] = table
    return table
