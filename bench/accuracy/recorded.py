"""Real events beside simulated ones: a recording of a camera that takes frames and events with the same pixels."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from scipy import ndimage  # type: ignore[import-untyped]

from v2v_protocol.errors import UsageError
from v2v_server.simulation import simulate

BLUR_SIGMA_PX = 2.0
"""Both counts are blurred by this before they are correlated: single events of two cameras never coincide."""
LAMP_LEVEL, LAMP_MARGIN_PX = 250, 12
THRESHOLDS = np.geomspace(0.03, 1.0, 36)
Image = npt.NDArray[np.float64]


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
        """Rising and falling events of each pixel with begin < t <= end, [h, w] each."""
        chosen = self.events[(self.events["t"] > begin) & (self.events["t"] <= end)]
        height, width = self.frames.shape[1:]
        cell = chosen["y"].astype(np.int64) * width + chosen["x"]
        rising, falling = (
            np.bincount(cell[chosen["on"] == on], minlength=height * width).reshape(height, width).astype(np.float64)
            for on in (True, False)
        )
        return rising, falling


def read_recording(path: Path) -> Recording:
    """A recording in the AEDAT 4 format.

    Raises:
        UsageError: the package that reads it is missing, or the file does not hold two frames and events.
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


def compare(recording: Recording) -> list[dict[str, Any]]:
    """One record for each reading of the frames (gamma) and part of the picture: the threshold at which V2V fires as
    many events as the camera did, and how alike the two are there; controls included."""
    records = []
    rising, falling = recording.counts(recording.seconds[0], recording.seconds[-1])
    dazzled = lamps(recording.frames)
    for gamma in (1.0, 2.2):
        for part, mask in (("whole picture", np.ones_like(dazzled)), ("without the lamps", ~dazzled)):
            real = float((rising + falling)[mask].sum())
            threshold = min(THRESHOLDS, key=lambda c: abs(np.abs(simulated(recording, c, gamma))[:, mask].sum() - real))
            voxels = simulated(recording, threshold, gamma)
            up, down = np.maximum(voxels, 0).sum(0), np.maximum(-voxels, 0).sum(0)
            mirrored = rising[:, ::-1] + falling[:, ::-1]
            records.append(
                {
                    "measure": "recorded",
                    "gamma": gamma,
                    "part": part,
                    "pixels": int(mask.sum()),
                    "seconds": float(recording.seconds[-1]),
                    "events_real": real,
                    "threshold_of_equal_count": float(threshold),
                    "events_v2v": float((up + down)[mask].sum()),
                    "rising_share_real": float(rising[mask].sum() / real),
                    "rising_share_v2v": float(up[mask].sum() / max(1.0, (up + down)[mask].sum())),
                    "correlation_of_counts": correlation(rising + falling, up + down, mask),
                    "correlation_of_signed_counts": correlation(rising - falling, up - down, mask),
                    "correlation_control_mirrored": correlation(mirrored, up + down, mask),
                    "active_pixels_real": float(((rising + falling) > 0)[mask].mean()),
                    "active_pixels_v2v": float(((up + down) > 0)[mask].mean()),
                    "real_net_over_gross": float(np.abs(rising - falling)[mask].sum() / real),
                }
            )
    return records


def lamps(frames: npt.NDArray[np.uint8]) -> npt.NDArray[np.bool_]:
    """[h, w] where the picture is clipped at any time, and around."""
    clipped = (frames.max(axis=0) >= LAMP_LEVEL).astype(np.uint8)
    return cv2.dilate(clipped, np.ones((2 * LAMP_MARGIN_PX + 1,) * 2, np.uint8)).astype(bool)


def simulated(recording: Recording, threshold: float, gamma: float) -> Image:
    """V2V's signed counts between the frames: [n - 1, h, w]."""
    voxels = simulate(
        recording.frames, threshold_pos=float(threshold), gamma=gamma, bins=len(recording.frames) - 1, dtype="int16"
    ).voxels
    counts: Image = voxels[0].astype(np.float64)
    return counts


def correlation(one: Image, other: Image, mask: npt.NDArray[np.bool_]) -> float:
    """Pearson's, of the blurred images, over the mask."""
    smooth = [ndimage.gaussian_filter(image, BLUR_SIGMA_PX)[mask] for image in (one, other)]
    return float(np.corrcoef(smooth[0], smooth[1])[0, 1])
