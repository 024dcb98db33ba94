"""A corpus and a recipe so small that whole benchmarks run in seconds."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from tests.clips import panned_luma, write_clip
from v2v_protocol.recipe import Recipe

RECIPE = Recipe(voxels_per_clip=4, bins=5, crop_height_px=32, crop_width_px=40)
"""Needs 21 frames."""
FLAGS = ["--set", "voxels_per_clip=4", "--set", "crop_height_px=32", "--set", "crop_width_px=40"]


def clips(folder: Path) -> Path:
    """A folder of three clips: twelve sequences."""
    folder.mkdir()
    for number in range(3):
        write_clip(folder / f"{number}.mp4", panned_luma(90, step=(1, 1 + number)), gop=15)
    return folder


def records(file: Path) -> list[dict[str, Any]]:
    """What a command wrote."""
    return list(json.loads(file.read_text(encoding="utf-8")))


def is_picture(file: Path) -> bool:
    """Whether it is a PNG that shows something."""
    content = file.read_bytes()
    return content.startswith(b"\x89PNG") and len(content) > 5000


def one_line(capsys: pytest.CaptureFixture[str], name: str) -> bool:
    """Whether one line was written to stderr, by that command."""
    error = capsys.readouterr().err
    return error.startswith(f"{name}: ") and error.count("\n") == 1
