"""Records, tables and the plot of `v2v-tradeoff`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from io import StringIO
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from v2v_protocol.errors import UsageError
from v2v_protocol.write_aside import write_aside_and_rename
from v2v_tools.tradeoff.errors import Tally
from v2v_tools.tradeoff.front import dominators
from v2v_tools.tradeoff.settings import SAMPLES_PER_DECODE

ERROR_THRESHOLD = 0.2
ERROR_KEY = f"voxel_error_at_{ERROR_THRESHOLD:g}"
"""The error that settings are judged by."""

Record = Mapping[str, Any]
_Columns = Sequence[tuple[str, str, str, float]]
"""Key of a record, title, format, and the factor from SI units to what is shown."""
_WIDTH = 200
_MARKERS = dict(zip(SAMPLES_PER_DECODE, "o^s", strict=True))

BATCH = 12
"""Samples of the batch whose processor time is shown."""

_ERRORS: _Columns = (
    ("way", "per cent, at c", "{}", 1),
    *((f"voxel_error_at_{c:g}", f"voxels {c:g}", "{:.2f}", 100) for c in (0.05, 0.2, 0.5, 1, 2)),
    *((f"count_error_at_{c:g}", f"count {c:g}", "{:+.2f}", 100) for c in (0.05, 0.2, 1)),
    ("bins_changed_at_0.2", "bins 0.2", "{:.2f}", 100),
)
_SETTINGS: _Columns = (
    ("name", "", "{}", 1),
    ("samples_per_core_second", "samples/core s", "{:.2f}", 1),
    ("speed_ratio", "x first", "{:.2f}", 1),
    ("cpu_seconds_per_sample", "CPU s/batch", "{:.2f}", BATCH),
    ("bytes_ratio", "x disk", "{:.2f}", 1),
    ("bytes_per_video_second", "MB/s", "{:.2f}", 1e-6),
    (ERROR_KEY, f"voxels {ERROR_THRESHOLD:g}", "{:.2f}", 100),
    ("dominated_by", "dominated by", "{}", 1),
)
_PARTS: _Columns = (
    ("way", "CPU ms of a sample, from the source", "{}", 1),
    ("decode_seconds", "decode, motion", "{:.1f}", 1e3),
    ("view_seconds", "view, levels", "{:.1f}", 1e3),
    ("kernel_seconds", "kernel", "{:.1f}", 1e3),
    ("substeps_per_step", "sub-steps a step", "{:.2f}", 1),
)
_DIVERSITY: _Columns = (
    ("name", "correlation between", "{}", 1),
    ("pairs", "pairs", "{}", 1),
    ("pixel_correlation", "pixels", "{:.3f}", 1),
    ("course_correlation", "course", "{:.3f}", 1),
    ("effective_samples_of_2", "2 are worth", "{:.2f}", 1),
    ("effective_samples_of_4", "4 are worth", "{:.2f}", 1),
)


def error_fields(tallies: Mapping[float, Tally]) -> dict[str, Any]:
    """Return the measures at every contrast threshold, flat."""
    flat: dict[str, Any] = {}
    for threshold, tally in tallies.items():
        flat |= {
            f"voxel_error_at_{threshold:g}": tally.voxel_error,
            f"count_error_at_{threshold:g}": tally.count_error,
            f"bins_changed_at_{threshold:g}": tally.changed_share,
        }
    return flat


def name_dominated(records: Sequence[dict[str, Any]]) -> None:
    """Add to each setting's record a setting that dominates it in speed, errors, diversity and disk space, or None."""
    keys = ("cpu_seconds_per_sample", ERROR_KEY, "samples_per_decode", "bytes_per_video_second")
    # Without events there is no relative error, and no form is worse than another.
    found = dominators(
        {r["name"]: tuple(math.inf if r[key] is None else float(r[key]) for key in keys) for r in records}
    )
    for record in records:
        record["dominated_by"] = found[record["name"]]


def tables(records: Sequence[Record]) -> str:
    """Return the settings, their errors, the parts of a sample, and the diversity as text."""
    of = {kind: [r for r in records if r["measure"] == kind] for kind in ("setting", "scale", "parts", "diversity")}
    numbers = {record["name"]: f"{number}" for number, record in enumerate(of["setting"], 1)}
    listed = [
        {**record, "name": f"{numbers[record['name']]:>2s}  {record['name']}",
         "dominated_by": numbers.get(record["dominated_by"])}
        for record in of["setting"]
    ]  # fmt: skip
    fewest = min((record["samples_per_decode"] for record in of["setting"]), default=1)
    ways = [record for record in of["setting"] if record["samples_per_decode"] == fewest]
    effects = dict.fromkeys(key.removesuffix("_share") for record in of["parts"] for key in record if "_share" in key)
    of_effects = [
        column
        for name in effects
        for column in (
            (f"{name}_seconds", name.rsplit("_", 1)[0], "{:.1f}", 1e3),
            (f"{name}_share", "%", "{:.0f}", 100),
        )
    ]
    about = (
        f"CPU s/batch: of {BATCH} samples; x disk: of the source; MB/s: of video; voxels: error against the full "
        "model, per cent\n"
    )
    parts = [
        format_table(listed, _SETTINGS) + about,
        format_table([*ways, *of["scale"]], _ERRORS),
        format_table(of["parts"], (*_PARTS, *of_effects)) + "%: samples in which the effect ran\n",
    ]
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


def plot(records: Sequence[Record], file: Path) -> None:
    """Draw speed against voxel error: a line for each way to make samples, a marker for each K.

    Raises:
        UsageError: matplotlib is not installed, or the file cannot be written.
    """
    try:
        import matplotlib

        matplotlib.use("Agg")
        from matplotlib import pyplot
    except ImportError as error:
        raise UsageError("--plot needs matplotlib, which is not installed: pip install matplotlib") from error
    shown = [record for record in records if record["measure"] == "setting"]
    alike: Record = next((record for record in records if record.get("name") == "siblings"), {})
    figure, axes = pyplot.subplots(figsize=(12.0, 5.5))
    try:
        for way in dict.fromkeys(record["way"] for record in shown):
            of = [record for record in shown if record["way"] == way]
            points = [(r["samples_per_core_second"], 100 * (r[ERROR_KEY] or 0.0)) for r in of]
            label = f"{way}, {of[0]['bytes_ratio']:.1f}x disk"
            (line,) = axes.plot(*zip(*points, strict=True), "-", lw=1, marker="s", markersize=3, label=label)
            for record, point in zip(of, points, strict=True):
                axes.plot(*point, _MARKERS[record["samples_per_decode"]], color=line.get_color(), clip_on=False)
        for count, marker in _MARKERS.items():
            worth = alike.get(f"effective_samples_of_{count}")
            label = f"{count} sample{'s' * (count > 1)} a decode" + (f", worth {worth:.1f}" if worth else "")
            axes.plot([], [], marker, color="grey", label=label)
        axes.set_title("What speed costs: right is faster, down is more accurate")
        axes.set(xscale="log", xlabel="samples a second of processor time", ylabel="voxel error at c = 0.2, per cent")
        axes.set_ylim(bottom=0, top=1.35 * max(1.0, axes.get_ylim()[1]))
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8, title="worth: independent samples", loc="upper left", bbox_to_anchor=(1.0, 1.0))
        figure.tight_layout()
        with write_aside_and_rename(file) as partial:
            figure.savefig(partial, dpi=110, format=file.suffix[1:].lower())
    except OSError as error:
        raise UsageError(f"--plot {file}: cannot be written: {error.strerror or error}") from error
    finally:
        pyplot.close(figure)
