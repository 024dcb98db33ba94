"""Read MVSEC (Zhu et al. 2018): ``*_data.hdf5``, one of its two DAVIS cameras.

| path | content |
|---|---|
| ``davis/left/events`` | float64 [N, 4]: x, y, t in s, p in {-1, 1} |
| ``davis/left/image_raw`` | uint8 [M, H, W] |
| ``davis/left/image_raw_ts`` | float64 [M], s |
| ``davis/left/image_raw_event_inds`` | int64 [M], the event nearest to each picture |

If ``*_gt.hdf5`` is in the same folder, its flow is read too:

| path | content |
|---|---|
| ``davis/left/flow_dist`` | float64 [N, 2, H, W], (x, y), px to the next field |
| ``davis/left/flow_dist_ts``, else ``depth_image_raw_ts`` | float64 [N], s |
| ``davis/left/depth_image_raw`` | float32 [N, H, W]; NaN where no depth, and so no flow, is known |
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from v2v_protocol.errors import UsageError
from v2v_recordings import hdf5
from v2v_recordings.event_columns import EventColumns, TimeUnit, to_ns
from v2v_recordings.items import ConvertOptions, FlowField, Item, ReadProgress, SensorSize

if TYPE_CHECKING:
    import h5py


def recognises(path: Path) -> bool:
    """Return whether the path is an HDF5 file with a group ``davis``.

    Raises:
        UsageError: it is an HDF5 file, but damaged.
    """
    return hdf5.holds(path, "davis")


def read(path: Path, options: ConvertOptions, progress: ReadProgress) -> Iterator[Item]:
    """Yield the items of one camera of a recording.

    Raises:
        UsageError: a part is missing, damaged or has another shape.
    """
    with hdf5.open_hdf5(path) as file:
        name = f"davis/{options.camera}"
        group = file.get(name, {})
        if "events" not in group:
            raise UsageError(f"{path} has no {name}/events; its cameras: {', '.join(file.get('davis', ()))}")
        events, pictures = group["events"], group.get("image_raw")
        if events.ndim != 2 or events.shape[1] != 4:
            raise UsageError(f"{path}: {name}/events is {list(events.shape)}, not [N, 4]")
        if pictures is not None:
            yield SensorSize(*pictures.shape[:0:-1])
        read = EventColumns(str(path), TimeUnit.of(options, "s", hdf5.stated_unit(events)))
        for start in range(0, len(events), hdf5.READ_EVENTS):
            x, y, t, p = events[start : start + hdf5.READ_EVENTS].T
            yield read.part(t, x, y, p)
            progress(start + len(t), len(events))
        yield from read.end()
        if pictures is not None:
            nearest = group.get("image_raw_event_inds")
            yield from hdf5.pictures(pictures, group["image_raw_ts"], f"{path}: image_raw", nearest)
    truth = path.with_name(path.name.replace("_data", "_gt"))
    if truth != path and truth.is_file():
        with hdf5.open_hdf5(truth) as file:
            yield from _flow(file, truth, options.camera)


def _flow(file: h5py.File, path: Path, camera: str) -> Iterator[Item]:
    group = file.get(f"davis/{camera}", {})
    if "flow_dist" not in group:
        return
    fields, depth = group["flow_dist"], group.get("depth_image_raw")
    times = group["flow_dist_ts" if "flow_dist_ts" in group else "depth_image_raw_ts"][:]
    if fields.ndim != 4 or fields.shape[1] != 2 or len(times) != len(fields):
        raise UsageError(f"{path}: flow_dist is {list(fields.shape)} with {len(times)} times, not [N, 2, H, W]")
    SensorSize(*fields.shape[:1:-1]).require_usable(str(path))
    for index, t_ns in enumerate(to_ns(times, str(path))):
        flow = fields[index].astype(np.float32)
        if depth is not None:
            flow[:, ~np.isfinite(depth[index])] = np.nan
        yield FlowField(int(t_ns), flow)
