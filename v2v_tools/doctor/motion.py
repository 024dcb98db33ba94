"""The motion check of `v2v-doctor`: the events that a corpus loses between its frames, predicted from a few of them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import astuple, replace

from v2v_protocol.errors import V2VError
from v2v_protocol.programs import counted
from v2v_protocol.progress import Progress
from v2v_server.corpus.catalogue import Catalogue
from v2v_server.corpus.scenes.picture_check import Defect, Excerpt, examine, hides_motion, spread_excerpts
from v2v_server.corpus.sources.source import VideoSource
from v2v_server.system.isolate import Died
from v2v_server.system.process import usable_cores

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
    """Predict the loss in some videos of a local corpus, in bounded time, and yield the line of the report.

    Args:
        defects: by id. Videos whose frames repeat or are combed have no motion that can be predicted.
    """
    if not catalogue.source.is_local:
        return
    results = examine(_predicted, catalogue.source, _middles(catalogue), usable_cores(), _LONGEST_VIDEO_SECONDS)
    results = Progress.over("looking at motion", "videos", results, min(_MOST_VIDEOS, len(catalogue.videos)))
    found = {
        middle.id: result
        for middle, result in results
        if not isinstance(result, Died) and result and not hides_motion(defects.get(middle.id, ()))
    }
    if not found:
        return
    # Import lazily: these load OpenCV, which worked in the processes that found something.
    from v2v_server.motion.prediction import Prediction
    from v2v_tools.motion import describe_loss

    total = sum((Prediction(*each) for each in found.values()), Prediction())
    change = "more frames a second lose less"
    if total.can_be_followed and not total.uncovers:
        change += "; so does substep_px: 1 in the spec, for processor time"
    loss = describe_loss(total, [each for id in found for each in defects.get(id, ())])
    text = f"{loss}; {_FRAMES} frames in the middle of {counted(len(found), 'video')}"
    yield ("ok", "motion", text.removeprefix("motion: "), "") if total.is_slow else ("note", "motion", text, change)


def _middles(catalogue: Catalogue) -> Iterator[Excerpt]:
    for each in spread_excerpts(catalogue, _MOST_VIDEOS, _LONGEST_SECONDS, _FRAMES):
        top, left, rows, columns = each.window
        height, width = min(rows, _SIDE_PX), min(columns, _SIDE_PX)
        if each.count > 1:
            yield replace(each, window=(top + (rows - height) // 2, left + (columns - width) // 2, height, width))


def _predicted(source: VideoSource, middle: Excerpt) -> tuple[float, ...] | None:
    """Return the fields of the prediction; None where the frames do not decode."""
    import numpy as np

    from v2v_server.motion.prediction import predict

    try:
        with source.open_pixels(middle.id, "") as pixels:
            frames = [picture.grey for picture in pixels.pictures(middle.request)]
    except V2VError:
        return None
    return astuple(predict(np.stack(frames)))
