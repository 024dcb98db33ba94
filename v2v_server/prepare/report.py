"""Results of a run of `v2v-prepare`."""

from __future__ import annotations

from dataclasses import dataclass

from v2v_protocol.sample import Refusal
from v2v_server.corpus.manifest import PreparedVideo


@dataclass(frozen=True, slots=True)
class Report:
    """Results of a run.

    Attributes:
        videos: a record of every video of the source, by id.
        kept: number of videos that an earlier run had finished.
        looked_at: number of videos that an earlier run had finished except for their scene statistics.
        aside: number of videos of earlier runs that this run does not include; see
            :mod:`v2v_server.corpus.manifest`.
        not_looked_at: prepared videos whose statistics could not be computed, and why. Their files stay.
        unusable: files of the source that a server cannot use either.
    """

    videos: tuple[PreparedVideo, ...]
    kept: int
    unusable: tuple[Refusal, ...]
    looked_at: int = 0
    aside: int = 0
    not_looked_at: tuple[Refusal, ...] = ()

    @property
    def prepared(self) -> tuple[PreparedVideo, ...]:
        """Return the videos that have a prepared file."""
        return tuple(video for video in self.videos if video.problem is None)

    @property
    def failed(self) -> tuple[PreparedVideo, ...]:
        """Return the videos that have no prepared file."""
        return tuple(video for video in self.videos if video.problem is not None)

    @property
    def source_bytes(self) -> int:
        """Size of the sources that were prepared, bytes."""
        return sum(video.source_bytes for video in self.prepared)

    @property
    def prepared_bytes(self) -> int:
        """Size of the prepared files, bytes."""
        return sum(video.bytes for video in self.prepared)

    @property
    def complete(self) -> bool:
        """Return whether every video file was prepared, with everything requested."""
        return not (self.failed or self.unusable or self.not_looked_at)
