"""Reception: from a consumer's Hello to its session. Pure."""

from __future__ import annotations

from collections.abc import Mapping

from v2v_protocol import NUMERICS_VERSION
from v2v_protocol.errors import CorpusError, UsageError
from v2v_protocol.messages import Hello, Welcome
from v2v_protocol.sample import array_layout, layout_bytes
from v2v_protocol.spec import StreamSpec
from v2v_protocol.wire import LARGEST_ARRAY_BYTES
from v2v_server.quarantine import Quarantine
from v2v_server.schedule import Schedule
from v2v_server.sequences import SequenceTable
from v2v_server.session import Session
from v2v_server.video.catalogue import Catalogue

MOST_BATCH_SIZE = 65_536
MOST_CREDIT = 400
"""Below the number of messages that the broker queues for a consumer before it takes it for deaf."""
MOST_TABLES = 16
"""Sequence tables kept for consumers to come; a session keeps its own."""


class Reception:
    """Turns what consumers ask for into sessions.

    Args:
        catalogue: the corpus.
        default_spec: what a consumer gets that asks for nothing in particular.
        max_credit_bytes: bound on the bytes in flight to one consumer.
        quarantine: the snapshots.
    """

    def __init__(
        self, catalogue: Catalogue, default_spec: StreamSpec, max_credit_bytes: int, quarantine: Quarantine
    ) -> None:
        self._catalogue = catalogue
        self._default_spec = default_spec
        self._max_credit_bytes = max_credit_bytes
        self._quarantine = quarantine
        self._tables: dict[tuple[object, ...], SequenceTable] = {}

    def receive(self, identity: bytes, hello: Hello, workers: int, now: float) -> tuple[Session, Welcome]:
        """The session a consumer asks for, and the answer to it.

        Args:
            identity: the consumer's routing identity.
            hello: what it asks for.
            workers: how many workers there are; the credit keeps all of them busy.
            now: the time.

        Raises:
            UsageError, CorpusError: what is asked cannot be had.
        """
        spec = StreamSpec.from_dict(hello.spec, self._default_spec)
        layout = array_layout(spec.recipe, spec.voxel_dtype, hello.arrays)
        if not 1 <= hello.batch_size <= MOST_BATCH_SIZE:
            raise UsageError(f"batch_size = {hello.batch_size}: give 1 to {MOST_BATCH_SIZE}")
        self._check_sizes(layout)
        newest = self._quarantine.latest
        quarantine = newest if hello.quarantine is None else hello.quarantine
        if quarantine > newest:
            raise CorpusError(
                f"quarantine snapshot {quarantine} was asked for, this server has 0 .. {newest}: its quarantine file "
                f"is not the one that the stream was begun with"
            )
        schedule = Schedule(self._table(spec), shuffle=spec.shuffle)
        suggested = max(2 * hello.batch_size, 2 * max(1, workers))
        session = Session(
            identity=identity,
            spec=spec,
            seed=hello.seed,
            arrays=hello.arrays,
            batch_size=hello.batch_size,
            schedule=schedule,
            credit=min(suggested, MOST_CREDIT, self._max_credit_bytes // layout_bytes(layout)),
            last_heard=now,
            quarantine=quarantine,
        )
        return session, Welcome(
            spec=spec.to_dict(),
            spec_digest=spec.digest,
            catalogue_digest=self._catalogue.digest,
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
            recipe.frames_per_sequence,
            recipe.crop_height_px,
            recipe.crop_width_px,
            recipe.resize_scale,
            spec.max_sequences_per_video,
        )
        table = self._tables.get(geometry)
        if table is None:
            table = SequenceTable(self._catalogue.videos, self._catalogue.rows, spec)
            if not table.count:
                first = table.rejections[0]
                raise UsageError(
                    f"none of the {len(table.rejections)} videos gives a sequence; {first.video}: {first.reason} "
                    f"(would admit it: {first.remedy})"
                )
            while len(self._tables) >= MOST_TABLES:
                del self._tables[next(iter(self._tables))]
            self._tables[geometry] = table
        return table
