"""Make the pictures that a shipped configuration trains on, all of them free to use: ``v2v-train data firenet-cpu``.

``trainer/configs/firenet-cpu.csv`` lists photographs of the installed scikit-image, each with the licence that its
documentation states. The others are drawn here, as dead leaves: opaque shapes of all sizes in front of each other, with
textures. Their edges, occlusions and greys are distributed as those of photographs are, and they belong to this project.
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
LEAVES = 30
"""Pictures that are drawn for training."""
_SIDE_PX = 512
_SHAPES = 800
_LEAST_PX, _MOST_PX = 9.0, 160.0

Grey = NDArray[np.float64]


def collect(configuration: str, out: Path) -> int:
    """Write the pictures to ``out``/training/photographs and ``out``/held-out/photographs; return their number.

    Raises:
        UsageError: the configuration has no list, or the installed scikit-image has other pictures than listed.
    """
    listed = LISTS / f"{configuration}.csv"
    if not listed.is_file():
        known = ", ".join(sorted(path.stem for path in LISTS.glob("*.csv")))
        raise UsageError(f"{configuration!r} has no list of pictures; give one of: {known}")
    rows = list(csv.DictReader(listed.read_text().splitlines()))
    for row in rows:
        picture = files("skimage.data") / row["file"]
        data = picture.read_bytes() if picture.is_file() else b""
        if digest_of(data) != row["sha256"]:
            raise UsageError(f"{picture}: not the listed picture; pip install scikit-image==0.26.0 has it")
        _place(out, row["set"], row["file"]).write_bytes(data)
    for number in range(LEAVES):
        Image.fromarray(dead_leaves(number)).save(_place(out, "training", f"leaves-{number:02}.png"))
    return len(rows) + LEAVES


def digest_of(data: bytes) -> str:
    """Return the first 16 hexadecimal digits of the SHA-256 of a file."""
    return hashlib.sha256(data).hexdigest()[:16]


def dead_leaves(seed: int) -> NDArray[np.uint8]:
    """Draw a picture [512, 512], uint8: the same for the same seed."""
    random = np.random.default_rng(seed)
    rows, columns = np.mgrid[:_SIDE_PX, :_SIDE_PX].astype(float)
    picture = 0.5 + 0.1 * _texture(random)
    texture = _texture(random)
    # Probability falls with the cube of the size: the picture then looks the same at any zoom.
    sizes = (_MOST_PX**-2 + random.random(_SHAPES) * (_LEAST_PX**-2 - _MOST_PX**-2)) ** -0.5
    for size in sizes:
        row, column = random.uniform(0, _SIDE_PX, 2)
        angle, stretch, grey = random.uniform(0, np.pi), random.uniform(0.4, 1), random.beta(0.8, 0.8)
        down, right = (slice(max(int(at - size), 0), int(at + size) + 1) for at in (row, column))
        y, x = rows[down, right] - row, columns[down, right] - column
        u, v = np.cos(angle) * x + np.sin(angle) * y, (np.cos(angle) * y - np.sin(angle) * x) / stretch
        inside = (u**2 + v**2 < size**2) if random.random() < 0.6 else (np.maximum(abs(u), abs(v)) < 0.7 * size)
        shade = grey + random.normal(0, 0.15) * u / size + random.exponential(0.06) * texture[down, right]
        if random.random() < 0.2:
            shade = shade + random.uniform(0.05, 0.3) * np.sign(np.sin(u * random.uniform(0.2, 1.2)))
        picture[down, right] = np.where(inside, shade, picture[down, right])
    return np.rint(255 * picture.clip(0, 1)).astype(np.uint8)


def _texture(random: np.random.Generator) -> Grey:
    """Draw noise whose amplitude falls with frequency, as that of photographs does: mean 0, deviation 1."""
    frequency = np.hypot(np.fft.fftfreq(_SIDE_PX)[:, None], np.fft.rfftfreq(_SIDE_PX))
    frequency[0, 0] = np.inf
    noise = np.fft.irfft2(np.fft.rfft2(random.normal(size=(_SIDE_PX, _SIDE_PX))) / frequency)
    return np.asarray(noise / noise.std())


def _place(out: Path, part: str, name: str) -> Path:
    folder = out / part / "photographs"
    folder.mkdir(parents=True, exist_ok=True)
    return folder / name


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
