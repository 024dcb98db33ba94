"""What people will add, added: a toy through each seam, in a copy of the packages, with two lines besides its own file.

``docs/extending.md`` tells how; this is the proof that it is all there is to do.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.client.fake_server import FakeServer, expected
from tests.clips import panned_luma, write_clip
from v2v_client import V2VStreamDataset
from v2v_protocol import sample
from v2v_protocol.sample import ArrayForm
from v2v_server.simulation.representations import NAMES
from v2v_server.worker.arrays.context import ARRAY_BUILDERS

ROOT = Path(__file__).parents[1]

EFFECT = '''
"""Event loss: the readout drops each step's events of a pixel with the chance of the field."""

import numpy as np

from v2v_server.simulation.effects.state import hook
from v2v_server.simulation.pixel import PIXELS_A_BLOCK, folds_of, word

FIELD, ROWS = "event_loss", 0
NOISE, PANEL = False, "rates"
PURPOSES = PIXEL, STEP = 1016, 1017


def prepare(value, clip):
    return np.uint32(value * 2**32)


@hook
def after(chance, own, block, at):
    if chance > 0:
        pixel, step = folds_of(block.key, PIXEL), word(folds_of(block.key, STEP), at.step)
        for i in range(PIXELS_A_BLOCK):
            if word((word(pixel, at.first + i), step), 0) < chance:
                block.rises[i] = block.falls[i] = block.tolerance - block.tolerance
'''
TILT = '''
"""Tilt t: brighter events need 1 + t times their threshold, darker ones 1 - t times theirs."""

from v2v_server.simulation.effects.state import hook
from v2v_server.simulation.pixel import PIXELS_A_BLOCK

FIELD, ROWS = "threshold_tilt", 0
NOISE, PANEL = False, "pixels"


def prepare(value, clip):
    return clip.real(1 + value), clip.real(1 - value)


@hook
def start(shares, own, block, at):
    for i in range(PIXELS_A_BLOCK):
        block.positive[i] *= shares[0]
        block.negative[i] *= shares[1]
'''
EFFECT_LINES = (
    ("v2v_protocol/recipe.py", "    dead_pixel_share: Range =",
     '    event_loss: Range = span((0.0, 0.0), 0.0, 0.99, "chance that the events of a step get lost")\n'
     '    threshold_tilt: Range = span((0.0, 0.0), -0.99, 0.99, "tilt of the thresholds, either way",\n'
     '        worst=lambda tilt, *_: Worst(1 - abs(tilt), 1 + abs(tilt)))\n'),
    ("v2v_server/simulation/effects/__init__.py", '        "dead_pixels",',
     '        "event_loss",\n        "threshold_tilt",\n'),
)  # fmt: skip

ARRAY = '''
"""Depth, of a world in which what is brighter is nearer; and an array that takes from the simulation what it wants."""

from v2v_server.worker.arrays.context import makes


@makes("depth")
def depth(context, out):
    out[:, 0] = 255.0 - context.view[context.source[context.target_steps]]


@makes("listed")
def listed(context, out):
    out[0] = len(context.simulated.to_events(1e3).t)
'''
ARRAY_LINES = (
    ("v2v_protocol/sample.py", '    "flow_valid": ArrayForm(',
     '    "depth": ArrayForm(lambda recipe, _: ("float32", (recipe.voxels_per_clip, 1, *recipe.crop_px))),\n'
     '    "listed": ArrayForm(lambda recipe, _: ("float32", (1,)), Needs(events=True)),\n'),
    ("v2v_server/worker/arrays/__init__.py", '    "flow",', '    "depth",\n'),
)  # fmt: skip

REPRESENTATION = '''
"""Whether a pixel fired in a bin."""

from v2v_server.simulation.effects.state import hook


@hook
def end(fired, counts):
    if len(fired) > 0:
        for i in range(counts.last - counts.first):
            fired[counts.grid, counts.bin, counts.first + i] = counts.on[i] + counts.off[i] > 0
    return 0
'''
ACTIVITY = '''
"""Events of each voxel grid, of all pixels together: [grids]."""

from v2v_server.simulation.effects.state import hook


def prepare(memory, given, segments, real):
    memory[:] = 0
    return memory


@hook
def end(activity, counts):
    if len(activity) > 0:
        for i in range(counts.last - counts.first):
            activity[counts.grid] += counts.on[i] + counts.off[i]
    return 0
