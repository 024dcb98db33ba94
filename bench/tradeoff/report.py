"""Records, tables and the plot of the trade-off."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from bench import plots
from bench.records import Column, Record, show
from bench.tradeoff.errors import Tally
from bench.tradeoff.front import dominators
from bench.tradeoff.other import BASE, KERNEL, Knob
from bench.tradeoff.speed import Speed

ERROR_THRESHOLD = 0.2
ERROR_KEY = f"voxel_error_at_{ERROR_THRESHOLD:g}"
"""The error that settings are judged by."""

_COLORS = {1: "tab:blue", 2: "tab:orange", 4: "tab:green"}
_MARKERS = "osD^v<>PX*hd"

_ERRORS: tuple[Column, ...] = (
    *((f"voxel_error_at_{c:g}", f"L1 {c:g}", "{:.2f}", 100) for c in (0.05, 0.2, 0.5, 1, 2)),
    *((f"count_error_at_{c:g}", f"count {c:g}", "{:+.2f}", 100) for c in (0.05, 0.2, 1)),
    *((f"bins_changed_at_{c:g}", f"bins {c:g}", "{:.2f}", 100) for c in (0.2,)),
    *((f"rising_share_at_{c:g}", f"rising {c:g}", "{:.2f}", 100) for c in (0.2,)),
)
_DECODINGS: tuple[Column, ...] = (
    ("form", "per cent, at c", "{}", 1),
    *_ERRORS,
    *((f"events_on_still_at_{c:g}", f"still {c:g}", "{:.2f}", 1000) for c in (0.05, 0.2, 1)),
)
_SETTINGS: tuple[Column, ...] = (
    ("name", "", "{}", 1),
    ("samples_per_core_second", "samples/core s", "{:.2f}", 1),
    ("speed_ratio", "x exact", "{:.2f}", 1),
    ("cpu_seconds_per_sample", "CPU ms", "{:.1f}", 1e3),
    ("median_cpu_seconds_per_sample", "median", "{:.1f}", 1e3),
    ("bytes_ratio", "size", "{:.2f}", 1),
    ("bytes_per_video_second", "MB/s", "{:.2f}", 1e-6),
    (ERROR_KEY, f"L1 {ERROR_THRESHOLD:g}", "{:.2f}", 100),
    ("dominated_by", "dominated by", "{}", 1),
)
_OTHERS: tuple[Column, ...] = (
    ("name", "", "{}", 1),
    ("cpu_seconds_change_per_sample", "CPU ms", "{:+.2f}", 1e3),
    ("share_of_exact_sample", "of exact %", "{:+.1f}", 100),
    *_ERRORS,
    ("endpoint_error_px", "flow px", "{:.3f}", 1),
    ("size_ratio", "size", "{:.3f}", 1),
    ("bins_clipped_share", "clipped ppm", "{:.0f}", 1e6),
)
_DIVERSITY: tuple[Column, ...] = (
    ("name", "correlation between", "{}", 1),
    ("pairs", "pairs", "{}", 1),
    ("pixel_correlation", "pixels", "{:.3f}", 1),
    ("course_correlation", "course", "{:.3f}", 1),
    ("course_correlation_beyond_batch", "beyond batch", "{:.3f}", 1),
    ("crop_overlap", "crops shared", "{:.2f}", 1),
    ("effective_samples_of_2", "2 are worth", "{:.2f}", 1),
    ("effective_samples_of_4", "4 are worth", "{:.2f}", 1),
)


def error_fields(tallies: Mapping[float, Tally]) -> dict[str, Any]:
    """Flat: the measures at every contrast threshold."""
    flat: dict[str, Any] = {}
    for threshold, tally in tallies.items():
        flat |= {
            f"voxel_error_at_{threshold:g}": tally.voxel_error,
            f"count_error_at_{threshold:g}": tally.count_error,
            f"bins_changed_at_{threshold:g}": tally.changed_share,
            f"rising_share_at_{threshold:g}": tally.rising_share,
            f"reference_rising_share_at_{threshold:g}": tally.reference_rising_share,
        }
    return flat


def name_dominated(records: Sequence[dict[str, Any]]) -> None:
    """Writes into each setting's record which one is at least as fast, as right, as diverse and as small, and better in
    one."""
    keys = ("cpu_seconds_per_sample", ERROR_KEY, "samples_per_decode", "bytes_per_video_second")
    costs = {record["name"]: tuple(float(record[key]) for key in keys) for record in records}
    found = dominators(costs)
    for record in records:
        record["dominated_by"] = found[record["name"]]


def other_records(knobs: Mapping[str, Knob], speeds: Mapping[str, Speed]) -> list[dict[str, Any]]:
    """Records of the knobs that change something else than the decoded pixels."""
    exact = speeds[BASE].fastest
    records = []
    for name, knob in knobs.items():
        own = speeds[name].fastest
        change = own - (speeds[knob.beside].fastest if knob.beside else 0.0)
        record = {
            "measure": "other",
            "name": name,
            "cpu_seconds": own,
            "median_cpu_seconds": speeds[name].median,
            "rounds": speeds[name].rounds,
            "cpu_seconds_change_per_sample": None if name in (BASE, KERNEL) else change,
            "share_of_exact_sample": own / exact if name in (BASE, KERNEL) else change / exact,
            **error_fields(knob.errors),
            **knob.figures,
        }
        if record.pop("only_rates_compare", False):
            record |= {key: None for key in record if key.startswith(("voxel_error", "bins_changed"))}
        records.append(record)
    return records


def print_tables(records: Sequence[Record]) -> None:
    """What is measured, as four tables."""
    of = {kind: [r for r in records if r["measure"] == kind] for kind in ("setting", "scale", "other", "diversity")}
    ways = [record for record in of["setting"] if record["samples_per_decode"] == 1]
    show([*ways, *({**record, "form": record["name"]} for record in of["scale"])], _DECODINGS)
    print("L1: voxel error; still: events a pixel in 1000 frames of a still scene, no noise")
    print()
    show(of["setting"], _SETTINGS)
    print("size: of the source's; MB/s: of video")
    print()
    show(of["other"], _OTHERS)
    print("CPU ms: more than what it replaces; compression: on top of a sample")
    print()
    show(of["diversity"], _DIVERSITY)


def plot(records: Sequence[Record], file: Path) -> None:
    """Speed against error and against disk: a marker for each form of the corpus, a colour for each number of samples
    per decode; hollow where dominated."""
    shown = [record for record in records if record["measure"] == "setting"]
    scale = {record["name"]: record[ERROR_KEY] for record in records if record["measure"] == "scale"}
    markers = dict(zip(dict.fromkeys(record["form"] for record in shown), _MARKERS, strict=False))
    speeds = [record["samples_per_core_second"] for record in shown]
    with plots.panels(file, 2, title="Speed against error and disk space", height_inches=5.5) as (axes, disk):
        for record in shown:
            color = _COLORS[record["samples_per_decode"]]
            for into, height in ((axes, 100 * record[ERROR_KEY]), (disk, record["bytes_per_video_second"] / 1e6)):
                into.scatter(
                    record["samples_per_core_second"],
                    height,
                    marker=markers[record["form"]],
                    facecolors=color if record["dominated_by"] is None else "none",
                    edgecolors=color,
                    s=40,
                    zorder=3,
                    clip_on=False,
                )
        for decoding, marker in markers.items():
            axes.scatter([], [], marker=marker, color="grey", label=decoding)
        for count, color in _COLORS.items():
            axes.scatter([], [], marker="s", color=color, label=f"{count} sample{'s' * (count > 1)} per decode")
        for name, error in scale.items():
            if error is not None:
                axes.axhline(100 * error, linestyle="--", linewidth=0.8, color="grey")
                axes.annotate(
                    name, (0, 100 * error), xycoords=("axes fraction", "data"), xytext=(4, 3),
                    textcoords="offset points", fontsize=8, color="grey",
                )  # fmt: skip
        axes.set_ylabel(f"voxel error at c = {ERROR_THRESHOLD:g}, per cent")
        disk.set_ylabel("disk, MB a second of video")
        for each in (axes, disk):
            each.set_ylim(bottom=0)
            plots.whole_number_axis(each, _ticks(min(speeds), max(speeds)), "samples a second of processor time")
            each.grid(alpha=0.3)
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.12), ncols=3, fontsize=8, title="hollow: dominated")


def _ticks(low: float, high: float) -> list[float]:
    """1, 2 and 5 times powers of ten, from just below the lowest value to just above the highest."""
    every = [step * 10.0**power for power in range(-4, 7) for step in (1, 2, 5)]
    first = max(tick for tick in every if tick <= low)
    last = min(tick for tick in every if tick >= high)
    return [int(tick) if tick >= 1 else tick for tick in every if first <= tick <= last]
