"""Describe what a video cannot do, in one form from the catalogue to a sample's provenance."""

from __future__ import annotations

from dataclasses import dataclass

from v2v_protocol.persisted import Persisted, later


class RefusalKind:
    """Which part refuses a video.

    UNUSABLE: the catalogue; the file cannot be opened, or is not a video.
    UNSUITED: the schedule; it gives no sequence under the recipe.
    FAILED: a worker; the file did not deliver what was catalogued, or the worker died over it.
    QUARANTINED: the quarantine, which records the sequences that brought workers down.
    """

    UNUSABLE = "unusable"
    UNSUITED = "unsuited"
    FAILED = "failed"
    QUARANTINED = "quarantined"


@dataclass(frozen=True, slots=True)
class Refusal(Persisted):
    """A video that cannot be used for a request.

    Attributes:
        video: its catalogue id.
        frame: the first unavailable frame, presentation order; None if no single frame is to blame.
        reason: one line of text.
        kind: which part refuses it.
        remedy: which setting would admit it, in words; empty if no setting would.
    """

    video: str
    frame: int | None
    reason: str
    kind: str = RefusalKind.FAILED
    remedy: str = later("")

    def __str__(self) -> str:
        where = "" if self.frame is None else f" at frame {self.frame}"
        remedy = f"; would admit it: {self.remedy}" if self.remedy else ""
        return f"{self.video}{where}: {self.reason}{remedy}"
