"""Make the pictures that a shipped configuration trains on, all of them free to use: ``v2v-train data firenet-cpu``.

``trainer/configs/firenet-cpu.csv`` lists photographs of the installed scikit-image, each with the licence that its
documentation states. The others are drawn here, as dead leaves: opaque shapes of all sizes in front of each other, with
textures. Such pictures share edges, occlusions and greys with photographs, and they belong to this project.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from v2v_protocol.command import Parser, run_command
from v2v_protocol.errors import UsageError

LISTS = Path(__file__).parents[1] / "configs"
DRAWN, _SIDE_PX, _SHAPES, _LEAST_PX, _MOST_PX = 30, 512, 800, 9.0, 160.0


def collect(configuration: str, out: Path) -> int:
    """Write the pictures to ``out``/training/photographs and ``out``/held-out/photographs; return their number.

    Raises:
        UsageError: the configuration has no list, or the installed scikit-image has other pictures than listed.
        OSError: a picture cannot be written.
    """
    lists = {path.stem: path for path in sorted(LISTS.glob("*.csv"))}
    if configuration not in lists:
        raise UsageError(f"{configuration!r} has no list of pictures; give one of: {', '.join(lists)}")
    rows = list(csv.DictReader(lists[configuration].read_text().splitlines()))
    folders = {part: out / part / "photographs" for part in ("training", "held-out")}
    for folder in folders.values():
        folder.mkdir(parents=True, exist_ok=True)
    for row in rows:
        picture = files("skimage.data") / row["file"]
        data = picture.read_bytes() if picture.is_file() else b""
        if not hashlib.sha256(data).hexdigest().startswith(row["sha256"]):
            raise UsageError(f"{picture}: missing, or not the listed picture; pip install scikit-image==0.26.0 has it")
        (folders[row["set"]] / row["file"]).write_bytes(data)
    for number in range(DRAWN):
        Image.fromarray(dead_leaves(number)).save(folders["training"] / f"leaves-{number:02}.png")
    return len(rows) + DRAWN


def dead_leaves(seed: int) -> NDArray[np.uint8]:
    """Draw a picture [512, 512], uint8: the same for the same seed."""
    random = np.random.default_rng(seed)
    rows, columns = np.mgrid[:_SIDE_PX, :_SIDE_PX].astype(float)
    picture = 0.5 + 0.1 * _texture(random)
    texture = _texture(random)
    # Probability falls with the cube of the size: the picture then looks the same at any zoom.
    for size in (_MOST_PX**-2 + random.random(_SHAPES) * (_LEAST_PX**-2 - _MOST_PX**-2)) ** -0.5:
        row, column = random.uniform(0, _SIDE_PX, 2)
        angle, stretch, grey = random.uniform(0, np.pi), random.uniform(0.4, 1), random.beta(0.8, 0.8)
        box = tuple(slice(max(int(at - size), 0), int(at + size) + 1) for at in (row, column))
        y, x = rows[box] - row, columns[box] - column
        u, v = np.cos(angle) * x + np.sin(angle) * y, (np.cos(angle) * y - np.sin(angle) * x) / stretch
        inside = (u**2 + v**2 < size**2) if random.random() < 0.6 else (np.maximum(abs(u), abs(v)) < 0.7 * size)
        shade = grey + random.normal(0, 0.15) * u / size + random.exponential(0.06) * texture[box]
        if random.random() < 0.2:
            shade = shade + random.uniform(0.05, 0.3) * np.sign(np.sin(u * random.uniform(0.2, 1.2)))
        picture[box] = np.where(inside, shade, picture[box])
    return np.asarray(np.rint(255 * picture.clip(0, 1)), np.uint8)


def _texture(random: np.random.Generator) -> NDArray[np.float64]:
    """Draw noise whose amplitude falls with frequency, as that of photographs does: mean 0, deviation 1."""
    frequency = np.hypot(np.fft.fftfreq(_SIDE_PX)[:, None], np.fft.rfftfreq(_SIDE_PX))
    frequency[0, 0] = np.inf
    noise = np.fft.irfft2(np.fft.rfft2(random.normal(size=(_SIDE_PX, _SIDE_PX))) / frequency)
    return np.asarray(noise / noise.std())


def _run(asked: argparse.Namespace) -> int:
    try:
        print(f"{collect(asked.configuration, asked.out)} pictures in {asked.out}")
    except OSError as error:
        raise UsageError(f"{asked.out}: {error.strerror or error}; give another --out, or free space there") from error
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line."""
    name = "v2v-train data"
    said = "Make the pictures that a shipped configuration trains on. Nothing is downloaded."
    parser = Parser(name, "CONFIGURATION [flags]", said, [f"{name} firenet-cpu", f"{name} firenet-cpu --out DIR"])
    parser.add_argument("configuration", help="name of a shipped configuration")
    parser.add_argument(
        "--out", type=Path, default=Path("data/firenet"), metavar="DIR", help="folder (default data/firenet)"
    )
    return run_command(parser, _run, arguments)
