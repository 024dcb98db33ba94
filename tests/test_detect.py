"""The example of a detector: it runs on rendered clips, and its figure is that of known detections."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from examples import detect, render_sprites
from tests.clips import panned_luma, write_clip

Detection = tuple[float, int, tuple[float, ...]]
"""Score, class and corners."""


class Known(torch.nn.Module):
    """Find the boxes that it is given: each at one cell, with a score."""

    def __init__(self, found: list[Detection]) -> None:
        super().__init__()
        self._found = found

    def forward(self, histograms: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        scores, distances = torch.full((1, 1, detect.CLASSES, 8, 8), -20.0), torch.ones(1, 1, 4, 8, 8)
        for score, kind, (x0, y0, x1, y1) in self._found:
            column, row = int((x0 + x1) / 2 // detect.STRIDE), int((y0 + y1) / 2 // detect.STRIDE)
            x, y = (column + 0.5) * detect.STRIDE, (row + 0.5) * detect.STRIDE
            scores[0, 0, kind, row, column] = score
            distances[0, 0, :, row, column] = torch.tensor([x - x0, y - y0, x1 - x, y1 - y])
        return scores, distances


FIRST, SECOND, OTHER = (4.0, 4.0, 20.0, 20.0), (30.0, 10.0, 50.0, 30.0), (10.0, 40.0, 30.0, 60.0)


@pytest.mark.parametrize(
    ("found", "expected"),
    [
        ([(3.0, 0, FIRST), (2.0, 0, SECOND), (1.0, 1, OTHER)], 1.0),
        ([(3.0, 0, FIRST), (1.0, 1, OTHER)], 0.75),  # class 0: half of the objects
        ([(3.0, 0, (44.0, 44.0, 60.0, 60.0)), (1.0, 1, (44.0, 44.0, 60.0, 60.0))], 0.0),
        ([(3.0, 0, OTHER), (2.0, 0, FIRST), (1.0, 0, SECOND), (1.0, 1, OTHER)], (2 / 3 + 1) / 2),
    ],
)
def test_average_precision_of_known_detections(
    found: list[tuple[float, int, tuple[float, ...]]], expected: float
) -> None:
    true = torch.tensor([[*FIRST, 0, 0, 1], [*SECOND, 0, 1, 1], [*OTHER, 1, 2, 1]])
    batch = SimpleNamespace(boxes=[[true]], event_counts=torch.zeros(1, 1, 2, detect.BINS, 64, 64, dtype=torch.int8))
    assert detect.average_precision(Known(found), [batch]) == pytest.approx(expected)  # type: ignore[arg-type]


@pytest.mark.slow
def test_it_runs_on_rendered_clips(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("a", "b"):
        write_clip(tmp_path / f"{name}.mp4", panned_luma(61, 48, 64))
    (tmp_path / "0-damaged.mp4").write_bytes((tmp_path / "a.mp4").read_bytes()[:1000])
    (tmp_path / "c-empty.mp4").touch()
    out = tmp_path / "sprites"
    render_sprites.main(["--footage", str(tmp_path), "--out", str(out), "--clips", "2"])
    labels = json.loads((out / "train" / "0000.boxes.json").read_text())
    assert len(labels["images"]) == render_sprites.FRAMES
    folders = ["--videos", str(out / "train"), "--held-out", str(out / "held-out")]
    assert detect.main([*folders, "--minutes", "0.001"]) == 0
    assert "AP50 on" in capsys.readouterr().out
