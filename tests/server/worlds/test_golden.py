"""Golden digests of pictures and truth: the same bytes with every version of numba and numpy, on every processor."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import pytest

from tests.server.simulation.generic_processor import COMPILE_SECONDS, printed_on_a_generic_processor
from v2v_protocol.recipe import PRESETS
from v2v_server.simulation.draw import draw
from v2v_server.worlds.render import flow_of, levels_between, masks_of, pyramid_of, render, tracks_of
from v2v_server.worlds.world import draw_world

GOLDEN = {
    "pictures": "dfe0d0f09c13f7f0",
    "levels": "bbac211f57deeb64",
    "flow": "866803faaea8e770",
    "masks": "cae9e0dedced0ec4",
    "tracks": "59dafcb16167657d",
}
SCALED = {"resize_scale": (0.6, 0.9), "world_tilt": 0.2, "flip_probability": 1.0}
SEED = 2**64 - 1
CODE = "from tests.server.worlds.test_golden import digests; print(*digests().values())"


def digests() -> dict[str, str]:
    """Return digests of the arrays of sixteen worlds."""
    y, x = np.mgrid[:97, :131]
    grey = ((x * x * 3 + y * y * 5 + x * y * 7) // 64 + 60 * ((x // 9 + y // 7) % 3) & 255).astype(np.uint8)
    pyramid, seconds = pyramid_of(grey), np.arange(31) / 30
    found = {name: hashlib.sha256() for name in ("pictures", "levels", "flow", "masks", "tracks")}
    for index in range(16):
        recipe = PRESETS["worlds"].replace(crop_height_px=40, crop_width_px=52, **(SCALED if index % 2 else {}))
        params = draw(recipe, seed=SEED, epoch=3, index=index, picture_height_px=97, picture_width_px=131, video_id="")
        world = draw_world(
            recipe, params, seed=SEED, epoch=3, index=index, picture_px=(97, 131), seconds=(0.0, 1.0)
        )  # fmt: skip
        levels = levels_between(pyramid, world, seconds, np.arange(31), 1.0, 16)
        arrays = {
            "pictures": render(pyramid, world, seconds),
            "levels": np.empty(0) if levels is None else levels.grey,
            "flow": np.concatenate(flow_of(world, 0.2, 0.3)),
            "masks": masks_of(world, 0.7),
            "tracks": tracks_of(world, seconds),
        }
        for name, array in arrays.items():
            found[name].update(array.tobytes())
    return {name: digest.hexdigest()[:16] for name, digest in found.items()}


def test_pictures_and_truth_keep_their_bytes() -> None:
    assert digests() == GOLDEN


@pytest.mark.slow
@pytest.mark.timeout(COMPILE_SECONDS + 60)
def test_a_generic_processor_gives_the_same_bytes(tmp_path: Path) -> None:
    assert printed_on_a_generic_processor(CODE, tmp_path) == list(GOLDEN.values())
