"""Average scores over the frames of a sequence, and unweighted over the sequences of a data set, as the paper does."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from trainer.evaluation.metrics import Metric
from trainer.evaluation.reconstruct import Step


@dataclass(frozen=True)
class SequenceScore:
    """Hold the scores of one sequence.

    Attributes:
        data_set, sequence: names.
        frames: number of reconstructed windows.
        events: number of events in them.
        empty_windows: number of windows without events.
        repaired_images: number of repaired time stamps.
        means: mean over the frames by metric; empty if the sequence has no pictures to compare with.
        blank: the same scores for a blank picture in the mean grey of each target, as a baseline.
        by_frame: for each scored window its number, its end (s), its number of events, and each metric.
    """

    data_set: str
    sequence: str
    frames: int
    events: int
    empty_windows: int
    repaired_images: int
    means: Mapping[str, float]
    blank: Mapping[str, float] = field(default_factory=dict)
    by_frame: Sequence[Mapping[str, float]] = ()


@dataclass
class SequenceScorer:
    """Collect the scores of one sequence step by step; ``score_blank`` adds those of the blank and doubles the work."""

    metrics: Mapping[str, Metric]
    score_blank: bool = True
    values: dict[str, list[float]] = field(default_factory=dict)
    blank: dict[str, list[float]] = field(default_factory=dict)
    by_frame: list[dict[str, float]] = field(default_factory=list)
    frames: int = 0
    events: int = 0
    empty_windows: int = 0

    def add(self, step: Step) -> None:
        """Compare one step with its target."""
        self.frames += 1
        self.events += step.events
        self.empty_windows += step.events == 0
        if step.window.target is None or step.camera is None:
            return
        prediction, target = step.prediction.astype(np.float64), step.camera / 255.0
        scored: dict[str, float] = {"frame": self.frames - 1, "seconds": step.window.end, "events": step.events}
        self.by_frame.append(scored)
        for name, metric in self.metrics.items():
            scored[name] = metric(prediction, target)
            self.values.setdefault(name, []).append(scored[name])
            if self.score_blank:
                self.blank.setdefault(name, []).append(metric(np.full_like(target, target.mean()), target))

    def score(self, data_set: str, sequence: str, repaired_images: int) -> SequenceScore:
        """Return the means over the steps added so far."""
        means, blank = (
            {name: float(np.mean(each)) for name, each in kind.items()} for kind in (self.values, self.blank)
        )
        counts = (self.frames, self.events, self.empty_windows, repaired_images)
        return SequenceScore(data_set, sequence, *counts, means, blank, tuple(self.by_frame))


def mean_over_sequences(scores: Sequence[SequenceScore], *, blank: bool = False) -> dict[str, float]:
    """Return the unweighted mean of each metric that every sequence has; with ``blank``, of the blank pictures."""
    return mean_by_name([score.blank if blank else score.means for score in scores])


def mean_by_name(found: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Return the unweighted mean by name, of the names that all of ``found`` have."""
    names = [name for name in found[0] if all(name in means for means in found)] if found else []
    return {name: float(np.mean([means[name] for means in found])) for name in names}
