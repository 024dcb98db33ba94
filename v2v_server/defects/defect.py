"""One finding about the pictures of a video."""

from __future__ import annotations

from dataclasses import dataclass

DUPLICATES, CUTS, BARS, STILL, BLACK = KINDS = ("duplicates", "cuts", "bars", "still", "black")

Spans = tuple[tuple[int, int], ...]
"""(first frame, frame after the last) of each stretch."""


@dataclass(frozen=True, slots=True)
class Sides:
    """Bars at the sides of a picture, pixels."""

    top: int
    bottom: int
    left: int
    right: int


@dataclass(frozen=True, slots=True)
class Defect:
    """A defect of the frames that were looked at.

    Attributes:
        kind: one of :data:`KINDS`.
        spans: the frames that are affected: of a duplicate or a cut, the two frames of its step.
        per_mille: of duplicates and cuts, the share of the steps from frame to frame; otherwise of the frames.
        text: what was found, for the user.
        sides: the bars; None for other kinds.
    """

    kind: str
    spans: Spans
    per_mille: int
    text: str
    sides: Sides | None = None

    def touches(self, first: int, end: int) -> bool:
        """Return whether one of the frames first .. end - 1 is affected; of a step, both its frames."""
        if self.kind in (DUPLICATES, CUTS):
            return any(first <= low and high <= end for low, high in self.spans)
        return any(low < end and high > first for low, high in self.spans)
