"""Admission: from a consumer's Hello to its session. Pure."""

from __future__ import annotations

from collections.abc import Mapping

from v2v_protocol import NUMERICS_VERSION
from v2v_protocol.errors import CorpusError, UsageError
from v2v_protocol.liveness import Liveness
from v2v_protocol.messages import Hello, Welcome
from v2v_protocol.sample import array_layout, layout_bytes
from v2v_protocol.spec import StreamSpec
from v2v_protocol.wire import LARGEST_ARRAY_BYTES
from v2v_server.broker.quarantine import Quarantine
from v2v_server.broker.session import Session
from v2v_server.broker.worker_registry import clean_name
from v2v_server.catalogue.catalogue import Catalogue
from v2v_server.schedule.epoch import Schedule
from v2v_server.schedule.sequences import Columns, SequenceTable

MOST_BATCH_SIZE = 65_536
MOST_CREDIT = 400
"""Below the number of messages that the broker queues for a consumer before it takes it for deaf."""
MOST_TABLES = 16
"""Sequence tables kept for consumers to come; a session keeps its own."""


def suggested_credit(batch_size: int, workers: int, samples_per_decode: int) -> int:
    """Samples a consumer should have asked for at any time: one batch ahead, and two a worker.

    With K samples of a decode these are counted in blocks of ``batch_size`` clips, K samples each, because a worker
    gets the siblings of a clip at once only if all of them have been asked for: the blocks that the workers are at, two
    clips each, and one more. And an eighth of the whole, for which our client waits until it asks.
    """
    ahead = 2 * max(1, workers)
    if samples_per_decode == 1:
        return max(2 * batch_size, ahead)
    under_way = batch_size * samples_per_decode * (1 + -(-ahead // batch_size))
    return under_way + -(-under_way // 7)


class Admission:
    """Turns what consumers ask for into sessions.

    Args:
        catalogue: the corpus.
        default_spec: what a consumer gets that asks for nothing in particular.
        max_credit_bytes: bound on the bytes in flight to one consumer.
        session_idle_seconds: a session silent for so long is forgotten, whatever it waits for. Its consumer opens it
            again when it asks next, so the limit only bounds what abandoned consumers cost.
        quarantine: the snapshots.
    """

    def __init__(
        self,
        catalogue: Catalogue,
        default_spec: StreamSpec,
        max_credit_bytes: int,
        session_idle_seconds: float,
        quarantine: Quarantine,
    ) -> None:
        self._catalogue = catalogue
        self._default_spec = default_spec
        self._max_credit_bytes = max_credit_bytes
        self._session_idle_seconds = session_idle_seconds
        self._quarantine = quarantine
        self._columns = Columns(catalogue.videos)
        self._tables: dict[tuple[object, ...], SequenceTable] = {}

    def admit(self, identity: bytes, hello: Hello, workers: int, now: float) -> tuple[Session, Welcome]:
        """The session a consumer asks for, and the answer to it.

        Args:
            identity: the consumer's routing identity.
            hello: what it asks for.
            workers: how many workers there are, or will be; the credit keeps all of them busy, within its bounds.
            now: the time.

        Raises:
            UsageError, CorpusError: what is asked cannot be had.
        """
        if not 1 <= hello.batch_size <= MOST_BATCH_SIZE:
            raise UsageError(f"batch_size = {hello.batch_size}: give 1 to {MOST_BATCH_SIZE}")
        spec = StreamSpec.from_dict(hello.spec, self._default_spec)
        spec = spec.spaced(hello.stride or hello.batch_size)
        layout = array_layout(spec.recipe, spec.voxel_dtype, hello.arrays)
        self._check_sizes(layout)
        newest = self._quarantine.latest
        quarantine = newest if hello.quarantine is None else hello.quarantine
        if quarantine > newest:
            raise CorpusError(
                f"quarantine snapshot {quarantine} was asked for, this server has 0 .. {newest}: the stream goes by "
                "verdicts that this server has not read. Put the quarantine file of the server that it came from "
                "in the place of this one's (v2v-quarantine --videos DIR says where each lies), and start this server "
                'again; if both have the same file, only start it again. Or set "quarantine" of the saved state to '
                "None, to go on under what this server has: sequences that the other had condemned then come again"
            )
        table = self._table(spec)
        schedule = Schedule.of(table, spec)
        if not schedule.count:
            raise UsageError(
                f"{table.count} sequences do not fill a block of sibling_spacing = {spec.sibling_spacing}: use a "
                "smaller batch size, fewer ranks or loader workers, samples_per_decode = 1, or more videos"
            )
        suggested = suggested_credit(hello.batch_size, workers, spec.samples_per_decode)
        session = Session(
            identity=identity,
            spec=spec,
            seed=hello.seed,
            arrays=hello.arrays,
            batch_size=hello.batch_size,
            schedule=schedule,
            credit=min(suggested, MOST_CREDIT, self._max_credit_bytes // layout_bytes(layout)),
            liveness=Liveness(now, gone_seconds=self._session_idle_seconds),
            quarantine=quarantine,
            since=now,
            packed=hello.packed,
            name=clean_name(hello.name),
            host=clean_name(hello.host),
        )
        return session, Welcome(
            spec=spec.to_dict(),
            spec_digest=spec.digest,
            catalogue_digest=self._catalogue.digest_under(spec.scene),
            numerics_version=NUMERICS_VERSION,
            sequences=schedule.count,
            credit=session.credit,
            quarantine=quarantine,
        )

    def _check_sizes(self, layout: Mapping[str, tuple[str, tuple[int, ...]]]) -> None:
        remedy = "ask for fewer voxels_per_clip or a smaller crop"
        for name, (dtype, shape) in layout.items():
            size = layout_bytes({name: (dtype, shape)})
            if size > LARGEST_ARRAY_BYTES:
                raise UsageError(
                    f"array {name} {dtype}{list(shape)} of one sample is {size} bytes; the limit is "
                    f"{LARGEST_ARRAY_BYTES}: {remedy}"
                )
        if layout_bytes(layout) > self._max_credit_bytes:
            raise UsageError(
                f"one sample is {layout_bytes(layout)} bytes; the server's --max-credit-bytes is "
                f"{self._max_credit_bytes}: raise it, or {remedy}"
            )

    def _table(self, spec: StreamSpec) -> SequenceTable:
        recipe = spec.recipe
        # Only this of a spec decides which sequences there are; many specs share a table.
        geometry = (
            recipe.frames_needed,
            spec.samples_per_decode,
            recipe.frames_per_sequence,
            recipe.frame_stride,
            recipe.crop_height_px,
            recipe.crop_width_px,
            recipe.resize_scale,
            spec.max_sequences_per_video,
            spec.scene,
        )
        table = self._tables.get(geometry)
        if table is None:
            table = SequenceTable(self._catalogue.videos, self._catalogue.rows, spec, self._columns)
            if not table.count:
                raise UsageError(f"none of the {len(table.refusals)} videos gives a sequence; {table.refusals[0]}")
            while len(self._tables) >= MOST_TABLES:
                del self._tables[next(iter(self._tables))]
            self._tables[geometry] = table
        return table
