"""Check the types of the documentation's Python snippets: ``python -m tests.tools.snippets``.

Each page is one module: its fenced Python blocks in order, after the names that its reader has of their own.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGES = (
    "README.md",
    "docs/index.md",
    "docs/flow.md",
    *(f"docs/guides/{name}.md" for name in ("train-your-network", "look", "detection")),
)
THEIR_OWN = """\
import os
from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import torch

from v2v_client import V2VStreamDataset

network: torch.nn.Module
loss_of: Callable[[torch.Tensor, torch.Tensor], torch.Tensor]
frames: npt.NDArray[np.uint8]
pictures: torch.Tensor
"""
_BLOCK = re.compile(r"^```python\n(.*?)^```$", re.M | re.S)


def snippets(page: str) -> list[str]:
    """Return the Python blocks of a page, given by its path below the root."""
    return _BLOCK.findall((ROOT / page).read_text(encoding="utf-8"))


def check() -> int:
    """Run ``mypy --strict`` on the pages; return its exit status."""
    with tempfile.TemporaryDirectory() as folder:
        for page in PAGES:
            module = Path(folder, re.sub(r"\W", "_", page) + ".py")
            module.write_text("\n".join((THEIR_OWN, *snippets(page))), encoding="utf-8")
        command = [sys.executable, "-m", "mypy", "--strict", "--follow-imports=silent", "--config-file=", folder]
        return subprocess.run(command, cwd=ROOT, check=False).returncode


if __name__ == "__main__":
    sys.exit(check())
