"""What makes false events or empty grids in a video, said for people."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from v2v_protocol.persisted import Persisted
from v2v_server.corpus.scenes.scene import NOISE, SEGMENT_FRAMES, Flag, Scene, Sides, firsts_of, sides_of
from v2v_server.corpus.scenes.stretches import Spans, pattern_of, runs_of

DUPLICATES, CUTS, FADES, BARS, STILL, BLACK, WHITE, COMBED, NOISY = FINDING_KINDS = (
    "duplicates", "cuts", "fades", "bars", "still", "black", "white", "combed", "noise",
)  # fmt: skip
_FLAGS = {
    FADES: (Flag.FADE, "fade to or from black"),
    STILL: (Flag.STILL, "are still"),
    BLACK: (Flag.BLACK, "are black"),
    WHITE: (Flag.WHITE, "are white"),
    COMBED: (Flag.COMBED, "hold two fields of different times"),
}
_NOISY_LEVELS = 1.5
"""Noise of one pixel that fires events at common thresholds, grey levels."""


@dataclass(frozen=True, slots=True)
class Defect(Persisted):
    """A defect of the frames that were analysed.

    Attributes:
        kind: one of :data:`FINDING_KINDS`.
        spans: the frames that are affected: of a duplicate or a cut, the two frames of its step.
        per_mille: of duplicates and cuts, the share of the steps from frame to frame; otherwise of the frames.
        text: what was found, for the user.
        sides: the widest bars; None for other kinds.
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


def defects_of(scene: Scene) -> tuple[Defect, ...]:
    """Return at most one defect of each kind, from the analysis of a video from its first frame on."""
    firsts, ends, flags = firsts_of(scene.pieces, 0), scene.pieces["end"], scene.pieces["flags"]
    found = []
    repeats = np.repeat((flags & Flag.REPEAT) != 0, ends - firsts)
    if pairs := _steps(np.flatnonzero(repeats)):
        share = 1000 * len(pairs) // (scene.end - 1)
        text = f"{_percent(share)} of the frames repeat the one before ({pattern_of(repeats[1:])})"
        found.append(Defect(DUPLICATES, pairs, share, text))
    if cuts := _steps(np.array(scene.shot_boundaries, np.int64)):
        found.append(Defect(CUTS, cuts, 1000 * len(cuts) // (scene.end - 1), f"hard cuts or jumps: {len(cuts)}"))
    sides = sides_of(scene.pieces)
    if spans := runs_of(np.repeat(sides.any(axis=1), ends - firsts), 1):
        widest = Sides(*sides.max(axis=0).tolist())
        found.append(_stretch(scene, BARS, spans, f"have bars: {_sides(widest)}", widest))
    for kind, (flag, effect) in _FLAGS.items():
        if spans := runs_of(np.repeat((flags & flag) != 0, ends - firsts), 1):
            found.append(_stretch(scene, kind, spans, effect))
    still = np.repeat((flags & Flag.STILL) != 0, ends - firsts)
    noise = np.repeat(scene.values(0, scene.end)[:, NOISE], SEGMENT_FRAMES)[: scene.end]
    if noisy := runs_of(still & (noise >= _NOISY_LEVELS), 1):
        found.append(_stretch(scene, NOISY, noisy, "are still, with noise that fires events"))
    return tuple(found)


def _steps(later: np.ndarray[tuple[int], np.dtype[np.int64]]) -> Spans:
    return tuple((at - 1, at + 1) for at in later.tolist())


def _stretch(scene: Scene, kind: str, spans: Spans, effect: str, sides: Sides | None = None) -> Defect:
    share = 1000 * sum(end - first for first, end in spans) // scene.end
    return Defect(kind, spans, share, f"{_percent(share)} of the frames {effect}", sides)


def _percent(per_mille: int) -> str:
    return f"{(per_mille + 5) // 10}%"


def _sides(sides: Sides) -> str:
    return ", ".join(f"{name} {depth} px" for name, depth in zip(Sides._fields, sides, strict=True) if depth)
