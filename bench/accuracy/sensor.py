"""Which log offset, and which effects, follow a real sensor: simulated beside recorded voxels of one camera.

    v2v-bench sensor --recording davis346_aestream.aedat4 --json sensor.json

The frames of a recording are simulated, one bin from each frame to the next, and compared with the events that the same
pixels recorded in that time. At every setting the threshold is the one that fires as many events as the camera did.

    pixels     correlation of the signed counts of every pixel and bin
    blurred    the same, both blurred by 2 px: events of two cameras never coincide to the pixel
    ceiling    that of the frames' own change of log intensity, which no threshold has cut into events

Lamps and what is near them are left out: their flicker is not in the frames.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import ndimage  # type: ignore[import-untyped]

from bench.accuracy.recorded import BLUR_SIGMA_PX, Recording, lamps, read_recording
from v2v_protocol.errors import V2VError
from v2v_protocol.records import write_json
from v2v_server.simulation import simulate

LOG_OFFSETS = (0.001, 0.003, 0.01, 0.03, 0.05, 0.1, 0.15, 0.2, 0.5)
EFFECTS: Mapping[str, Mapping[str, float]] = {
    "none": {},
    "noise_sigma 0.05": {"noise_sigma": 0.05},
    "threshold_mismatch_sigma 0.15": {"threshold_mismatch_sigma": 0.15},
    "shot_noise_hz 2": {"shot_noise_hz": 2.0},
    "leak_hz 0.1": {"leak_hz": 0.1},
    "refractory_seconds 5e-4": {"refractory_seconds": 5e-4},
    "photoreceptor_hz 100": {"photoreceptor_hz": 100.0},
    "photoreceptor_hz 30": {"photoreceptor_hz": 30.0},
}
_THRESHOLDS = np.geomspace(0.01, 1.0, 60)
Counts = npt.NDArray[np.float64]
"""[bins, h, w] signed events."""


class Sensor:
    """A recording, and what was recorded in it."""

    def __init__(self, recording: Recording) -> None:
        self._frames = recording.frames
        ends = zip(recording.seconds[:-1], recording.seconds[1:], strict=True)
        counts = [recording.counts(begin, end) for begin, end in ends]
        self._used = ~lamps(recording.frames)
        self._recorded = np.stack([rising - falling for rising, falling in counts])
        self._events = float(sum((rising + falling)[self._used].sum() for rising, falling in counts))
        self._rate = len(counts) / float(recording.seconds[-1])

    def record(self, gamma: float, log_eps: float, residual: float | None, **effects: float) -> dict[str, Any]:
        """The threshold of equal count, and how alike the events are there."""
        made = {c: self._simulated(c, gamma, log_eps, residual, effects) for c in map(float, _THRESHOLDS)}
        threshold = min(made, key=lambda c: abs(float(np.abs(made[c][:, self._used]).sum()) - self._events))
        change = np.diff(np.log(log_eps + (self._frames / 255.0) ** gamma), axis=0)
        return {
            "gamma": gamma,
            "log_eps": log_eps,
            "first_residual": "random" if residual is None else "zero",
            "threshold": threshold,
            "correlation_pixels": self._alike(made[threshold], 0.0),
            "correlation_blurred": self._alike(made[threshold], BLUR_SIGMA_PX),
            "correlation_pixels_mirrored": self._alike(made[threshold][:, :, ::-1], 0.0),
            "ceiling_pixels": self._alike(change, 0.0),
        }

    def _simulated(
        self, threshold: float, gamma: float, log_eps: float, residual: float | None, effects: Mapping[str, Any]
    ) -> Counts:
        voxels = simulate(
            self._frames, threshold_pos=threshold, gamma=gamma, log_eps=log_eps, start_residual=residual,
            bins=len(self._frames) - 1, dtype="int16", frames_per_second=self._rate, **effects,
        ).voxels  # fmt: skip
        counts: Counts = voxels[0].astype(np.float64)
        return counts

    def _alike(self, made: Counts, blur_px: float) -> float:
        """Pearson's correlation with the recorded events over all used pixels of all bins."""
        one, other = (
            np.stack([ndimage.gaussian_filter(each, blur_px) for each in counts])[:, self._used].ravel()
            for counts in (self._recorded, made)
        )
        return float(np.corrcoef(one, other)[0, 1])


def measure(recording: Recording) -> list[dict[str, Any]]:
    """One record a setting: all log offsets, then the effects at the best of them."""
    sensor = Sensor(recording)
    offsets = [
        {"measure": "log offset", **sensor.record(gamma, log_eps, residual)}
        for gamma in (1.0, 2.2)
        for log_eps in LOG_OFFSETS
        for residual in (None, 0.0)
    ]
    best = max(offsets, key=lambda record: record["correlation_pixels"])
    effects = [
        {"measure": "effect", "effect": name, **sensor.record(best["gamma"], best["log_eps"], 0.0, **effect)}
        for name, effect in EFFECTS.items()
    ]
    return [*offsets, *effects]


def report(records: Sequence[Mapping[str, Any]]) -> str:
    """The records as a table."""
    lines = [
        f"{'gamma':>5s}{'log_eps':>9s}{'residual':>10s}{'c':>8s}{'pixels':>9s}{'blurred':>9s}{'mirrored':>10s}{'ceiling':>9s}"
    ]
    for r in records:
        lines.append(
            f"{r['gamma']:5.1f}{r['log_eps']:9.3f}{r['first_residual']:>10s}{r['threshold']:8.3f}"
            f"{r['correlation_pixels']:9.3f}{r['correlation_blurred']:9.3f}{r['correlation_pixels_mirrored']:10.3f}"
            f"{r['ceiling_pixels']:9.3f}  {r.get('effect', '')}".rstrip()
        )
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line. Returns 0 or 2 (wrong usage or input)."""
    parser = argparse.ArgumentParser(prog="v2v-bench sensor", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--recording", type=Path, required=True, metavar="FILE.aedat4", help="frames and events")
    parser.add_argument("--json", type=Path, metavar="FILE")
    asked = parser.parse_args(arguments)
    try:
        records = measure(read_recording(asked.recording))
        print(report(records))
        if asked.json is not None:
            write_json(asked.json, records)
    except (V2VError, OSError) as error:
        print(f"v2v-bench sensor: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
