"""Blurred frames beside sharp ones and events: against integrals of light in float64, written apart."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing

import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image

from tests.clips import panned_luma, write_clip
from tests.oracles.known_motion import photograph
from tests.oracles.worlds import Oracle
from v2v_protocol.errors import UsageError
from v2v_protocol.recipe import Recipe, preset
from v2v_protocol.sample import array_layout
from v2v_protocol.spec import StreamSpec
from v2v_server.corpus.catalogue import Catalogue, open_catalogue
from v2v_server.corpus_words import why_unsuited
from v2v_server.kinds.photographs import PhotographKind
from v2v_server.schedule import SequenceTable
from v2v_server.simulation.intensity import tone_table, tones_of
from v2v_server.video.picture import Signal
from v2v_server.video.rows import Rows
from v2v_server.worlds.world import draw_world
from v2v_tools.remake import Remaker

EXPOSED = {
    "exposure_seconds": 0.03, "voxels_per_clip": 3, "bins": 4, "lead_frames": 1, "crop_height_px": 40,
    "crop_width_px": 48, "pause_probability": 0.0,
}  # fmt: skip
FAST = {"world_speed_px": (300.0, 600.0), "world_still_share": 0.0, "world_patches": 2, "world_patch_px": (16.0, 30.0)}
ARRAYS = ("voxels", "frames", "frames_blurred", "flow", "masks")
VIDEO_HZ = 200.0


@pytest.fixture(scope="module")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Catalogue]:
    folder = tmp_path_factory.mktemp("exposed")
    Image.fromarray(photograph("astronaut")).save(folder / "a.png")
    with closing(open_catalogue(folder, kind=PhotographKind(60.0, 0.5), processes=0)) as opened:
        yield opened


@pytest.fixture(scope="module")
def videos(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Catalogue]:
    folder = tmp_path_factory.mktemp("exposed videos")
    write_clip(folder / "a.mp4", panned_luma(40, 64, 80), rate=int(VIDEO_HZ))
    with closing(open_catalogue(folder, processes=0, rows=Rows())) as opened:
        yield opened


def within_a_level(made: npt.NDArray[np.uint8], light: npt.NDArray[np.float64], gamma: float) -> bool:
    return bool((np.abs(made.astype(np.float64) - 255.0 * np.minimum(light, 1.0) ** (1.0 / gamma)) <= 1.0).all())


@pytest.mark.parametrize("name", ["worlds", "worlds-fine"])
@pytest.mark.parametrize("more", [{}, {"pause_probability": 0.3, "pause_stay_probability": 0.5}, {"log_eps": 0.1}])
def test_frames_of_photographs_are_exposed_exactly(photographs: Catalogue, name: str, more: dict[str, float]) -> None:
    """Patches, turns, tilt and mirrored crops; where the camera pauses, its light stands still."""
    recipe, blurred = preset(name).replace(**{**EXPOSED, **FAST, **more}), 0
    for seed in range(2):
        made = Remaker(photographs, StreamSpec(recipe), ARRAYS).made(seed, 0, 0)
        params, clip, arrays = made.sample.provenance.params, made.job.clip, made.sample.arrays
        source = params.source_index(recipe.steps)
        seconds = np.arange(source[-1] + 1) / 60.0
        world = draw_world(
            recipe, params, seed=seed, epoch=0, index=0, picture_px=(clip.height_px, clip.width_px),
            seconds=(0.0, float(seconds[-1])),
        )  # fmt: skip
        oracle = Oracle(world, photograph("astronaut"), is_rounded=name == "worlds")
        for number, step in enumerate(recipe.target_steps):
            light = np.zeros(recipe.crop_px)
            for share in (np.arange(120) + 0.5) / 120 - 0.5:
                at = step / 60 + 0.03 * share
                before = min(max(int(np.floor(at * 60)), 0), recipe.steps - 1)
                shown = seconds[source[[before, before + 1]]]
                pace = (shown[1] - shown[0]) * 60 if 0 <= at <= recipe.steps / 60 else 1.0
                start = before / 60 if at <= recipe.steps / 60 else (before + 1) / 60
                begin = shown[0] if at <= recipe.steps / 60 else shown[1]
                light += (oracle.picture(float(begin + pace * (at - start))) / 4095.0) ** recipe.gamma / 120
            assert within_a_level(arrays["frames_blurred"][number, 0], light, recipe.gamma)
        change = np.abs(arrays["frames_blurred"].astype(int) - arrays["frames"])
        blurred += int(change.max() > 20)
    assert blurred == 2


def test_frames_of_videos_are_means_of_their_light(videos: Catalogue) -> None:
    """Linear between frames; at the last frame the clip has no light on the far side, so the frame is sharp."""
    recipe = Recipe(**EXPOSED, gamma=1.8)
    sample = Remaker(videos, StreamSpec(recipe), ("frames", "frames_blurred", "frames_all")).sample(2, 0, 0)
    light = (sample.arrays["frames_all"][:, 0] / 255.0) ** 1.8
    times = np.arange(len(light)) / VIDEO_HZ
    for number, step in enumerate(recipe.target_steps):
        half = min(0.015, times[step], times[-1] - times[step])
        expected = np.zeros(recipe.crop_px)
        for share in (np.arange(2000) + 0.5) / 1000 - 1.0:
            place = (times[step] + half * share) * VIDEO_HZ
            first = min(int(place), len(light) - 2)
            expected += (light[first] + (place - first) * (light[first + 1] - light[first])) / 2000
        assert within_a_level(sample.arrays["frames_blurred"][number, 0], expected, 1.8)
    np.testing.assert_array_equal(sample.arrays["frames_blurred"][-1], sample.arrays["frames"][-1])
    assert (sample.arrays["frames_blurred"][1] != sample.arrays["frames"][1]).any()


@pytest.mark.parametrize("kind", ["photographs", "videos"])
def test_to_ask_for_them_changes_nothing_else(request: pytest.FixtureRequest, kind: str) -> None:
    """Nor does the exposure itself: all else is as without one."""
    catalogue: Catalogue = request.getfixturevalue(kind)
    recipe = preset("worlds-fine").replace(**EXPOSED, **FAST) if kind == "photographs" else Recipe(**EXPOSED)
    with_them = Remaker(catalogue, StreamSpec(recipe), ARRAYS[: 5 if kind == "photographs" else 3]).sample(3, 0, 0)
    others = [name for name in with_them.arrays if name != "frames_blurred"]
    for other in (recipe, recipe.replace(exposure_seconds=0.0)):
        sample = Remaker(catalogue, StreamSpec(other), tuple(others)).sample(3, 0, 0)
        for name in others:
            assert sample.arrays[name].tobytes() == with_them.arrays[name].tobytes()
        assert sample.provenance.params.noise_key == with_them.provenance.params.noise_key
    assert with_them.arrays["voxels"].any()


def test_videos_of_too_low_a_rate_are_refused_in_words(videos: Catalogue, photographs: Catalogue) -> None:
    """Four frames an exposure at least, of those that the stride leaves; photographs have any rate."""
    for exposure, stride, admitted in ((0.02, 1, True), (0.0199, 1, False), (0.02, 2, False), (0.04, 2, True)):
        spec = StreamSpec(Recipe(**{**EXPOSED, "exposure_seconds": (exposure, 0.1)}, frame_stride=stride))
        assert (SequenceTable(videos.videos, videos.rows, spec).count > 0) == admitted
        if not admitted:
            refusal = why_unsuited(videos.videos[0], videos.rows, spec)
            least = 4 * stride / exposure
            assert f"200 frames/s, an exposure of {exposure:g} s at frame_stride {stride} needs {least:.6g}" in str(
                refusal
            )
    short = preset("worlds").replace(**{**EXPOSED, "exposure_seconds": 1e-5})
    assert SequenceTable(photographs.videos, photographs.rows, StreamSpec(short)).count


def test_without_an_exposure_there_is_no_such_array() -> None:
    with pytest.raises(UsageError, match=r"frames_blurred needs an exposure, .* set exposure_seconds"):
        array_layout(Recipe(), "int8", ("frames_blurred",))


@pytest.mark.parametrize("bits", [8, 12, 16])
def test_light_of_a_level_becomes_that_level(bits: int) -> None:
    levels = np.arange(2**bits) / (2**bits - 1)
    np.testing.assert_array_equal(tones_of(levels**2.2, 2.2), tone_table(2.2, Signal(bits)))
