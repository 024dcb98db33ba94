"""Scores: means over the frames of a sequence, and over the sequences of a data set without weights (the paper's)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from trainer.evaluation.metrics import Metric
from trainer.evaluation.reconstruct import Step


@dataclass(frozen=True)
class SequenceScore:
    """One sequence.

    Attributes:
        data_set, sequence: names.
        frames: windows reconstructed.
        events: in them.
        empty_windows: windows without an event.
        repaired_images: time stamps that were mended.
        means: mean over the frames by metric; empty where there was nothing to compare with.
    """

    data_set: str
    sequence: str
    frames: int
    events: int
    empty_windows: int
    repaired_images: int
    means: Mapping[str, float]


@dataclass
class SequenceScorer:
    """Takes the steps of one sequence."""

    metrics: Mapping[str, Metric]
    values: dict[str, list[float]] = field(default_factory=dict)
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
        for name, metric in self.metrics.items():
            self.values.setdefault(name, []).append(metric(prediction, target))

    def score(self, data_set: str, sequence: str, repaired_images: int) -> SequenceScore:
        """The means."""
        means = {name: float(np.mean(values)) for name, values in self.values.items()}
        return SequenceScore(data_set, sequence, self.frames, self.events, self.empty_windows, repaired_images, means)


def mean_over_sequences(scores: Sequence[SequenceScore]) -> dict[str, float]:
    """Unweighted mean by metric, of the metrics that every sequence has."""
    names = [name for name in scores[0].means if all(name in score.means for score in scores)] if scores else []
    return {name: float(np.mean([score.means[name] for score in scores])) for name in names}
