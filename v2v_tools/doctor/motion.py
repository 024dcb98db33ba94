"""The motion check of `v2v-doctor`: what moves between the frames of a corpus, measured in a few of them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from v2v_protocol.errors import V2VError
from v2v_protocol.programs import counted
from v2v_protocol.progress import Progress
from v2v_server.corpus.catalogue import Catalogue
from v2v_server.corpus.scenes.picture_check import Defect, Excerpt, examine, hides_motion, spread_excerpts
from v2v_server.corpus.sources.source import VideoSource
from v2v_server.motion.measure import MeasuredMotion, measure, together
from v2v_server.system.isolate import Died
from v2v_server.system.process import usable_cores
from v2v_tools.motion import describe_motion

_MOST_VIDEOS = 6
_SIDE_PX = 256
"""Largest side of the part in the middle of the picture that is looked at."""
_FRAMES = 33
_LONGEST_SECONDS = 30.0
"""After this time no other video is begun."""
_LONGEST_VIDEO_SECONDS = 90.0
"""The first one may compile the kernels."""


def look_at_motion(
    catalogue: Catalogue, defects: Mapping[str, Sequence[Defect]]
) -> Iterator[tuple[str, str, str, str]]:
    """Measure the motion in some videos of a local corpus, in bounded time, and yield the line of the report.

    Args:
        defects: by id. Videos whose frames repeat or are combed show no motion that could be measured.
    """
    if not catalogue.source.is_local:
        return
    results = examine(_measured, catalogue.source, _middles(catalogue), usable_cores(), _LONGEST_VIDEO_SECONDS)
    results = Progress.over("looking at motion", "videos", results, min(_MOST_VIDEOS, len(catalogue.videos)))
    found = {
        middle.id: result
        for middle, result in results
        if not isinstance(result, Died) and result and not hides_motion(defects.get(middle.id, ()))
    }
    if not found:
        return
    text, change = describe_motion(together(found.values()), [each for id in found for each in defects.get(id, ())])
    text = f"{text}; {_FRAMES} frames in the middle of {counted(len(found), 'video')}"
    yield "note" if change else "ok", "motion", text, change


def _middles(catalogue: Catalogue) -> Iterator[Excerpt]:
    for each in spread_excerpts(catalogue, _MOST_VIDEOS, _LONGEST_SECONDS, _FRAMES):
        top, left, rows, columns = each.window
        height, width = min(rows, _SIDE_PX), min(columns, _SIDE_PX)
        if each.count > 1:
            yield replace(each, window=(top + (rows - height) // 2, left + (columns - width) // 2, height, width))


def _measured(source: VideoSource, middle: Excerpt) -> MeasuredMotion | None:
    """Return what moves; None where the frames do not decode."""
    try:
        with source.open_pixels(middle.id, "") as pixels:
            frames = [picture.grey for picture in pixels.pictures(middle.request)]
    except V2VError:
        return None
    return measure(np.stack(frames))
