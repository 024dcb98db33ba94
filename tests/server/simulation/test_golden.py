"""Golden digests: voxels and frames of fixed identities, from a lossless clip of known luma to the finished sample.

A change that alters any of them alters what every saved stream means: it raises NUMERICS_VERSION, and says so in the
changelog. CI runs this file under two numpy versions.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

from v2v_protocol.recipe import PRESETS
from v2v_protocol.spec import StreamSpec
from v2v_server.corpus.catalogue import Catalogue, open_catalogue
from v2v_server.offline.remake import remake

SMALL: dict[str, Any] = {"voxels_per_clip": 4, "crop_height_px": 40, "crop_width_px": 56}
GOLDEN = {
    "paper": "aa93f6fec240497f44e080787d654739",
    "paper-fixed-thresholds": "5f7f761fbed5c5dd45fcaf19f2f03b6d",
    "paper-contrast": "71af75da928c71443ee55bebcb497068",
    "paper-flow": "9c819032f427d1f827afaac5a7b3eac6",
    "paper-eraft": "d06af98cbee13f01861f1c4d1e694473",
    "noise-free": "cf498957dd961f2dd82486f6922e2d69",
    "per second, float32": "37f0f6a7b12a00262c219778b72e62fe",
}


def _spec(name: str) -> StreamSpec:
    if name in PRESETS:
        return StreamSpec(recipe=PRESETS[name].replace(**SMALL))
    recipe = PRESETS["paper"].replace(noise_unit="second", frames_per_bin=2, **SMALL)
    return StreamSpec(recipe=recipe, voxel_dtype="float32")


@pytest.fixture(scope="module")
def catalogue(tmp_path_factory: pytest.TempPathFactory) -> Catalogue:
    folder = tmp_path_factory.mktemp("golden")
    for number in range(2):
        _write_lossless(folder / f"clip{number}.mkv", _luma(90, 64, 96, number))
    return open_catalogue(folder, cache_dir=folder, processes=0)


def _luma(frames: int, height: int, width: int, number: int) -> np.ndarray:
    """Gliding triangle waves in whole numbers, full range: the same on every machine."""
    t, y, x = np.ogrid[:frames, :height, :width]
    phase = 3 * x + (5 + number) * y + (7 + 4 * number) * t
    wave = np.abs(phase % 510 - 255)
    return ((wave + (x * y) % 61) % 256).astype(np.uint8)


def _write_lossless(path: Path, luma: np.ndarray) -> None:
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=25)
        stream.height, stream.width, stream.pix_fmt = luma.shape[1], luma.shape[2], "gray"
        for picture in luma:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, "gray")))
        container.mux(stream.encode(None))


def test_the_clip_decodes_to_the_very_luma(catalogue: Catalogue) -> None:
    """Without this, a golden digest could not tell an encoder's change from ours."""
    spec = StreamSpec(
        recipe=PRESETS["noise-free"].replace(
            voxels_per_clip=17, crop_height_px=64, crop_width_px=96, flip_probability=0.0
        ),
        shuffle=False,
    )
    sample = remake(catalogue, spec, seed=0, epoch=0, index=0)
    np.testing.assert_array_equal(sample.arrays["frames"][:, 0], _luma(90, 64, 96, 0)[5:86:5])


@pytest.mark.parametrize("name", GOLDEN)
def test_golden_samples(catalogue: Catalogue, name: str) -> None:
    digest = hashlib.sha256()
    for seed, epoch, index in ((0, 0, 0), (7, 1, 3), (2**64 - 1, 2**32 - 1, 1)):
        sample = remake(catalogue, _spec(name), seed=seed, epoch=epoch, index=index)
        for array in sample.arrays.values():
            digest.update(repr((array.dtype.name, array.shape)).encode() + array.tobytes())
        digest.update(repr(sample.provenance.params.to_dict()).encode())
    assert digest.hexdigest()[:32] == GOLDEN[name]
