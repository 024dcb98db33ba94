"""A corpus and a recipe so small that benches run in seconds."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from tests.clips import write_panned

FLAGS = ["--set", "voxels_per_clip=4", "--set", "crop_height_px=32", "--set", "crop_width_px=40"]


def clips(folder: Path) -> Path:
    """Write three clips, twelve sequences, to a new folder; return it."""
    return write_panned(folder, 3, 90, gop=15)


def records(file: Path) -> list[dict[str, Any]]:
    """Return what a command wrote."""
    return list(json.loads(file.read_text(encoding="utf-8")))
