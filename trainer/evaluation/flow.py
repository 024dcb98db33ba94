"""Score a network's optical flow on recordings with known flow (MVSEC), next to a prediction of no motion.

EE is the length of a pixel's error, in px over one window. The scores of a window are the mean (AEE) and the share of
pixels with EE above 3 (3PE); those of a sequence are the means over its windows. *Dense* scores are over all pixels
with known flow. *Sparse* scores are over those of them with events in the window's voxel grid. "zeros" is the score of
predicting no motion: it needs no network, so it checks files, windows and masks.

The default and the published conventions differ:

| | correct (default) | as published |
|---|---|---|
| flow field i belongs to | the window that begins at its time, as EV-FlowNet and E-RAFT define it | the window before |
| the car's hood | rows from 190 on do not count in sequences ``outdoor*`` (EV-FlowNet) | counts |
| a window without pixels that count | is left out | scores 0 |
| events of the sparse scores, for E-RAFT | those of the window | those of the window before |
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from rich.markup import escape
from rich.table import Table

from trainer import pictures
from trainer.evaluation import paper
from trainer.evaluation.data_sets import TimeRange
from trainer.evaluation.readers import EventWindow, Recording
from trainer.evaluation.voxelise import VoxelSettings, voxel_grid
from trainer.evaluation.windows import flow_windows
from trainer.models import VoxelNetwork
from trainer.precision import ieee_products
from v2v_protocol.errors import UsageError

FlowImage = npt.NDArray[np.float32]
"""[2, H, W], (x, y) px."""

HOOD_ROW = 190
LARGE_PX = 3.0
FLOW_METRICS: dict[str, tuple[str, Callable[[FlowImage], float]]] = {
    "aee": ("AEE", lambda error: float(error.mean())),
    "3pe": ("3PE %", lambda error: 100 * float((error > LARGE_PX).mean())),
}
"""Title and definition of each metric, from the error of the pixels that count, [n] px; each has two scores."""


def titles() -> dict[str, str]:
    """Return the titles of all scores by name: each metric of the dense pixels, then of the sparse ones."""
    kinds = ("dense", ""), ("sparse", " sparse")
    return {f"{name}_{kind}": title + more for name, (title, _) in FLOW_METRICS.items() for kind, more in kinds}


@dataclass
class FlowScore:
    """Average the scores over the windows of a sequence, by the names of :func:`titles`. 3PE is in per cent."""

    as_published: bool
    windows: int = 0
    _values: dict[str, list[float]] = field(default_factory=dict)

    def add(self, prediction: FlowImage, truth: FlowImage, events: npt.NDArray[np.bool_], rows: int) -> None:
        """Add the scores of a window.

        Args:
            prediction: [2, H, W] (x, y), px.
            truth: the same; NaN, or 0 in both components, where it is not known.
            events: bool [H, W], whether a pixel has events.
            rows: number of rows from the top that count.
        """
        self.windows += 1
        known = np.isfinite(truth).all(axis=0) & (truth != 0).any(axis=0)
        known[rows:] = False
        error = np.hypot(*np.where(known, prediction - truth, 0))
        for kind, counted in (("dense", known), ("sparse", known & events)):
            for name, (_, metric) in FLOW_METRICS.items():
                if counted.any() or self.as_published:
                    score = metric(error[counted]) if counted.any() else 0.0
                    self._values.setdefault(f"{name}_{kind}", []).append(score)

    @property
    def means(self) -> dict[str, float]:
        """Return the means by name. Scores without any counted pixel in any window are left out."""
        return {name: float(np.mean(self._values[name])) for name in titles() if name in self._values}


@dataclass(frozen=True)
class FlowRun:
    """Hold how to evaluate flow.

    Attributes:
        network: a network of task "flow".
        voxels: settings that the network requires.
        device: PyTorch device.
        as_published: see the module.
        out: folder for a picture of each sequence; None draws none.
        size: height and width of the sensor, for recordings that do not state it.
    """

    network: VoxelNetwork
    voxels: VoxelSettings
    device: str = "cpu"
    as_published: bool = False
    out: Path | None = None
    size: tuple[int, int] | None = None


def evaluate_flow(
    run: FlowRun,
    path: Path,
    time_range: TimeRange | None,
    advance: Callable[[str, int, int], None] = lambda _name, _done, _total: None,
) -> dict[str, FlowScore]:
    """Return the scores of the network and of "zeros" on one recording.

    Raises:
        UsageError: see :class:`Recording`; or the recording has no flow; or the network's output is not finite.
    """
    scores = {name: FlowScore(run.as_published) for name in ("network", "zeros")}
    with Recording(path, as_published=run.as_published, size=run.size) as recording, ieee_products():
        windows = flow_windows(recording, time_range, one_later=run.as_published)
        hood = recording.name.startswith("outdoor") and not run.as_published
        rows = HOOD_ROW if hood else recording.size[0]
        late = run.as_published and run.network.lead_voxels > 0
        earlier = np.zeros(recording.size, bool)
        for number, (window, grid, prediction) in enumerate(_estimate(run, recording, windows), start=1):
            truth = recording.flow(window)
            events = (grid != 0).any(axis=0)
            scores["network"].add(prediction, truth, earlier if late else events, rows)
            scores["zeros"].add(np.zeros_like(truth), truth, events, rows)
            if run.out is not None and number == max(1, len(windows) // 2):
                _draw(run.out / f"{recording.name}.png", grid, truth, prediction)
            earlier = events
            advance(recording.name, number, len(windows))
    return scores


def _estimate(
    run: FlowRun, recording: Recording, windows: Sequence[EventWindow]
) -> Iterator[tuple[EventWindow, npt.NDArray[np.float32], FlowImage]]:
    """Yield window, voxel grid and prediction [2, H, W], in order. The network's memory runs from first to last."""
    network, state = run.network.to(run.device).eval(), None
    # A network that also uses the previous window gets zeros before the first.
    before = [np.zeros((run.voxels.bins, *recording.size), np.float32)] * network.lead_voxels
    for window in windows:
        events = recording.events(window)
        grid = voxel_grid(events, recording.size, run.voxels, (window.begin, window.end))
        piece = torch.from_numpy(np.stack([*before, grid]))[None].to(run.device)
        with torch.inference_mode():
            outputs, state = network(piece, state)
        before, prediction = [], outputs[0, -1].float().cpu().numpy()
        if not np.isfinite(prediction).all():
            raise UsageError(f"{recording.path}: the network's output is not finite at {window.begin:.3f} s")
        yield window, grid, prediction


