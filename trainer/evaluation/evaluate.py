"""Evaluate data sets: find their recordings, reconstruct and score each, draw the requested pictures."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from trainer import pictures
from trainer.evaluation.data_sets import DataSet
from trainer.evaluation.metrics import Metric
from trainer.evaluation.pictures import choose_steps, draw_recording, draw_step
from trainer.evaluation.readers import EventWindow, Recording
from trainer.evaluation.reconstruct import Stretch, reconstruct
from trainer.evaluation.score import SequenceScore, SequenceScorer
from trainer.evaluation.voxelise import VoxelSettings
from trainer.evaluation.windows import picture_windows, regular_windows, windows_of_events, windows_of_seconds
from trainer.models import VoxelNetwork
from trainer.precision import ieee_products
from v2v_protocol.errors import UsageError
from v2v_recordings import layout
from v2v_recordings.items import Light

Advance = Callable[[str, int, int], None]
"""Progress callback: called with the sequence, the windows done, and the total number of windows."""


@dataclass(frozen=True)
class Drawing:
    """Hold what to draw.

    Attributes:
        folder: folder for pictures and videos; None draws none.
        rows: number of steps in the picture of a sequence, at least 1.
        video: whether to write a video of each sequence as well.

    Raises:
        UsageError: ``rows`` is below 1, or ``video`` is set without a folder.
    """

    folder: Path | None = None
    rows: int = 6
    video: bool = False

    def __post_init__(self) -> None:
        if self.rows < 1:
            raise UsageError(f"pictures with {self.rows} rows: give at least 1")
        if self.video and self.folder is None:
            raise UsageError("a video needs a folder to write it to: give --out")


@dataclass(frozen=True)
class Run:
    """Hold how to evaluate.

    Attributes:
        network: in evaluation mode.
        voxels: settings that the network requires.
        metrics: metrics by name.
        device: PyTorch device.
        as_published: see :mod:`trainer.evaluation.readers`.
        use_time_ranges: False scores all of each recording.
        fps: reconstruct this many pictures per second, not scored; None reconstructs at the pictures.
        window_pictures: number of pictures from a window's start to its end.
        window_seconds, window_events: length of windows in seconds, or in events; None for windows between pictures.
        size: height and width of the sensor, see :class:`Recording`.
        drawing: pictures and videos to write.
        stretch: see :func:`reconstruct`.
        light: see :class:`Recording`.
        score_blank: also score a blank picture in the mean grey of each target.
    """

    network: VoxelNetwork
    voxels: VoxelSettings
    metrics: Mapping[str, Metric]
    device: str = "cpu"
    as_published: bool = False
    use_time_ranges: bool = True
    fps: float | None = None
    window_pictures: int = 1
    window_seconds: float | None = None
    window_events: int | None = None
    size: tuple[int, int] | None = None
    drawing: Drawing = field(default_factory=Drawing)
    stretch: Stretch = "none"
    light: Light | None = None
    score_blank: bool = True


def find_recordings(data: Path, data_set: DataSet) -> dict[str, Path]:
    """Return the existing files of a data set by sequence, in the data set's order."""
    folder = data if data.is_dir() else data.parent
    found = {}
    for sequence in data_set.time_ranges:
        endings = [ending for suffix in layout.SUFFIXES for ending in (suffix, suffix.upper())]
        candidates = [folder / data_set.folder / f"{sequence}{ending}" for ending in endings]
        if data.is_file() and (data_set.folder, sequence) == (".", data.stem):
            candidates = [data]  # with any ending, even if a file with another one exists
        existing = next((path for path in candidates if path.is_file()), None)
        if existing is not None:
            found[sequence] = existing
    return found


def check_recording(run: Run, path: Path, data_set: DataSet) -> str:
    """Check that a recording can be evaluated; return the light of pictures that it states, "" if it states none.

    Raises:
        UsageError: see :class:`Recording`.
    """
    with Recording(path, as_published=run.as_published, size=run.size) as recording:
        _windows(run, recording, data_set)
        return recording.stated_light


def _windows(run: Run, recording: Recording, data_set: DataSet) -> list[EventWindow]:
    if run.fps is not None:
        return regular_windows(recording, run.fps)
    time_range = data_set.time_ranges[recording.name] if run.use_time_ranges else None
    if run.window_seconds is not None:
        return windows_of_seconds(recording, run.window_seconds, time_range)
    if run.window_events is not None:
        return windows_of_events(recording, run.window_events, time_range)
    later = data_set.published_shift if run.as_published else 0
    return picture_windows(recording, time_range, pictures=run.window_pictures, later=later)


def evaluate_sequence(
    run: Run, path: Path, data_set: DataSet, advance: Advance = lambda _sequence, _done, _total: None
) -> SequenceScore:
    """Score one recording, and draw it if requested.

    Raises:
        UsageError: see :class:`Recording` and :func:`reconstruct`.
    """
    with Recording(path, as_published=run.as_published, size=run.size, light=run.light) as recording, ieee_products():
        windows = _windows(run, recording, data_set)
        scorer = SequenceScorer(run.metrics, run.score_blank)
        rows = []
        shown = choose_steps(len(windows), run.drawing.rows)
        with _video(run.drawing, data_set.name, recording.name, windows) as video:
            steps = reconstruct(recording, windows, run.network, run.voxels, device=run.device, stretch=run.stretch)
            for number, step in enumerate(steps):
                scorer.add(step)
                if video is not None or (run.drawing.folder is not None and number in shown):
                    image = draw_step(step, windows[0].begin, with_camera=bool(recording.images))
                    if number in shown:
                        rows.append(image)
                    if video is not None:
                        video.add(image)
                advance(recording.name, number + 1, len(windows))
        if run.drawing.folder is not None:
            seconds = [window.end - window.begin for window in windows]
            sheet = draw_recording(rows, recording.name, seconds, with_camera=bool(recording.images))
            pictures.write_png(run.drawing.folder / data_set.name / f"{recording.name}.png", sheet)
        return scorer.score(data_set.name, recording.name, recording.repaired_images)


@contextlib.contextmanager
def _video(
    drawing: Drawing, data_set: str, sequence: str, windows: list[EventWindow]
) -> Iterator[pictures.Video | None]:
    if not drawing.video or drawing.folder is None:
        yield None
        return
    fps = max(1.0, len(windows) / (windows[-1].end - windows[0].begin))
    with pictures.Video(drawing.folder / data_set / f"{sequence}.mp4", fps) as video:
        yield video
