"""Scores as tables beside the paper's, and as flat records for ``--json``."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.markup import escape
from rich.table import Table

from trainer.evaluation import paper
from trainer.evaluation.data_sets import DataSet
from trainer.evaluation.score import SequenceScore, mean_over_sequences
from v2v_protocol.errors import UsageError

TITLES = {
    "mse": "MSE",
    "ssim_range2": "SSIM (range 2)",
    "ssim": "SSIM",
    "correlation": "correlation",
    "lpips_alex": "LPIPS alex",
    "lpips_squeeze": "LPIPS squeeze",
    "lpips_vgg": "LPIPS vgg",
}


def table(data_set: DataSet, scores: Sequence[SequenceScore], compared: Sequence[str]) -> Table:
    """
    Args:
        data_set: the one whose scores these are.
        scores: of its sequences.
        compared: methods of :data:`trainer.evaluation.paper.RESULTS` to show below; shown where it has the data set.
    """
    means = mean_over_sequences(scores)
    names = list(dict.fromkeys(name for score in scores for name in score.means))
    # Names in brackets would be taken for markup, and left out.
    made = Table(title=escape(data_set.name), title_justify="left")
    made.add_column("sequence", no_wrap=True)
    made.add_column("frames", justify="right")
    for name in names:
        made.add_column(TITLES[name], justify="right")
    for score in scores:
        made.add_row(escape(score.sequence), str(score.frames), *(_number(score.means, name) for name in names))
    if not names:
        return made
    made.add_section()
    whole = "" if len(scores) == len(data_set.time_ranges) else f" of {len(scores)} of {len(data_set.time_ranges)}"
    made.add_row(f"mean{whole}", "", *(_number(means, name) for name in names), style="bold")
    made.add_row("constant grey", "", *(_number(mean_over_sequences(scores, blank=True), name) for name in names))
    for method in compared:
        published = paper.RESULTS.get(method, {}).get(data_set.name)
        if published is not None:
            made.add_row(f"paper: {method}", "", *(_number(published, name) for name in names), style="dim")
    return made


def _number(values: Mapping[str, float], name: str) -> str:
    return f"{values[name]:.3f}" if name in values else "-"


def write_frames(file: Path, scores_by_set: Mapping[str, Sequence[SequenceScore]]) -> None:
    """One line a window that was scored, CSV: data set, sequence, number of the window, its end in seconds of the
    recording's clock, its events, and each metric.

    Raises:
        UsageError: it cannot be written.
    """
    try:
        with file.open("w", newline="", encoding="utf-8") as out:
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
    """One flat record a sequence, and one a data set (``sequence`` null) with the mean over its sequences.

    Args:
        scores_by_set: scores by name of the data set.
        settings: of the run; repeated in every record.
    """
    made: list[dict[str, Any]] = []
    for name, scores in scores_by_set.items():
        for score in scores:
            made.append(
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
        made.append(
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
    return made
