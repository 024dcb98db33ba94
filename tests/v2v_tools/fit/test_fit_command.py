"""The command line of `v2v-fit`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from v2v_server.config import recipe_setting
from v2v_tools.fit.command import main


@pytest.fixture
def events(tmp_path: Path) -> Path:
    """A text file of events of a small sensor, 2 ms or more apart in each pixel."""
    rng = np.random.default_rng(0)
    gaps = 2e-3 + rng.exponential(0.01, (64, 60))
    rows = [(t, pixel % 8, pixel // 8) for pixel, times in enumerate(np.cumsum(gaps, axis=1)) for t in times]
    lines = [f"{t:.6f} {x} {y} {int(rng.random() < 0.5)}\n" for t, x, y in sorted(rows)]
    path = tmp_path / "events.txt"
    path.write_text("8 8\n" + "".join(lines))
    return path


def test_a_recording_of_events_becomes_a_recipe_and_a_picture(
    events: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recipe, picture = tmp_path / "camera.yaml", tmp_path / "camera.png"
    assert main([str(events), "--static", "--out", str(recipe), "--picture", str(picture)]) == 0
    low, high = recipe_setting(str(recipe), ()).refractory_seconds
    assert low <= 2e-3 <= high
    printed = capsys.readouterr().out
    assert "threshold_pos: this recording cannot tell: 0 changes" in printed
    assert all(line in recipe.read_text() for line in printed.splitlines())
    with Image.open(picture) as page:
        assert page.width == 1400


def test_a_recording_without_frames_leaves_no_file(
    events: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = set(tmp_path.iterdir())
    assert main([str(events), "--out", str(tmp_path / "camera.yaml"), "--picture", str(tmp_path / "camera.png")]) == 1
    assert "has 0 frames, and a fit needs 3" in capsys.readouterr().err
    assert set(tmp_path.iterdir()) == before


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "nothing to do: give a RECORDING and --out, or --check RECIPE"),
        (["{events}"], "belong together"),
        (["--check", "paper", "--out", "x.yaml"], "belong together"),
        (["{events}", "--out", "camera.txt"], "give a name that ends in .yaml"),
        (["{events}", "--out", "camera.yaml", "--size", "big"], "give WIDTHxHEIGHT"),
        (["{events}", "--out", "camera.yaml", "--size", "7x8"], "an event lies outside 7x8 px"),
        (["{events}", "--out", "camera.yaml", "--size", "8x7"], "an event lies outside 8x7 px"),
        (["missing.raw", "--out", "camera.yaml"], "no file or folder missing.raw"),
        (["--check", "no-such-preset"], "unknown recipe"),
        (["--check", "paper", "--static"], "--static needs a RECORDING"),
        (["{events}", "--out", "camera.yaml", "--sheet", "sheet.yaml"], "--sheet needs --check"),
    ],
)
def test_wrong_usage_says_what_to_give(
    arguments: list[str], message: str, events: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    assert main([argument.format(events=events) for argument in arguments]) == 2
    assert message in capsys.readouterr().err
    assert not list(tmp_path.glob("camera.*"))


def test_a_recording_that_does_not_state_its_size_needs_one(events: Path, capsys: pytest.CaptureFixture[str]) -> None:
    events.write_text("".join(events.read_text().splitlines(keepends=True)[1:]))
    assert main([str(events), "--out", "x.yaml"]) == 2
    assert "give --size WIDTHxHEIGHT" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("count", "message"),
    [(1, "all events have the same time"), (3, "no parameter could be fitted"), (20, "no parameter could be fitted")],
)
def test_a_recording_that_fits_nothing_leaves_no_file(
    count: int, message: str, events: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    few = tmp_path / "few.txt"
    few.write_text("\n".join(events.read_text().splitlines()[: count + 1]) + "\n")
    before = set(tmp_path.iterdir())
    out = ["--out", str(tmp_path / "camera.yaml"), "--picture", str(tmp_path / "camera.png")]
    assert main([str(few), "--static", *out]) == 1
    assert message in capsys.readouterr().err
    assert set(tmp_path.iterdir()) == before
