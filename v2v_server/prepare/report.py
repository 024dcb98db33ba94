"""What a run of `v2v-prepare` has done."""

from __future__ import annotations

import math
from dataclasses import dataclass

from v2v_protocol.refusal import Refusal
from v2v_server.catalogue.manifest import PreparedVideo


@dataclass(frozen=True, slots=True)
class Report:
    """What a run has done.

    Attributes:
        videos: a record of every video of the source, by id.
        kept: how many of them an earlier run had done.
        looked_at: how many of them an earlier run had done but for the statistics of what they show.
        aside: how many videos of earlier runs this one was not asked for; see :mod:`v2v_server.catalogue.manifest`.
        not_looked_at: prepared videos whose statistics could not be taken, and why. What they had stays.
        unusable: files of the source that no server takes in either.
        floor_db: least PSNR of a clip.
        frame_floor_db: least PSNR of each of its frames.
    """

    videos: tuple[PreparedVideo, ...]
    kept: int
    unusable: tuple[Refusal, ...]
    floor_db: float
    frame_floor_db: float
    looked_at: int = 0
    aside: int = 0
    not_looked_at: tuple[Refusal, ...] = ()

    @property
    def prepared(self) -> tuple[PreparedVideo, ...]:
        """Those that have a prepared file."""
        return tuple(video for video in self.videos if video.problem is None)

    @property
    def failed(self) -> tuple[PreparedVideo, ...]:
        """Those that have none."""
        return tuple(video for video in self.videos if video.problem is not None)

    @property
    def below_floor(self) -> tuple[PreparedVideo, ...]:
        """Those whose PSNR, or that of one of their frames, is below its floor, the worst frame first. Their files are
        kept, and served."""
        low = [
            video
            for video in self.prepared
            if _known(video.psnr_db) < self.floor_db or _known(video.worst_psnr_db) < self.frame_floor_db
        ]
        return tuple(sorted(low, key=lambda video: _known(video.worst_psnr_db)))

    @property
    def source_bytes(self) -> int:
        """Of the sources that were prepared."""
        return sum(video.source_bytes for video in self.prepared)

    @property
    def prepared_bytes(self) -> int:
        """Of the prepared files."""
        return sum(video.bytes for video in self.prepared)

    @property
    def complete(self) -> bool:
        """Whether every video file was prepared, with all that was asked for, and well enough."""
        return not (self.failed or self.below_floor or self.unusable or self.not_looked_at)


def _known(psnr_db: float | None) -> float:
    return math.inf if psnr_db is None else psnr_db
