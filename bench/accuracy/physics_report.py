"""The records of ``v2v-bench physics``, for people: tables and a picture."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

Records = list[dict[str, Any]]
MOTION_PX = (0.0, 0.25, 1.0, 4.0, math.inf)
"""Ends of the classes that a film's bins are told apart by: motion from one frame to the next, px."""


def tables(records: Records) -> Iterator[str]:
    """The records, for people."""
    yield "analytic scenes, c = 0.2: count error / voxel error\n"
    chosen = [r for r in records if r["measure"] == "analytic"]
    rates = dict.fromkeys(r["frame_rate_hz"] for r in chosen)
    yield f"{'scene':48s}{'events':>9s}" + "".join(f"{rate} fps".rjust(18) for rate in rates)
    for name in dict.fromkeys(r["scene"] for r in chosen):
        row = [r for r in chosen if r["scene"] == name]
        yield f"{name:48s}{row[0]['events_true']:9d}" + "".join(map(_cell, row))
    for reference in ("light", "8-bit frames"):
        yield f"\nmoved photographs against the {reference}: count error / voxel error, by threshold\n"
        chosen = [r for r in records if r.get("reference") == reference]
        yield f"{'px a frame':>10s}{'fps':>7s}" + "".join(f"c = {c:g}".rjust(18) for c in _thresholds(chosen))
        for motion, rate in sorted({(r["motion_px_per_frame"], r["frame_rate_hz"]) for r in chosen}):
            row = [r for r in chosen if r["motion_px_per_frame"] == motion and r["frame_rate_hz"] == rate]
            yield f"{motion:10.2f}{rate:7.0f}" + "".join(_cell(r) for r in row)
    chosen = [r for r in records if r["measure"] == "film"]
    for name in dict.fromkeys(r["video"] for r in chosen):
        yield f"\n{name} from every n-th frame: count error / voxel error, by threshold\n"
        yield f"{'n':>10s}{'fps':>7s}" + "".join(f"c = {c:g}".rjust(18) for c in _thresholds(chosen))
        for every in sorted({r["every"] for r in chosen}):
            row = [r for r in chosen if r["video"] == name and r["every"] == every]
            yield f"{every:10d}{row[0]['frame_rate_hz']:7.0f}" + "".join(_cell(r) for r in row)
        yield "\nthe same, voxel error at c = 0.2 by motion over n frames (share of the bins)\n"
        ends = list(itertools.pairwise(MOTION_PX))
        yield f"{'n':>10s}" + "".join(f"{low:g} to {high:g} px".rjust(18) for low, high in ends)
        for r in (r for r in chosen if r["video"] == name and r["threshold"] == 0.2):
            counts = [r[f"bins_of_{low:g}_to_{high:g}_px_per_frame"] for low, high in ends]
            shares = [r[f"voxel_error_of_{low:g}_to_{high:g}_px_per_frame"] for low, high in ends]
            yield f"{r['every']:10d}" + "".join(
                f"{_percent(share)} ({count / sum(counts):.0%})".rjust(18)
                for share, count in zip(shares, counts, strict=True)
            )
    for r in (r for r in records if r["measure"] == "recorded"):
        yield f"\nreal events, {r['part']}, gamma {r['gamma']:g}: {r['events_real']:.0f} in {r['seconds'] * 1e3:.0f} ms"
        yield f"    V2V fires as many at c = {r['threshold_of_equal_count']:.3f} ({r['events_v2v']:.0f})"
        yield f"    rising: real {r['rising_share_real']:.0%}, V2V {r['rising_share_v2v']:.0%}"
        yield f"    active pixels: real {r['active_pixels_real']:.1%}, V2V {r['active_pixels_v2v']:.1%}"
        yield f"    of the real events {1 - r['real_net_over_gross']:.0%} cancel at their own pixel"
        yield f"    correlation of counts {r['correlation_of_counts']:.2f}, of signed counts " + (
            f"{r['correlation_of_signed_counts']:.2f}, control (mirrored) {r['correlation_control_mirrored']:.2f}"
        )


def _thresholds(records: Records) -> list[float]:
    return sorted({r["threshold"] for r in records})


def _cell(record: dict[str, Any]) -> str:
    # Where every true bin is zero there is nothing to relate the error to.
    voxel_error = record["voxel_error"] if record["voxel_net_true"] else None
    return f"{_percent(record['count_error'])} / {_percent(voxel_error)}".rjust(18)


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{share:.1%}"


def plot(records: Records, path: Path) -> None:
    """Errors against frame rate and motion."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, 3, figsize=(11.5, 3.6), sharey=True)
    chosen = [r for r in records if r["measure"] == "analytic" and not r["monotone"] and r["voxel_net_true"]]
    for name in dict.fromkeys(r["scene"] for r in chosen):
        row = [r for r in chosen if r["scene"] == name]
        axes[0].plot([r["frame_rate_hz"] for r in row], [r["voxel_error"] for r in row], "o-", ms=3, label=name)
    axes[0].set(title="formulas, c = 0.2", xlabel="frames a second")
    axes[0].set_ylabel("voxel error")
    figure.suptitle("Voxel error of frames against an exact sensor")
    chosen = [r for r in records if r.get("reference") == "light"]
    chosen = [r for r in chosen if r["every"] == max(r["every"] for r in chosen)]
    for number, threshold in enumerate(_thresholds(chosen)):
        row = sorted((r for r in chosen if r["threshold"] == threshold), key=lambda r: r["motion_px_per_frame"])
        motion = [r["motion_px_per_frame"] for r in row]
        axes[1].plot(motion, [r["voxel_error"] for r in row], f"C{number}o-", ms=3, label=f"c = {threshold:g}")
        axes[1].plot(motion, [-r["count_error"] for r in row], f"C{number}--", lw=1)
    axes[1].set(title="photographs at 25 fps (dashed: events lost)", xlabel="motion, px a frame")
    chosen = [r for r in records if r["measure"] == "film"]
    for threshold in _thresholds(chosen):
        row = [r for r in chosen if r["threshold"] == threshold and r["every"] > 1]
        if row:
            rates = [r["frame_rate_hz"] for r in row]
            axes[2].plot(rates, [r["voxel_error"] for r in row], "o-", ms=3, label=f"c = {threshold:g}")
    axes[2].set(title="film" if chosen else "no film", xlabel="frames a second")
    for axis in axes:
        axis.set(xscale="log", yscale="log", ylim=(1e-4, 3))
        axis.grid(alpha=0.3)
        if axis.has_data():
            axis.legend(fontsize=6)
    rates = sorted({r["frame_rate_hz"] for r in chosen if r["every"] > 1})
    axes[2].set_xticks(rates, [f"{rate:.0f}" for rate in rates])
    axes[2].set_xticks([], minor=True)
    figure.tight_layout()
    figure.savefig(path, dpi=90)
    pyplot.close(figure)
