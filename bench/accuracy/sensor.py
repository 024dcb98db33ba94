"""Compare simulated with recorded events of one camera, by log offset and effect.

    python -m bench sensor --recording davis346_aestream.aedat4 --json sensor.json

The frames of a recording are simulated, one bin from each frame to the next, and compared with the events that the same
pixels recorded in that time. Each setting uses the threshold that fires as many events as the camera did.

    pixels     correlation of the signed counts of every pixel and bin
    mirrored   the same as pixels with the simulation mirrored: a control
    ceiling    correlation of the frames' change of log intensity, before a threshold turns it into events

Lamps and their surroundings are left out, because frames do not show their flicker.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from bench.frame import Column, Report
from v2v_protocol.command import Parser
from v2v_protocol.errors import UsageError
from v2v_server.simulation import simulate

LAMP_LEVEL, LAMP_MARGIN_PX = 250, 12
Image = npt.NDArray[np.float64]
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
_COLUMNS: tuple[Column, ...] = (
    ("gamma", "gamma", "{:.1f}", 1),
    ("log_eps", "log_eps", "{:.3f}", 1),
    ("first_residual", "residual", "{}", 1),
    ("threshold", "c", "{:.3f}", 1),
    ("correlation_pixels", "pixels", "{:.3f}", 1),
    ("correlation_pixels_mirrored", "mirrored", "{:.3f}", 1),
    ("ceiling_pixels", "ceiling", "{:.3f}", 1),
    ("effect", "effect", "{}", 1),
)
Counts = npt.NDArray[np.float64]  # [bins, h, w] signed events


@dataclass(frozen=True)
class Recording:
    """Frames and events of one camera.

    Attributes:
        frames: [n, h, w] uint8.
        seconds: [n] middle of each exposure, from the first frame's.
        events: [m] structured, fields ``t`` (seconds, same clock), ``x``, ``y``, ``on``.
    """

    frames: npt.NDArray[np.uint8]
    seconds: npt.NDArray[np.float64]
    events: npt.NDArray[Any]

    def counts(self, begin: float, end: float) -> tuple[Image, Image]:
        """Return the rising and falling events of each pixel with begin < t <= end, [h, w] each."""
        chosen = self.events[(self.events["t"] > begin) & (self.events["t"] <= end)]
        height, width = self.frames.shape[1:]
        cell = chosen["y"].astype(np.int64) * width + chosen["x"]
        rising, falling = (
            np.bincount(cell[chosen["on"] == on], minlength=height * width).reshape(height, width).astype(np.float64)
            for on in (True, False)
        )
        return rising, falling


def read_recording(path: Path) -> Recording:
    """Read a recording in the AEDAT 4 format.

    Raises:
        UsageError: faery is not installed, or the file does not hold two frames and events.
    """
    try:
        import faery
    except ImportError as error:
        raise UsageError("--recording needs faery: pip install '.[convert]' in a checkout of v2v-stream") from error
    if not path.is_file():
        raise UsageError(f"--recording {path}: no such file")
    frames, times, parts = [], [], []
    for track, packet in faery.aedat.Decoder(path):
        if track.data_type == "frame":
            frames.append(packet.pixels)
            times.append((packet.exposure_start_t + packet.exposure_end_t) / 2)
        elif track.data_type == "events":
            parts.append(packet)
    if len(frames) < 2 or not parts:
        raise UsageError(f"--recording {path}: {len(frames)} frames and {len(parts)} packets of events; give both")
    raw = np.concatenate(parts)
    events = np.empty(len(raw), [("t", "f8"), ("x", "i8"), ("y", "i8"), ("on", "?")])
    events["t"] = (raw["t"].astype(np.float64) - times[0]) * 1e-6
    events["x"], events["y"], events["on"] = raw["x"], raw["y"], raw["on"]
    return Recording(np.stack(frames), (np.array(times) - times[0]) * 1e-6, events)


def lamps(frames: npt.NDArray[np.uint8]) -> npt.NDArray[np.bool_]:
    """Return a mask [h, w] of the pixels that are clipped at any time, and their surroundings."""
    clipped = (frames.max(axis=0) >= LAMP_LEVEL).astype(np.uint8)
    return cv2.dilate(clipped, np.ones((2 * LAMP_MARGIN_PX + 1,) * 2, np.uint8)).astype(bool)


class Sensor:
    """A recording, as the truth that simulations are compared with."""

    def __init__(self, recording: Recording) -> None:
        self._frames = recording.frames
        ends = zip(recording.seconds[:-1], recording.seconds[1:], strict=True)
        counts = [recording.counts(begin, end) for begin, end in ends]
        self._used = ~lamps(recording.frames)
        self._recorded = np.stack([rising - falling for rising, falling in counts])
        self._events = float(sum((rising + falling)[self._used].sum() for rising, falling in counts))
        self._rate = len(counts) / float(recording.seconds[-1])

    def record(self, gamma: float, log_eps: float, residual: float | None, **effects: float) -> dict[str, Any]:
        """Return the threshold of equal count and the correlations at it."""
        made = {c: self._simulated(c, gamma, log_eps, residual, effects) for c in map(float, _THRESHOLDS)}
        threshold = min(made, key=lambda c: abs(float(np.abs(made[c][:, self._used]).sum()) - self._events))
        change = np.diff(np.log(log_eps + (self._frames / 255.0) ** gamma), axis=0)
        return {
            "gamma": gamma,
            "log_eps": log_eps,
            "first_residual": "random" if residual is None else "zero",
            "threshold": threshold,
            "correlation_pixels": self._alike(made[threshold]),
            "correlation_pixels_mirrored": self._alike(made[threshold][:, :, ::-1]),
            "ceiling_pixels": self._alike(change),
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

    def _alike(self, made: Counts) -> float:
        """Return Pearson's correlation with the recorded events over all used pixels of all bins."""
        return float(np.corrcoef(self._recorded[:, self._used].ravel(), made[:, self._used].ravel())[0, 1])


def records_of(recording: Recording) -> list[dict[str, Any]]:
    """Return one record for each setting: all log offsets, then the effects at the best of them."""
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


def add_flags(parser: Parser) -> None:
    """Add the bench's flags."""
    parser.add_argument("--recording", type=Path, required=True, metavar="FILE.aedat4", help="frames and events")


def measure(asked: argparse.Namespace) -> Report:
    """Run the bench."""
    records = records_of(read_recording(asked.recording))
    return Report(records, [(records, _COLUMNS)])
