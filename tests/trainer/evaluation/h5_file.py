"""Write recordings in the h5 layout, as the published conversions do or with faults."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np


def write_h5(
    path: Path,
    t: np.ndarray,
    x: np.ndarray,
    y: np.ndarray,
    p: np.ndarray,
    pictures: list[tuple[np.ndarray, dict[str, Any]]],
    *,
    ts_dtype: str = "f8",
    ps_dtype: str = "?",
    **root: Any,
) -> Path:
    """``pictures``: pixels and attributes of each."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(path, "w") as file:
        file["events/ts"] = np.asarray(t).astype(ts_dtype)
        file["events/xs"] = np.asarray(x).astype("i2")
        file["events/ys"] = np.asarray(y).astype("i2")
        file["events/ps"] = np.asarray(p).astype(ps_dtype)
        for number, (pixels, attributes) in enumerate(pictures):
            file[f"images/image{number:09d}"] = pixels
            file[f"images/image{number:09d}"].attrs.update(attributes)
        file.attrs.update(root)
    return path


def random_recording(
    path: Path,
    *,
    size: tuple[int, int] = (36, 40),
    images: int = 6,
    events: int = 600,
    period: float = 0.02,
    seed: int = 0,
) -> Path:
    """Write uniformly random events and pictures, the first picture at 1 s."""
    rng = np.random.default_rng(seed)
    height, width = size
    times = 1.0 + period * np.arange(images)
    t = np.sort(rng.uniform(times[0], times[-1], events))
    pictures = [
        (rng.integers(0, 256, size, dtype=np.uint8), {"event_idx": int(np.searchsorted(t, time)), "timestamp": time})
        for time in times
    ]
    x, y, p = rng.integers(0, width, events), rng.integers(0, height, events), rng.integers(0, 2, events)
    return write_h5(path, t, x, y, p, pictures)