'''
REPRESENTATION_LINES = (
    (
        "v2v_protocol/sample.py",
        '    "time_surface": of_events(',
        '    "fired": of_events(lambda dtype, *shape: (dtype, shape)),\n'
        '    "activity": of_events(lambda dtype, grids, *_: ("float32", (grids,))),\n',
    ),
)

USE = """
import json, sys
from pathlib import Path
import numpy as np
from v2v_protocol.recipe import Recipe
from v2v_protocol.spec import StreamSpec
from v2v_server.corpus.catalogue import open_catalogue
from v2v_tools.remake import remake
from v2v_server.simulation import noise, simulate
from v2v_server.simulation.draw import draw
from v2v_server.simulation.effects import NOISE, event_loss
from v2v_server.simulation.effects.kernel import simulate_general
sys.path.append(sys.argv[2])
from tests.oracles.noise import scramble, words

folder = Path(sys.argv[1])
catalogue = open_catalogue(folder, processes=0, cache_dir=folder)
small = {"voxels_per_clip": 20, "bins": 1, "crop_height_px": 16, "crop_width_px": 24, "hot_pixel_share": 0.0,
         "pause_probability": 0.0, "flip_probability": 0.0, "threshold": 0.1}
made = {}
for name, recipe in (("off", Recipe(**small)), ("on", Recipe(**small, event_loss=(0.2, 0.6)))):
    made[name] = remake(
        catalogue, StreamSpec(recipe=recipe), seed=1, epoch=0, index=0, arrays=("voxels", "frames", "depth")
    )
    kernels = len(simulate_general.signatures)
    assert kernels == (name == "on"), "an effect that is off runs the code that ran without it"
off, on = made["off"], made["on"]
params = on.provenance.params
pixel, step = words(params.noise_key, 1016, np.arange(16 * 24)), words(params.noise_key, 1017, np.arange(20))
lost = scramble(scramble(pixel)[None] + step[:, None]) < np.uint32(params.effects["event_loss"] * 2**32)
lost = lost.reshape(20, 1, 16, 24)
assert np.array_equal(on.arrays["voxels"], np.where(lost, 0, off.arrays["voxels"])), "the oracle"
assert off.arrays["voxels"].any() and (off.arrays["voxels"] != on.arrays["voxels"]).any()
assert np.array_equal(on.arrays["depth"], 255.0 - on.arrays["frames"].astype(np.float32))
assert "event_loss" not in NOISE
plain = StreamSpec(recipe=Recipe(**small))
general = remake(catalogue, plain, seed=1, epoch=0, index=0, arrays=("voxels", "event_counts", "fired"))
assert np.array_equal(general.arrays["voxels"], off.arrays["voxels"])
counts, fired = general.arrays["event_counts"], general.arrays["fired"]
assert np.array_equal(fired, counts.any(axis=1))
assert 0 < fired.mean() < 1
# An array without pixels, and one that simulates on its own, alone and beside one that needs seconds.
counted = np.abs(off.arrays["voxels"].astype(int)).sum((1, 2, 3))
for arrays in (("activity",), ("listed",), ("voxels", "listed"), ("activity", "time_surface", "listed", "voxels")):
    sample = remake(catalogue, plain, seed=1, epoch=0, index=0, arrays=arrays)
    if "activity" in arrays:
        assert sample.arrays["activity"].tolist() == counted.tolist()
    if "listed" in arrays:
        assert sample.arrays["listed"] == counted.sum()
    if "voxels" in arrays:
        assert np.array_equal(sample.arrays["voxels"], off.arrays["voxels"])
# An effect on thresholds, of either sign, has the arithmetic and the bytes of a camera with these thresholds.
frames = np.random.default_rng(1).integers(0, 256, (11, 16, 24)).astype(np.uint8)
for threshold, precision in ((3 * 2.0**-5, "float32"), (2.0**-13, "float64")):
    tilted = simulate(frames, threshold_pos=8 * threshold, threshold_tilt=-7 / 8, bins=10, dtype="float32")
    assert tilted.real.__name__ == precision
    told = simulate(
        frames, threshold_pos=threshold, threshold_neg=15 * threshold, bins=10, dtype="float32", precision=precision
    )
    assert np.array_equal(tilted.voxels, told.voxels)
tilt = Recipe(**small, threshold_tilt=(-0.9, 0.5))
assert tilt.most_events > 9 * Recipe(**small).most_events
signs = {np.sign(draw(tilt, seed=1, epoch=0, index=index, picture_height_px=16, picture_width_px=24,
                      video_id="a.mp4").effects["threshold_tilt"]) for index in range(9)}
assert signs == {-1.0, 1.0}
assert Recipe(threshold_tilt=(-0.5, 0.0)).has_effects
json.dump({"off": off.provenance.to_dict()["params"], "on": on.provenance.to_dict()["params"]}, sys.stdout)
"""


def add(root: Path, lines: tuple[tuple[str, str, str], ...]) -> None:
    """Each line in front of the one that begins so."""
    for name, before, line in lines:
        text = (root / name).read_text()
        assert text.count(before) == 1, f"{name}: {before}"
        (root / name).write_text(text.replace(before, line + before))


@pytest.mark.slow
def test_a_toy_effect_array_and_representation_are_a_file_and_a_line_or_two(tmp_path: Path) -> None:
    for package in ("v2v_protocol", "v2v_server", "v2v_pictures", "v2v_tools"):
        shutil.copytree(ROOT / package, tmp_path / package, ignore=shutil.ignore_patterns("__pycache__"))
    for name, text in (("event_loss", EFFECT), ("threshold_tilt", TILT)):
        (tmp_path / f"v2v_server/simulation/effects/{name}.py").write_text(text)
    add(tmp_path, EFFECT_LINES)
    (tmp_path / "v2v_server/worker/arrays/depth.py").write_text(ARRAY)
    add(tmp_path, ARRAY_LINES)
    for name, text in (("fired", REPRESENTATION), ("activity", ACTIVITY)):
        (tmp_path / f"v2v_server/simulation/representations/{name}.py").write_text(text)
    add(tmp_path, REPRESENTATION_LINES)
    clips = tmp_path / "clips"
    clips.mkdir()
    write_clip(clips / "a.mp4", panned_luma(30, 16, 24), gop=12)
    environment = os.environ | {"PYTHONPATH": str(tmp_path), "NUMBA_CACHE_DIR": str(tmp_path / "numba")}
    run = subprocess.run(
        [sys.executable, "-c", USE, str(clips), str(ROOT)], env=environment, cwd=tmp_path, capture_output=True,
        text=True, timeout=500,
    )  # fmt: skip
    assert run.returncode == 0, run.stderr
    provenance = json.loads(run.stdout)
    assert 0.2 <= provenance["on"]["effects"]["event_loss"] <= 0.6
    assert provenance["on"] == provenance["off"] | {"effects": provenance["on"]["effects"]}


def test_a_toy_array_reaches_the_batch(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its layout is checked on the wire, and it lies in the batch beside the others."""
    form = ArrayForm(lambda recipe, _: ("float32", (recipe.voxels_per_clip, 1, 4, 6)))
    monkeypatch.setitem(sample.ARRAYS, "depth", form)
    with FakeServer(sequences=8) as server:
        dataset = V2VStreamDataset(server.address, batch_size=4, arrays=("voxels", "depth"), seed=5)
        batches = list(dataset)
    assert len(batches) == 2
    for batch in batches:
        assert list(batch.arrays) == ["voxels", "depth"]
        for row, index in enumerate(batch.indices):
            np.testing.assert_array_equal(batch.arrays["depth"][row], expected("depth", 5, 0, index))


def test_every_array_that_can_be_requested_is_made() -> None:
    assert ARRAY_BUILDERS.keys() | set(NAMES) == sample.ARRAYS.keys()
    assert not ARRAY_BUILDERS.keys() & set(NAMES)


def test_every_seam_of_the_page_has_a_toy() -> None:
    """Each section names the test that adds its toy."""
    _, *sections = re.split(r"^##+ ", (ROOT / "docs/extending.md").read_text(encoding="utf-8"), flags=re.MULTILINE)
    assert len(sections) >= 13
    for section in sections:
        named = re.findall(r"`(tests/[\w/]+\.py)` adds", section) or re.findall(
            r"a toy in `(tests/[\w/]+\.py)`", section
        )
        assert named, section[:60]
        assert all((ROOT / each).is_file() for each in named), named
