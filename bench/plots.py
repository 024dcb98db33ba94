"""Draw with matplotlib into a file, without a screen."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@contextmanager
def panels(file: Path, count: int, *, title: str, height_inches: float = 4.0) -> Iterator[Sequence[Axes]]:
    """Yield axes side by side; write the PNG when the block ends without an error."""
    import matplotlib  # lazily: a bench without --plot must not need it

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
