"""Evaluates data sets: finds their recordings, reconstructs and scores each, draws what is asked for."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from trainer import pictures
from trainer.evaluation import layout
from trainer.evaluation.cuts import DataSet
from trainer.evaluation.metrics import Metric
from trainer.evaluation.pictures import chosen_steps, draw_recording, draw_step
from trainer.evaluation.readers import EventWindow, Recording
from trainer.evaluation.reconstruct import Stretch, reconstruct
from trainer.evaluation.score import SequenceScore, SequenceScorer
from trainer.evaluation.voxelise import VoxelSettings
from trainer.evaluation.windows import picture_windows, regular_windows, windows_of_events, windows_of_seconds
from trainer.models import VoxelNetwork
from trainer.precision import ieee_products
from v2v_protocol.errors import UsageError

Advance = Callable[[str, int, int], None]
"""Called with the sequence, the windows done, and the windows in all."""


@dataclass(frozen=True)
class Drawing:
    """What to draw.

    Attributes:
        folder: where to; None draws nothing.
        rows: steps in the picture of a sequence.
        video: also write a video of each sequence.
    """

    folder: Path | None = None
    rows: int = 6
    video: bool = False

    def __post_init__(self) -> None:
        if self.rows < 1:
            raise UsageError(f"pictures with {self.rows} rows: give at least 1")
        if self.video and self.folder is None:
            raise UsageError("a video needs --out, the folder to write it to")


@dataclass(frozen=True)
class Run:
    """How to evaluate.

    Attributes:
        network: in evaluation mode.
        voxels: as the network wants them.
        metrics: by name.
        device: of PyTorch.
        as_published: see :mod:`trainer.evaluation.readers`.
        use_cuts: False scores all of each recording.
        fps: reconstruct at this rate instead of at the pictures; nothing is scored then.
        window_pictures: windows from a picture to the one that is so many on.
        window_seconds, window_events: windows of so long, or of so many events, in place of those between pictures.
        size: of the sensor, see :class:`Recording`.
        drawing: pictures and videos.
        stretch: see :func:`reconstruct`.
    """

    network: VoxelNetwork
    voxels: VoxelSettings
    metrics: Mapping[str, Metric]
    device: str = "cpu"
    as_published: bool = False
    use_cuts: bool = True
    fps: float | None = None
    window_pictures: int = 1
    window_seconds: float | None = None
    window_events: int | None = None
    size: tuple[int, int] | None = None
    drawing: Drawing = field(default_factory=Drawing)
    stretch: Stretch = "none"


def find_recordings(data: Path, data_set: DataSet) -> dict[str, Path]:
    """Files of the sequences of a data set that are there, by sequence, in the data set's order."""
    folder = data if data.is_dir() else data.parent
    found = {}
    for sequence in data_set.cuts:
        candidates = [folder / data_set.folder / f"{sequence}{suffix}" for suffix in layout.SUFFIXES]
        if data.is_file() and (data_set.folder, sequence) == (".", data.stem):
            candidates = [data]  # whatever its ending, and whatever lies beside it
        existing = next((path for path in candidates if path.is_file()), None)
        if existing is not None:
            found[sequence] = existing
    return found


def check_data_set(run: Run, data: Path, data_set: DataSet) -> None:
    """Look into the recordings that are there, so that the last one is not refused when all others have been evaluated.

    Raises:
        UsageError: see :class:`Recording`.
    """
    for path in find_recordings(data, data_set).values():
        with Recording(path, as_published=run.as_published, size=run.size) as recording:
            _windows(run, recording, data_set)


def _windows(run: Run, recording: Recording, data_set: DataSet) -> list[EventWindow]:
    if run.fps is not None:
        return regular_windows(recording, run.fps)
    cut = data_set.cuts[recording.name] if run.use_cuts else None
    if run.window_seconds is not None:
        return windows_of_seconds(recording, run.window_seconds, cut)
    if run.window_events is not None:
        return windows_of_events(recording, run.window_events, cut)
    later = data_set.published_later if run.as_published else 0
    return picture_windows(recording, cut, pictures=run.window_pictures, later=later)


def evaluate_data_set(
    run: Run, data: Path, data_set: DataSet, advance: Advance = lambda _sequence, _done, _total: None
) -> Iterator[SequenceScore]:
    """Scores of the sequences that are there, one after another.

    Raises:
        UsageError: see :class:`Recording` and :func:`reconstruct`.
    """
    for path in find_recordings(data, data_set).values():
        yield evaluate_sequence(run, path, data_set, advance)


def evaluate_sequence(
    run: Run, path: Path, data_set: DataSet, advance: Advance = lambda _sequence, _done, _total: None
) -> SequenceScore:
    """Score, and draw, one recording."""
    with Recording(path, as_published=run.as_published, size=run.size) as recording, ieee_products():
        windows = _windows(run, recording, data_set)
        scorer = SequenceScorer(run.metrics)
        rows = []
        shown = chosen_steps(len(windows), run.drawing.rows)
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
