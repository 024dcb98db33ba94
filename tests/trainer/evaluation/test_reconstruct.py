"""Test running a network over a recording: padding, windows without pictures, files of no network."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from tests.trainer.evaluation.h5_file import random_recording
from trainer.evaluation.readers import Recording
from trainer.evaluation.reconstruct import WINDOWS_PER_CALL, _stretch, reconstruct
from trainer.evaluation.voxelise import VoxelSettings, voxel_grid
from trainer.evaluation.windows import picture_windows, regular_windows
from trainer.models import E2VID, FireNet, VoxelNetwork
from trainer.weights import load_network
from v2v_protocol.errors import UsageError


def small_e2vid(**options: object) -> E2VID:
    torch.manual_seed(0)
    return E2VID(base_channels=4, encoders=2, residual_blocks=1, **options).eval()  # type: ignore[arg-type]


@pytest.mark.parametrize("network", [small_e2vid(), FireNet(base_channels=4)], ids=["e2vid", "firenet"])
def test_pieces_equal_one_pass_over_the_sequence(tmp_path: Path, network: VoxelNetwork) -> None:
    """There are more windows than one call takes, and the network must pad the size (37 x 43)."""
    count = 2 * WINDOWS_PER_CALL + 3
    path = random_recording(tmp_path / "a.h5", size=(37, 43), images=count + 1, events=4000)
    with Recording(path) as recording:
        windows = picture_windows(recording)
        steps = list(reconstruct(recording, windows, network, VoxelSettings()))
        grids = [voxel_grid(recording.events(w), recording.size, VoxelSettings(), (w.begin, w.end)) for w in windows]
        assert [step.events for step in steps] == [len(recording.events(window)) for window in windows]
        for step in steps:
            assert step.window.target is not None
            np.testing.assert_array_equal(step.camera, recording.image(step.window.target))
    with torch.no_grad():
        whole = network.forward_sequence(torch.from_numpy(np.stack(grids))[None])[0, :, 0].clamp(0, 1).numpy()
    assert whole.shape == (count, 37, 43)
    np.testing.assert_allclose(np.stack([step.prediction for step in steps]), whole, rtol=0, atol=1e-6)


def test_windows_without_a_picture_show_the_latest(tmp_path: Path) -> None:
    path = random_recording(tmp_path / "a.h5", images=4, period=0.1, events=500)
    with Recording(path) as recording:
        steps = list(reconstruct(recording, regular_windows(recording, 20), FireNet(base_channels=2), VoxelSettings()))
        for step in steps:
            assert step.window.target is None
            assert step.camera_time is not None
            assert step.camera_time <= step.window.end < step.camera_time + 0.1 + 1e-9


def test_wrong_bins_and_non_finite_outputs_are_refused(tmp_path: Path) -> None:
    path = random_recording(tmp_path / "a.h5")
    network = FireNet(base_channels=2)
    with Recording(path) as recording:
        with pytest.raises(UsageError, match="voxels have 4 bins, but the network takes 5"):
            next(reconstruct(recording, picture_windows(recording), network, VoxelSettings(bins=4)))
        with torch.no_grad():
            network.net.pred.conv2d.bias.fill_(float("nan"))  # type: ignore[union-attr]
        with pytest.raises(UsageError, match="not finite in windows 0 to 4"):
            next(reconstruct(recording, picture_windows(recording), network, VoxelSettings()))


def test_stretching_maps_each_picture_to_the_whole_range() -> None:
    rng = np.random.default_rng(0)
    pictures = rng.normal(0.3, 0.05, (2, 20, 30)).astype(np.float32)
    pictures[1] += 3
    plain, whole, robust = (_stretch(pictures, stretch) for stretch in ("none", "min-max", "robust"))
    np.testing.assert_array_equal(plain, pictures.clip(0, 1))
    assert whole.min(axis=(1, 2)).tolist() == [0, 0]
    assert whole.max(axis=(1, 2)).tolist() == [1, 1]
    for before, after in zip(pictures, robust, strict=True):
        low, high = np.sort(before.ravel())[[6, -7]]  # 600 pixels: about one in a hundred beyond either end
        assert np.isclose(
            after.ravel()[before.ravel().argsort()[300]], (np.median(before) - low) / (high - low), atol=0.02
        )
        assert ((after == 0).sum(), (after == 1).sum()) == (6, 6)
    assert np.isfinite(_stretch(np.ones((1, 4, 4), np.float32), "min-max")).all()


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        (None, {}, r"the network is none of e2vid, "),
        ("unet", {}, "model 'unet': give one of"),
        ("firenet", {}, "do not fit FireNet"),
        ("firenet", {"colour": 1}, r"options of firenet: .*colour"),
    ],
)
def test_unknown_networks_are_refused(
    tmp_path: Path, name: str | None, options: dict[str, object], message: str
) -> None:
    torch.save({"a": torch.zeros(1)}, tmp_path / "a.pth")
    with pytest.raises(UsageError, match=message):
        load_network(tmp_path / "a.pth", name=name, options=options)


def test_equalized_pictures_have_every_grey_value_as_often() -> None:
    """This holds after any monotonic mapping of the network's pictures."""
    ramp = np.linspace(0, 1, 64 * 64, dtype=np.float32).reshape(1, 64, 64)
    (equal,) = _stretch(ramp**1.3, "equalized")
    counts, _ = np.histogram(equal, 8, (0, 1))
    assert counts.min() > 0.8 * 512
    assert counts.max() < 1.2 * 512
    order = np.argsort(ramp[0].ravel(), kind="stable")
    assert (np.diff(equal.ravel()[order]) >= 0).all()
