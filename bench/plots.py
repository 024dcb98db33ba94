"""Drawing that the measuring commands share: matplotlib into a file, without a screen."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@contextmanager
def panels(file: Path, count: int = 1, *, title: str, height_inches: float = 4.0) -> Iterator[Sequence[Axes]]:
    """Axes side by side; the picture is written when the block ends without an error.

    Args:
        file: PNG to write.
        count: number of panels.
        title: of the picture.
        height_inches: of the picture.
    """
    # Only where a picture is asked for: measuring needs no matplotlib.
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, count, figsize=(2.2 + 4.6 * count, height_inches), squeeze=False)
    try:
        figure.suptitle(title)
        yield list(axes[0])
        figure.tight_layout()
        figure.savefig(file, dpi=110)
    finally:
        pyplot.close(figure)


def bars(axes: Axes, values: Mapping[str, float], label: str, *, form: str = "{:.3g}", log: bool = False) -> None:
    """Horizontal bars, the first on top, each with its number.

    Args:
        values: length of each bar, by name.
        label: of the value axis, with its unit.
        form: of the numbers.
        log: whether the axis is logarithmic.
    """
    names = list(values)
    drawn = axes.barh(names, [values[name] for name in names])
    axes.bar_label(drawn, labels=[form.format(values[name]) for name in names], padding=3)
    axes.invert_yaxis()
    axes.set_xlabel(label)
    axes.margins(x=0.2)
    if log:
        axes.set_xscale("log")


def stacked_bars(
    axes: Axes, parts: Mapping[str, Mapping[str, float]], label: str, *, limits: Mapping[str, float] | None = None
) -> None:
    """Horizontal bars made of parts.

    Args:
        parts: length of each part, by bar, by name of the part; every bar has the same parts.
        label: of the value axis, with its unit.
        limits: vertical lines, by what they say.
    """
    names = list(parts)
    left = dict.fromkeys(names, 0.0)
    for part in parts[names[0]]:
        axes.barh(names, [parts[name][part] for name in names], left=[left[name] for name in names], label=part)
        left = {name: left[name] + parts[name][part] for name in names}
    for (text, at), color in zip((limits or {}).items(), ("black", "grey", "red"), strict=False):
        axes.axvline(at, linestyle="--", linewidth=1.0, color=color, label=text)
    axes.invert_yaxis()
    axes.set_xlabel(label)
    axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3)


def line(axes: Axes, points: Mapping[float, float], label: str, *, style: str = "o-") -> None:
    """One line through its points, which are marked."""
    axes.plot(list(points), list(points.values()), style, label=label)


def whole_number_axis(axes: Axes, values: Sequence[Any], label: str) -> None:
    """A horizontal axis, of powers of two mostly, with a tick at each value."""
    axes.set_xscale("log", base=2)
    axes.set_xticks(list(values), [str(value) for value in values])
    axes.minorticks_off()
    axes.set_xlabel(label)
