"""Read the HDF5 layout of event_cnn_minimal and V2V, which ``v2v-convert`` writes (``trainer.evaluation.layout``).

| path | content |
|---|---|
| ``events/ts``, ``xs``, ``ys``, ``ps`` | [N]: s, px, px, above 0 for a brightness increase |
| ``images/*`` | uint8 [H, W]; attribute ``timestamp``, s, or ``event_idx`` |
| ``flow/*`` | float32 [2, H, W]; attribute ``timestamp``, s |
| attributes ``sensor_resolution``, ``start_ns`` | height and width; time 0 in the clock of the raw recording |
| attribute ``light`` | of the pictures, if it is known (``Light.parse``) |
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from v2v_protocol.errors import UsageError
from v2v_recordings import hdf5
from v2v_recordings.items import (
    NS_PER_UNIT,
    ConvertOptions,
    FlowField,
    Item,
    Light,
    Picture,
    ReadProgress,
    to_ns,
)


def recognises(path: Path) -> bool:
    """Return whether the path is an HDF5 file with ``events/ts``."""
    return hdf5.holds(path, "events/ts")


def read(path: Path, _options: ConvertOptions, progress: ReadProgress) -> Iterator[Item]:
    """Yield the items of a recording.

    Raises:
        UsageError: a part is missing, damaged or has another shape.
    """
    with hdf5.open_hdf5(path) as file:
        origin_ns = int(file.attrs.get("start_ns", 0))
        if "light" in file.attrs:
            yield Light.parse(str(file.attrs["light"]))
        stated = file.attrs.get("sensor_resolution", file.get("sensor_resolution"))
        if stated is not None:
            yield hdf5.sensor_size(stated, path)
        columns = {name: file.get(f"events/{name}") for name in ("ts", "xs", "ys", "ps")}
        yield from hdf5.events(columns, str(path), progress, ns_per_unit=NS_PER_UNIT["s"], offset_ns=origin_ns)
        for kind in ("images", "flow"):
            for key in sorted(file.get(kind, ())):
                item = file[f"{kind}/{key}"]
                seconds = item.attrs.get("timestamp")
                if seconds is None and "event_idx" in item.attrs:
                    seconds = file["events/ts"][min(int(item.attrs["event_idx"]), len(file["events/ts"]) - 1)]
                t_ns = int(to_ns(np.array([seconds], np.float64), f"{path}: {kind}/{key}")[0]) + origin_ns
                if kind == "flow":
                    yield FlowField(t_ns, item[:].astype(np.float32))
                elif len(getattr(item, "shape", ())) != 2 or item.dtype != np.uint8:
                    raise UsageError(f"{path}: images/{key} is {item}, not uint8 [H, W]")
                else:
                    yield Picture(t_ns, item[:])