def _draw(path: Path, grid: npt.NDArray[np.float32], truth: FlowImage, prediction: FlowImage) -> None:
    known = np.nan_to_num(truth)
    scale = pictures.flow_scale(known)
    panels = [pictures.draw_events(grid), *(pictures.draw_flow(flow, scale) for flow in (known, prediction))]
    drawn = pictures.side_by_side([panel[None] for panel in panels])[0]
    pictures.write_png(path, pictures.add_header(drawn, (pictures.EVENTS, "true flow", "estimated flow")))


def flow_table(name: str, scores: Mapping[str, Mapping[str, FlowScore]], compared: Sequence[str]) -> Table:
    """Format a block of rows per sequence: network, zeros, and the paper's values."""
    rows = Table(title=escape(name), title_justify="left")
    for column in ("sequence", "windows", *titles().values()):
        rows.add_column(column, justify="left" if column == "sequence" else "right", no_wrap=True)
    for sequence, found in scores.items():
        for predictor, score in found.items():
            label = escape(sequence) if predictor == "network" else f"  {predictor}"
            rows.add_row(label, str(score.windows), *_numbers(score.means))
        for method in compared:
            stated = paper.FLOW.get(method, {}).get(sequence)
            if stated is not None:
                rows.add_row(f"  paper: {method}", "", *_numbers(stated), style="dim")
    return rows


def _numbers(values: Mapping[str, float]) -> list[str]:
    return [f"{values[name]:.3f}" if math.isfinite(values.get(name, math.nan)) else "-" for name in titles()]


def flow_records(
    name: str, scores: Mapping[str, Mapping[str, FlowScore]], settings: Mapping[str, object]
) -> list[dict[str, object]]:
    """Return a flat record per sequence and predictor."""
    return [
        {
            "data_set": name,
            "sequence": sequence,
            "predictor": predictor,
            "windows": score.windows,
            **score.means,
            **settings,
        }
        for sequence, found in scores.items()
        for predictor, score in found.items()
    ]
