"""The settings that no other one dominates, the best setting for a wish, and the tables of `v2v-tradeoff`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from io import StringIO
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.table import Table

from v2v_protocol.errors import UsageError
from v2v_tools.motion import MOST_LOST

THRESHOLDS = (0.05, 0.2, 0.5, 1.0, 2.0)
"""Contrast thresholds at which errors are measured."""
ERROR_THRESHOLD = 0.2


class Measure(NamedTuple):
    """An error, as a share: its key in records, its title in tables, and what it is compared with."""

    key: str
    title: str
    reference: str


FORM = Measure(
    f"voxel_error_at_{ERROR_THRESHOLD:g}",
    "form",
    "voxels against those of the same setting from exactly decoded frames",
)
TRUE_RATE = (
    Measure(
        "voxel_error_at_the_true_rate", "true rate",
        "signed bins of a frame against the true ones, of frames of the clips that move as the clips do, rendered",
    ),
    Measure("split_error_at_the_true_rate", "split", "bins of both polarities against these"),
    Measure("count_error_at_the_true_rate", "count", "number of events against these"),
)  # fmt: skip
JUDGES = FORM, TRUE_RATE[0]
"""The errors that settings are judged by."""

Record = Mapping[str, Any]
Costs = tuple[float, ...]
"""Lower is better in each."""
_Columns = Sequence[tuple[str, str, str, float]]
"""Key of a record, title, format, and the factor from SI units to what is shown."""
_WIDTH = 200

BATCH = 12
"""Samples of the batch whose processor time is shown."""

_ERRORS: _Columns = (
    ("way", "per cent, at c", "{}", 1),
    *((f"voxel_error_at_{c:g}", f"voxels {c:g}", "{:.2f}", 100) for c in THRESHOLDS),
    *((f"count_error_at_{c:g}", f"count {c:g}", "{:+.2f}", 100) for c in (0.05, 0.2, 1)),
)
_SETTINGS: _Columns = (
    ("name", "", "{}", 1),
    ("samples_per_core_second", "samples/core s", "{:.2f}", 1),
    ("speed_ratio", "x first", "{:.2f}", 1),
    ("cpu_seconds_per_sample", "CPU s/batch", "{:.2f}", BATCH),
    ("bytes_ratio", "x disk", "{:.2f}", 1),
    ("bytes_per_video_second", "MB/s", "{:.2f}", 1e-6),
    *((each.key, each.title, "{:+.2f}" if each.title == "count" else "{:.2f}", 100) for each in (FORM, *TRUE_RATE)),
    ("dominated_by", "dominated by", "{}", 1),
)
_SPEEDS: _Columns = (
    ("way", "per cent, at the true rate", "{}", 1),
    ("px_per_frame", "px a frame", "{}", 1),
    ("events_share", "of all events", "{:.0f}", 100),
    *_SETTINGS[-4:-1],
)
_DIVERSITY: _Columns = (
    ("name", "correlation between", "{}", 1),
    ("course_correlation", "course", "{:.3f}", 1),
    ("effective_samples_of_2", "2 are worth", "{:.2f}", 1),
    ("effective_samples_of_4", "4 are worth", "{:.2f}", 1),
)


def dominates(one: Costs, other: Costs) -> bool:
    """Return whether ``one`` is nowhere worse and somewhere better."""
    return all(a <= b for a, b in zip(one, other, strict=True)) and one != other


def dominators(costs: Mapping[str, Costs]) -> dict[str, str | None]:
    """Return, for each name, the first one on the Pareto front that dominates it, or None on the front."""
    front = [name for name in costs if not any(dominates(other, costs[name]) for other in costs.values())]
    return {
        name: next((better for better in front if dominates(costs[better], own)), None) for name, own in costs.items()
    }


def name_dominated(records: Sequence[dict[str, Any]]) -> None:
    """Add to each setting's record a setting that dominates it in speed, errors, diversity and disk space, or None."""
    keys = ("cpu_seconds_per_sample", *(each.key for each in JUDGES), "samples_per_decode", "bytes_per_video_second")
    # Without events there is no relative error, and no form is worse than another.
    found = dominators(
        {r["name"]: tuple(math.inf if r[key] is None else float(r[key]) for key in keys) for r in records}
    )
    for record in records:
        record["dominated_by"] = found[record["name"]]


def error_of(record: Record) -> float:
    """Return the larger of the two errors that a setting is judged by; 0 where there are no events."""
    return max(record[each.key] or 0.0 for each in JUDGES)


