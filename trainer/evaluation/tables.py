"""Format scores as tables with the paper's results, and as flat records for ``--json``."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.markup import escape
from rich.table import Table

from trainer.evaluation import paper
from trainer.evaluation.data_sets import DataSet
from trainer.evaluation.metrics import METRICS
from trainer.evaluation.score import SequenceScore, mean_over_sequences
from v2v_protocol.errors import UsageError
from v2v_protocol.write_aside import write_aside_and_rename


def table(data_set: DataSet, scores: Sequence[SequenceScore], compared: Sequence[str]) -> Table:
    """Format the scores of a data set.

    Args:
        compared: methods of :data:`trainer.evaluation.paper.RESULTS` to show below, if they have the data set.
    """
    means = mean_over_sequences(scores)
    names = list(dict.fromkeys(name for score in scores for name in score.means))
    # Escaped, because rich would remove names in brackets as markup.
    rows = Table(title=escape(data_set.name), title_justify="left")
    rows.add_column("sequence", no_wrap=True)
    rows.add_column("frames", justify="right")
    for name in names:
        rows.add_column(METRICS[name].title, justify="right")
    for score in scores:
        rows.add_row(escape(score.sequence), str(score.frames), *(_number(score.means, name) for name in names))
    if not names:
        return rows
    rows.add_section()
    whole = "" if len(scores) == len(data_set.time_ranges) else f" of {len(scores)} of {len(data_set.time_ranges)}"
    rows.add_row(f"mean{whole}", "", *(_number(means, name) for name in names), style="bold")
    rows.add_row("constant grey", "", *(_number(mean_over_sequences(scores, blank=True), name) for name in names))
    for method in compared:
        published = paper.RESULTS.get(method, {}).get(data_set.name)
        if published is not None:
            rows.add_row(f"paper: {method}", "", *(_number(published, name) for name in names), style="dim")
    return rows


def _number(values: Mapping[str, float], name: str) -> str:
    return f"{values[name]:.3f}" if name in values else "-"


def write_frames(file: Path, scores_by_set: Mapping[str, Sequence[SequenceScore]]) -> None:
    """Write a CSV file with one line per scored window.

    Its columns are data set, sequence, number of the window, its end in seconds of the recording's clock, its number of
    events, and each metric.

    Raises:
        UsageError: the file cannot be written.
    """
    try:
        with write_aside_and_rename(file) as partial, partial.open("w", newline="", encoding="utf-8") as out:
            lines: Any = None
            for name, scores in scores_by_set.items():
                for score in scores:
                    for scored in score.by_frame:
                        line = {"data_set": name, "sequence": score.sequence, **scored}
                        if lines is None:
                            lines = csv.DictWriter(out, list(line))
                            lines.writeheader()
                        lines.writerow(line)
    except OSError as error:
        raise UsageError(f"--per-frame {file}: {error.strerror}") from error


def records(scores_by_set: Mapping[str, Sequence[SequenceScore]], settings: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return a flat record per sequence, and one per data set (``sequence`` None) with the mean over its sequences.

    Args:
        scores_by_set: scores by name of the data set.
        settings: settings of the run, repeated in every record.
    """
    flat: list[dict[str, Any]] = []
    for name, scores in scores_by_set.items():
        for score in scores:
            flat.append(
                {
                    "data_set": name,
                    "sequence": score.sequence,
                    "sequences": 1,
                    "frames": score.frames,
                    "events": score.events,
                    "empty_windows": score.empty_windows,
                    "repaired_images": score.repaired_images,
                    **score.means,
                    **{f"constant_grey_{name}": value for name, value in score.blank.items()},
                    **settings,
                }
            )
        flat.append(
            {
                "data_set": name,
                "sequence": None,
                "sequences": len(scores),
                "frames": sum(score.frames for score in scores),
                "events": sum(score.events for score in scores),
                "empty_windows": sum(score.empty_windows for score in scores),
                "repaired_images": sum(score.repaired_images for score in scores),
                **mean_over_sequences(scores),
                **settings,
            }
        )
    return flat
