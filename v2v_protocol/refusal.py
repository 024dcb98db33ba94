"""Refusal: what a video cannot do, in one form from the catalogue to a sample's provenance."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class RefusalKind(StrEnum):
    """Who refuses a video.

    UNUSABLE: the catalogue; the file cannot be opened, or is no video.
    UNSUITED: the schedule; it gives no sequence under the recipe.
    FAILED: a worker; it did not give what the catalogue had promised, or the worker died over it.
    QUARANTINED: the quarantine, which remembers what workers died of.
    """

    UNUSABLE = "unusable"
    UNSUITED = "unsuited"
    FAILED = "failed"
    QUARANTINED = "quarantined"


@dataclass(frozen=True, slots=True)
class Refusal:
    """A video that cannot give what was asked of it.

    Attributes:
        video: its catalogue id.
        frame: the first frame that could not be had, presentation order; None where no single frame is to blame.
        reason: why, in one line.
        kind: who says so.
        time: when, ISO 8601, UTC; empty where the file's bytes say the same at any time.
        remedy: which setting would admit it, in words; empty where none would.
    """

    video: str
    frame: int | None
    reason: str
    kind: str = RefusalKind.FAILED
    time: str = ""
    remedy: str = ""

    def __str__(self) -> str:
        where = "" if self.frame is None else f" at frame {self.frame}"
        remedy = f"; would admit it: {self.remedy}" if self.remedy else ""
        return f"{self.video}{where}: {self.reason}{remedy}"

    def to_dict(self) -> dict[str, str | int | None]:
        """Plain values for a provenance, which says the same at any time."""
        return {"video": self.video, "frame": self.frame, "reason": self.reason, "kind": str(self.kind)}
