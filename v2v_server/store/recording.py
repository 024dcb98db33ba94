"""A prepared recording of an event camera: ``--videos-kind recordings``.

To the catalogue its frames are *marks*: moments at which a voxel grid may begin or end. A mark shows the latest picture
that is not later, the first one before all. The clip of a sample comes with its arrays of events and the true flow.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from v2v_protocol.sample import ARRAYS, RECORDING_FORMAT, array_layout, new_arrays
from v2v_server.store.event_file import EventFile
from v2v_server.video.decode import ClipRequest, Cut, DecodedClip, DecodedPicture, SampleView
from v2v_server.video.fingerprint import check_fingerprint
from v2v_server.video.frame_index import LARGEST_FRAMES, unseekable
from v2v_server.video.picture import SDR, PixelRect
from v2v_server.video.probe import VideoFacts

_OF_PICTURES = "frames", "frames_u16", "frames_all"
_FLOW = "flow", "flow_valid"


class RecordedPixels(EventFile):
    """:class:`v2v_server.store.pixels.Pixels` of a prepared recording.

    Args:
        path: the file.
        marks: "pictures", "flow", or a number and "events"; see :class:`v2v_server.kinds.recordings.RecordingKind`.
        rate: of the marks, Hz; 0: as ``marks`` states.
    """

    is_stored = True

    def __init__(self, path: Path, marks: str = "pictures", rate: float = 0.0) -> None:
        super().__init__(path)
        self._marks, self._rate = marks, rate

    def facts(self) -> VideoFacts:
        """Return the facts; without marks of the wanted form it has one frame."""
        times = np.unique(self.marks())[:LARGEST_FRAMES]
        index = unseekable(max(1, len(times)), (1, 1), self.head.height_px, self.head.width_px)
        seconds = 1e-9 * float(times[-1] - times[0]) if len(times) > 1 else np.nan
        return VideoFacts(
            frames=len(index),
            height_px=self.head.height_px,
            width_px=self.head.width_px,
            codec=RECORDING_FORMAT,
            pixel_format="gray",
            frames_per_second=(len(times) - 1) / seconds,
            rotation_degrees=0,
            full_range=True,
            index=index.timed(times) if len(times) else index,
            content=self.content,
            remark="; ".join(self.head.notes),
        )

    def marks(self) -> npt.NDArray[np.int64]:
        """Return the times of the marks, [n] nanoseconds."""
        if self._rate:
            ends = self.times_of_every(max(1, self.head.events - 1), 2)
            count = int((ends[-1] - ends[0]) * 1e-9 * self._rate + 1e-9) + 1 if len(ends) else 0
            steps: npt.NDArray[np.int64] = np.rint(np.arange(min(count, LARGEST_FRAMES)) * (1e9 / self._rate)).astype(
                int
            )
            return steps + ends[:1]
        if self._marks in ("pictures", "flow"):
            table = self.pictures_table if self._marks == "pictures" else self.flows
            return np.array(table["t_ns"], np.int64)
        return self.times_of_every(int(self._marks.removesuffix("events")), LARGEST_FRAMES)

    def check(self, fingerprint: str) -> None:
        """Compare size, head and tail, which holds the hashes of all pieces."""
        check_fingerprint(self._path, fingerprint)

    def clips(self, request: ClipRequest) -> tuple[DecodedClip, ...]:
        """Return the pictures at the marks of each cut; with a view, also its arrays that are known."""
        request.check()
        views = request.views or (None,) * len(request.cuts)
        return tuple(self._clip(request, cut, view) for cut, view in zip(request.cuts, views, strict=True))

    def pictures_at(self, times: npt.NDArray[np.int64], window: PixelRect) -> npt.NDArray[np.uint8]:
        """Return the pictures that marks show, [n, h, w]; zeros where there are none."""
        top, left, height, width = window
        frames = np.zeros((len(times), height, width), np.uint8)
        if len(self.pictures_table):
            shown = np.maximum(np.searchsorted(self.pictures_table["t_ns"], times, "right") - 1, 0)
            for at, number in enumerate(shown.tolist()):
                if at and number == shown[at - 1]:
                    frames[at] = frames[at - 1]
                else:
                    frames[at] = self.picture(number)[top : top + height, left : left + width]
        return frames

    def pictures(self, request: ClipRequest) -> Iterator[DecodedPicture]:
        """Yield the pictures at the marks of the only cut."""
        (cut,) = request.cuts
        for time in self._times(request, cut):
            (grey,) = self.pictures_at(np.array([time]), request.window(cut))
            yield DecodedPicture(grey, grey, SDR, RECORDING_FORMAT, True)

    def _times(self, request: ClipRequest, cut: Cut) -> npt.NDArray[np.int64]:
        at = request.index.position(request.start, (cut.count - 1) * request.stride + 1)
        return request.index.pts[at :: request.stride][: cut.count]

    def _clip(self, request: ClipRequest, cut: Cut, view: SampleView | None) -> DecodedClip:
        times = self._times(request, cut)
        frames = self.pictures_at(times, request.window(cut))
        clip = DecodedClip(frames, request.seconds(cut), RECORDING_FORMAT, True, "store")
        return clip if view is None else self._with_arrays(clip, times, request.usable, view)

    def _with_arrays(
        self, clip: DecodedClip, times: npt.NDArray[np.int64], usable: PixelRect, view: SampleView
    ) -> DecodedClip:
        """Return a clip with the arrays of a sample that are made of events, and true flow; ``times``: [n] marks."""
        from v2v_server.recorded import fill_arrays  # a catalogue must not load numba

        recipe, params = view.spec.recipe, view.params
        ends = params.ends(recipe)
        edges = times[params.source_index(int(ends[-1]))[ends]]
        window = usable[0] + params.crop_top_px, usable[1] + params.crop_left_px, *recipe.crop_px
        parts = np.arange(1, max(1, recipe.grids_per_frame) + 1)
        inner = edges[:-1, None] + np.diff(edges)[:, None] * parts // parts[-1]
        grids = np.append(edges[:1], inner)
        of_events = tuple(name for name in view.arrays if ARRAYS[name].of_events is not None)
        asked = of_events, tuple(name for name in _FLOW if name in view.arrays and len(self.flows))
        arrays = new_arrays(array_layout(recipe, view.spec.voxel_dtype, asked[0] + asked[1]))
        saturated = dict[str, int]()
        if of_events:
            events = self.between(grids, window, params.flip)
            saturated = fill_arrays(events, grids, recipe, params, {name: arrays[name] for name in of_events})
        if asked[1]:
            why = self._fill_flow(edges[recipe.lead_voxels :], window, view, {name: arrays[name] for name in asked[1]})
        elif not np.isin(edges, self.pictures_table["t_ns"]).all():
            why = "flow is estimated from picture to picture, and the grids lie between other marks"
        else:
            why = ""
        unlabelled = dict.fromkeys(_FLOW if why else (), why)
        if not len(self.pictures_table):
            unlabelled |= dict.fromkeys(_OF_PICTURES, "the recording has no pictures")
        return replace(clip, arrays=arrays, saturated=saturated, unlabelled=unlabelled)

    def _fill_flow(
        self, edges: npt.NDArray[np.int64], window: PixelRect, view: SampleView, out: Mapping[str, npt.NDArray[Any]]
    ) -> str:
        """Fill in the true flow between marks; return why it is not known, or "".

        Args:
            edges: [T + 1] marks, nanoseconds.
            window: of the sensor.
        """
        if view.spec.flow_direction != "forward":
            return f"true flow goes forward, and flow_direction is {view.spec.flow_direction}"
        top, left, height, width = window
        starts = self.flows["t_ns"]
        ends = np.append(starts[1:], edges[-1])
        for grid, (begin, end) in enumerate(pairwise(edges.tolist())):
            at = int(np.searchsorted(starts, begin))
            if begin < end and not (at < len(starts) and (starts[at], ends[at]) == (begin, end)):
                return (
                    "true flow is known from field to field: give --marks flow, without frame_stride or voxel_seconds"
                )
            part = np.zeros((2, height, width), np.float32)  # a paused camera
            if begin < end:
                part = self.flow(at)[:, top : top + height, left : left + width]
            if view.params.flip:
                part = part[:, :, ::-1] * np.array([-1, 1], np.float32)[:, None, None]
            is_known = np.isfinite(part).all(0)
            known = {"flow": np.where(is_known, part, 0), "flow_valid": is_known}
            for name, array in out.items():
                array[grid] = known[name] if grid >= view.spec.flow_from else 0
        return ""
