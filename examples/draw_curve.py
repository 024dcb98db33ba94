"""Draw the log of a training run: its smoothed loss, and the loss of the held-out batch.

    python examples/draw_curve.py runs/firenet-cpu curve.png
    python examples/draw_curve.py runs/a runs/b curve.png --of lpips

Several runs are drawn one after another, as if each had started with the weights of the one before. A part of the loss,
such as `--of lpips`, can be compared between runs that weight it differently.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from trainer.run.reporting import METRICS_FILE, read_metrics

SHARE = 0.05
"""Weight of a new reading in the smoothed loss."""


def curves(runs: Sequence[Path], part: str = "total") -> tuple[dict[float, float], dict[float, float]]:
    """Return the smoothed training loss (or a part of it) and the held-out loss, by step."""
    training: dict[float, float] = {}
    held_out: dict[float, float] = {}
    begun, smooth = 0, 0.0
    for run in runs:
        records = read_metrics(run / METRICS_FILE)
        for record in records:
            step = begun + record["step"]
            if part in record:
                smooth = smooth + SHARE * (record[part] - smooth) if training else record[part]
                training[step] = smooth
            if f"held_out_{part}" in record:
                held_out[step] = record[f"held_out_{part}"]
        begun += records[-1]["step"]
        held_out[begun + 0.5] = math.nan  # a gap: the next run may have another held-out batch
    return training, held_out


def draw(training: Mapping[float, float], held_out: Mapping[float, float], path: Path, label: str = "loss") -> None:
    """Draw both losses over the steps, as a PNG."""
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(figsize=(7, 3.5))
    axes.plot(list(training), list(training.values()), label="training, smoothed", linewidth=1.2)
    axes.plot(list(held_out), list(held_out.values()), "o-", label="held-out batch", linewidth=1.2, markersize=4)
    axes.set_xlabel("optimiser step")
    axes.set_ylabel(label)
    axes.legend(frameon=False)
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path, help="run folders of v2v-train, in order")
    parser.add_argument("picture", type=Path)
    parser.add_argument(
        "--of", default="total", metavar="PART", help="part of the loss: total, lpips, l1 (default total)"
    )
    asked = parser.parse_args(arguments)
    training, held_out = curves(asked.runs, asked.of)
    if not training:
        raise SystemExit(f"no reading of {asked.of!r} in {', '.join(map(str, asked.runs))}: give another --of")
    draw(training, held_out, asked.picture, "loss" if asked.of == "total" else asked.of)
    print(f"{len(training)} readings up to step {max(training)}: {asked.picture}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
