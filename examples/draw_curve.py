"""Draws what a training run has logged: its loss, smoothed, and that of the batch that it is judged by.

    python examples/draw_curve.py runs/firenet-cpu curve.png

Of several runs the steps are counted on, as where one began with the weights of another.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from trainer.run.reporting import METRICS, read_metrics

SHARE = 0.05
"""Of a new reading in the smoothed loss."""


def curves(runs: Sequence[Path]) -> tuple[dict[int, float], dict[int, float]]:
    """Smoothed training loss and held-out loss, by step."""
    training: dict[int, float] = {}
    held_out: dict[int, float] = {}
    begun, smooth = 0, 0.0
    for run in runs:
        records = read_metrics(run / METRICS)
        for record in records:
            step = begun + record["step"]
            if "total" in record:
                smooth = smooth + SHARE * (record["total"] - smooth) if training else record["total"]
                training[step] = smooth
            if "held_out_total" in record:
                held_out[step] = record["held_out_total"]
        begun += records[-1]["step"]
    return training, held_out


def draw(training: Mapping[int, float], held_out: Mapping[int, float], path: Path) -> None:
    """Both over the steps, as a PNG."""
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(figsize=(7, 3.5))
    axes.plot(list(training), list(training.values()), label="training, smoothed", linewidth=1.2)
    axes.plot(list(held_out), list(held_out.values()), "o-", label="held-out batch", linewidth=1.2, markersize=4)
    axes.set_xlabel("optimiser step")
    axes.set_ylabel("loss")
    axes.legend(frameon=False)
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path, help="folders of v2v-train, in their order")
    parser.add_argument("picture", type=Path)
    asked = parser.parse_args(arguments)
    training, held_out = curves(asked.runs)
    draw(training, held_out, asked.picture)
    print(f"{len(training)} readings up to step {max(training)}: {asked.picture}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
