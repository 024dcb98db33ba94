"""The motion check of `v2v-doctor`: the events that a corpus loses between its frames, predicted from a few of them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import astuple, dataclass
from functools import partial

from v2v_protocol.errors import V2VError
from v2v_protocol.persisted import Persisted
from v2v_protocol.progress import Progress
from v2v_server.corpus.catalogue import Catalogue
from v2v_server.corpus.probe import LARGEST_MEMORY_BYTES
from v2v_server.corpus.scenes.findings import Defect
from v2v_server.corpus.sources.source import VideoSource
from v2v_server.offline.doctor_pictures import hides_motion, spread_videos
from v2v_server.system.compile_cache import compile_cache
from v2v_server.system.isolate import Died, run_isolated
from v2v_server.system.process import usable_cores
from v2v_server.video.frame_index import FrameIndex
from v2v_server.video.orientation import Window

MOST_VIDEOS = 6
_SIDE_PX = 256
"""Largest side of the part in the middle of the picture that is looked at."""
_FRAMES = 33
_LONGEST_SECONDS = 30.0
"""After this time no other video is begun."""
_LONGEST_VIDEO_SECONDS = 90.0
"""The first one may compile the kernels."""
_Fields = tuple[tuple[float, ...], float, float, float, float, float, float, float]
"""Fields of a Prediction, in order."""


@dataclass(frozen=True, slots=True)
class _Middle(Persisted):
    """Frames in the middle of a video, and the part of the picture that is looked at."""

    id: str
    index: FrameIndex
    start: int
    count: int
    window: Window


def look_at_motion(
    catalogue: Catalogue, defects: Mapping[str, Sequence[Defect]]
) -> Iterator[tuple[str, str, str, str]]:
    """Predict the loss in some videos of a local corpus, in bounded time, and yield the line of the report.

    Args:
        defects: by id. Videos whose frames repeat or are combed have no motion that can be predicted.
    """
    if not catalogue.source.is_local:
        return
    results = run_isolated(
        partial(_predicted, catalogue.source), _middles(catalogue), usable_cores(),
        lambda job: _LONGEST_VIDEO_SECONDS, 2 * LARGEST_MEMORY_BYTES, compile_cache(),
    )  # fmt: skip
    results = Progress.over("looking at motion", "videos", results, min(MOST_VIDEOS, len(catalogue.videos)))
    found = {
        middle.id: result
        for middle, result in results
        if not isinstance(result, Died) and result and not hides_motion(defects.get(middle.id, ()))
    }
    if not found:
        return
    # Import lazily: these load OpenCV, which worked in the processes that found something.
    from v2v_server.motion.prediction import Prediction
    from v2v_server.offline.motion import describe_loss

    total = sum((Prediction(*each) for each in found.values()), Prediction())
    change = ""
    if not total.is_slow:
        change = "more frames a second lose less"
        if total.can_be_followed:
            change += "; so does substep_px: 1 in the spec, for processor time"
    loss = describe_loss(total, [each for id in found for each in defects.get(id, ())])
    text = f"{loss}; {_FRAMES} frames in the middle of {len(found)} videos"
    yield "ok" if total.is_slow else "note", "motion", text.removeprefix("motion: "), change


def _middles(catalogue: Catalogue) -> Iterator[_Middle]:
    for video, index, (top, left, rows, columns) in spread_videos(catalogue, MOST_VIDEOS, _LONGEST_SECONDS):
        count = min(len(index), _FRAMES)
        start = (len(index) - count) // 2 if index.seekable else 0
        height, width = min(rows, _SIDE_PX), min(columns, _SIDE_PX)
        window = top + (rows - height) // 2, left + (columns - width) // 2, height, width
        if count > 1:
            yield _Middle(video.id, index, start, count, window)


def _predicted(source: VideoSource, middle: _Middle) -> _Fields | None:
    """Return the fields of the prediction; None where the frames do not decode."""
    import numpy as np

    from v2v_server.motion.prediction import predict
    from v2v_server.video.collect import ClipRequest, Cut

    try:
        with source.open_pixels(middle.id, "") as pixels:
            request = ClipRequest(middle.index, middle.start, (Cut(middle.count, middle.window),))
            frames = [picture.grey for picture in pixels.pictures(request)]
    except V2VError:
        return None
    return astuple(predict(np.stack(frames)))