def untold(records: Sequence[Record]) -> str:
    """Return why the error at the true rate of some settings cannot be told; "" where it can be."""
    lost = max((record["lost_share"] for record in records), default=0.0)
    if lost <= MOST_LOST:
        return ""
    return (
        f"the error at the true rate cannot be told: no block follows {lost:.0%} of the pixels that change, and the "
        f"limit is {MOST_LOST:.0%}; something small or fast moves, or light flickers: take videos with more frames a "
        "second"
    )


def reasons(record: Record) -> str:
    """Return the figures of a setting with what they are compared with, a line each."""
    errors = [f"{each.title} {record[each.key] or 0.0:.2%}: {each.reference}" for each in (FORM, *TRUE_RATE)]
    return "\n".join([f"{record['samples_per_core_second']:.3g} samples a core second", *errors])


def best(records: Sequence[Record], *, target_rate: float | None, max_error: float | None) -> Record:
    """Return the setting to take.

    Args:
        records: of the settings; each has "samples_per_core_second", "samples_per_decode" and those of JUDGES,
            which are None where there are no events. The larger of both is its error.
        target_rate: samples a core second. Take the smallest error at this rate or above; of equals the fewest samples
            per decode, then the fastest.
        max_error: without ``target_rate``, the largest error. Take the fastest within it; of equals the fewest samples
            per decode.

    Raises:
        UsageError: no setting fulfils the wish, and the message names the nearest; or an error cannot be told.
    """
    if why := untold(records):
        raise UsageError(f"no best setting: {why}")
    if target_rate is not None:
        fit = [record for record in records if record["samples_per_core_second"] >= target_rate]
        if not fit:
            most = max(record["samples_per_core_second"] for record in records)
            raise UsageError(
                f"--target-rate {target_rate:g}: the fastest setting makes {most:.3g} samples a core second"
            )
        return min(fit, key=lambda r: (error_of(r), r["samples_per_decode"], -r["samples_per_core_second"]))
    fit = [record for record in records if max_error is None or error_of(record) <= max_error]
    if not fit:
        least = min(map(error_of, records))
        raise UsageError(f"--max-error {max_error:g}: the smallest error of a setting is {least:.3g}")
    return min(fit, key=lambda r: (-r["samples_per_core_second"], r["samples_per_decode"]))


def error_fields(sums: npt.NDArray[np.float64]) -> dict[str, float | None]:
    """Return voxel and count error at every contrast threshold; None where the reference has no events.

    Args:
        sums: [thresholds, 3], see :func:`v2v_tools.tradeoff.measures.compare`.
    """
    fields: dict[str, float | None] = {}
    for threshold, (difference, events, reference) in zip(THRESHOLDS, sums.tolist(), strict=True):
        fields[f"voxel_error_at_{threshold:g}"] = difference / reference if reference else None
        fields[f"count_error_at_{threshold:g}"] = (events - reference) / reference if reference else None
    return fields


def tables(records: Sequence[Record]) -> str:
    """Return the settings, their errors, and the diversity as text."""
    of = {kind: [r for r in records if r["measure"] == kind] for kind in ("setting", "scale", "speed", "diversity")}
    numbers = {record["name"]: f"{number}" for number, record in enumerate(of["setting"], 1)}
    listed = [
        {**record, "name": f"{numbers[record['name']]:>2s}  {record['name']}",
         "dominated_by": numbers.get(record["dominated_by"])}
        for record in of["setting"]
    ]  # fmt: skip
    ways = list({record["way"]: record for record in reversed(of["setting"])}.values())[::-1]
    errors = "; ".join(f"{each.title}, {each.reference}" for each in (FORM, *TRUE_RATE))
    about = (
        f"CPU s/batch: of {BATCH} samples; x disk: of the source; MB/s: of video. Errors in per cent at c = "
        f"{ERROR_THRESHOLD:g}: {errors}\n{untold(of['setting'])}"
    )
    parts = [format_table(listed, _SETTINGS) + about, format_table([*ways, *of["scale"]], _ERRORS)]
    if of["speed"]:
        parts.append(format_table(of["speed"], _SPEEDS))
    if of["diversity"]:
        parts.append(format_table(of["diversity"], _DIVERSITY))
    return "\n".join(parts)


def format_table(records: Sequence[Record], columns: _Columns) -> str:
    """Format records as a table; a missing value is a dash."""
    table = Table(box=None, pad_edge=False)
    for number, (_, title, _, _) in enumerate(columns):
        table.add_column(title, justify="right" if number else "left", no_wrap=True)
    for record in records:
        cells = ((record.get(key), form, factor) for key, _, form, factor in columns)
        table.add_row(
            *(
                "-" if value is None else form.format(value if factor == 1 else value * factor)
                for value, form, factor in cells
            )
        )
    text = StringIO()
    Console(file=text, width=_WIDTH, highlight=False).print(table)
    return text.getvalue()
