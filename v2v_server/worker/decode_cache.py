"""Decoded clips on hand: what a worker keeps so that siblings cost one decode.

Memory: what the samples to come of one lease's siblings need, each cropped to its own view: at most
(samples_per_decode - 1) x frames x window bytes, besides the sample being made.
"""

from __future__ import annotations

from pathlib import Path

from v2v_protocol.errors import VideoChanged, VideoError, VideoUnreadable
from v2v_protocol.messages import Lease
from v2v_server.cloud.copies import Copies
from v2v_server.store.cache import Cache
from v2v_server.worker.produce import Decoded, decode_for


class Clips:
    """Decodes for leases, and for their siblings along with them.

    Args:
        root: folder that the catalogue's ids are relative to, on this host; or their copies, from object storage.
        cache: where what is decoded is kept for later epochs; None keeps nothing.
    """

    def __init__(self, root: Path | Copies, cache: Cache | None = None) -> None:
        self._root = root
        self._cache = cache
        self._kept: dict[tuple[object, ...], Decoded] = {}

    def take(self, lease: Lease) -> tuple[Decoded, bool]:
        """What was decoded for the lease's sample, and whether that was done just now.

        Raises:
            VideoError, ProtocolError: see :func:`v2v_server.worker.produce.decode_for`.
        """
        kept = self._kept.pop(_key(lease, lease.indices[0]), None)
        if kept is not None:
            return kept, False
        self._kept = {}  # siblings that never came
        if len(lease.indices) > 1:
            try:
                first, *others = decode_for(lease, lease.indices, self._root, self._cache)
            except VideoError:
                pass  # a sibling may need more of the clip than this sample, whose fault that is not
            else:
                self._kept = {_key(lease, index): one for index, one in zip(lease.indices[1:], others, strict=True)}
                return first, True
        try:
            return decode_for(lease, lease.indices[:1], self._root, self._cache)[0], True
        except (VideoChanged, VideoUnreadable):
            raise
        except VideoError:
            # Storage may fail for a moment, which decoders do not always say. What the file does, it does again.
            return decode_for(lease, lease.indices[:1], self._root, self._cache)[0], True

    def said_of_cache(self, decoded: Decoded) -> str:
        """What a sample's header says of the cache: see :class:`v2v_protocol.messages.SampleHeader`."""
        if self._cache is None or decoded.clip.origin == "store":
            return ""
        if decoded.clip.origin == "cache":
            return "hit"
        return f"miss: {self._cache.trouble}" if self._cache.trouble else "miss"

    def has(self, lease: Lease) -> bool:
        """Whether the lease's sample needs no decoding."""
        return _key(lease, lease.indices[0]) in self._kept


def _key(lease: Lease, index: int) -> tuple[object, ...]:
    """Everything of a lease that its decoded clip depends on, and its index."""
    return (
        lease.spec, lease.seed, lease.epoch, index, lease.arrays, lease.video, lease.fingerprint, lease.rows,
        lease.start_frame, lease.thresholds,
    )  # fmt: skip
