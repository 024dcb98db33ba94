"""Decoded clips on hand: what a worker keeps so that siblings cost one decode.

Memory: what the samples to come of one lease's siblings need, each cropped to its own view: at most
(samples_per_decode - 1) x frames x window bytes, besides the sample being made.
"""

from __future__ import annotations

from v2v_protocol.errors import VideoChanged, VideoError, VideoUnreadable
from v2v_protocol.messages import Lease
from v2v_server.corpus.sources.source import VideoSource
from v2v_server.store.cache import Cache
from v2v_server.worker.produce import Decoded, decode_for


class Clips:
    """Decode clips for leases, together with those of their siblings.

    Args:
        source: where the videos come from.
        cache: cache of decoded pieces for later epochs; None stores nothing.
    """

    def __init__(self, source: VideoSource, cache: Cache | None = None) -> None:
        self._source = source
        self._cache = cache
        self._kept: dict[tuple[object, ...], Decoded] = {}

    def take(self, lease: Lease) -> tuple[Decoded, bool]:
        """Return the decoded clip of the lease's sample, and whether it was decoded just now.

        Raises:
            VideoError, ProtocolError: see :func:`v2v_server.worker.produce.decode_for`.
        """
        kept = self._kept.pop(_key(lease, lease.indices[0]), None)
        if kept is not None:
            return kept, False
        self._kept = {}  # siblings that never came
        if len(lease.indices) > 1:
            try:
                first, *others = decode_for(lease, lease.indices, self._source, self._cache)
            except VideoError:
                pass  # a sibling may need more of the clip than this sample; try without siblings
            else:
                self._kept = {_key(lease, index): one for index, one in zip(lease.indices[1:], others, strict=True)}
                return first, True
        try:
            return decode_for(lease, lease.indices[:1], self._source, self._cache)[0], True
        except (VideoChanged, VideoUnreadable):
            raise
        except VideoError:
            # A decoder may hide a temporary storage error, so try once more. An error of the file repeats.
            return decode_for(lease, lease.indices[:1], self._source, self._cache)[0], True

    def said_of_cache(self, decoded: Decoded) -> str:
        """Return the cache field of a sample's header, see :class:`v2v_protocol.messages.SampleHeader`."""
        if self._cache is None or decoded.clip.origin == "store":
            return ""
        if decoded.clip.origin == "cache":
            return "hit"
        return f"miss: {self._cache.trouble}" if self._cache.trouble else "miss"

    def has(self, lease: Lease) -> bool:
        """Return whether the lease's sample needs no decoding."""
        return _key(lease, lease.indices[0]) in self._kept


def _key(lease: Lease, index: int) -> tuple[object, ...]:
    """Return the fields of a lease that its decoded clip depends on, and its index."""
    return (
        lease.spec, lease.seed, lease.epoch, index, lease.arrays, lease.video, lease.fingerprint, lease.rows,
        lease.start_frame, lease.thresholds,
    )  # fmt: skip
