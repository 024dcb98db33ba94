"""A corpus and a recipe so small that benches run in seconds."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from tests.clips import panned_luma, write_clip
from v2v_protocol.recipe import Recipe

RECIPE = Recipe(voxels_per_clip=4, bins=5, crop_height_px=32, crop_width_px=40)
"""Needs 21 frames."""
FLAGS = ["--set", "voxels_per_clip=4", "--set", "crop_height_px=32", "--set", "crop_width_px=40"]


def clips(folder: Path) -> Path:
    """Write three clips, twelve sequences, to a new folder; return it."""
    folder.mkdir()
    for number in range(3):
        write_clip(folder / f"{number}.mp4", panned_luma(90, step=(1, 1 + number)), gop=15)
    return folder


def records(file: Path) -> list[dict[str, Any]]:
    """Return what a command wrote."""
    return list(json.loads(file.read_text(encoding="utf-8")))
