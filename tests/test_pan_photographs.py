"""Test clips from photographs: smooth, of a fixed size, with equal frames for equal seeds."""

import sys

import av
import cv2
import numpy as np
import pytest
from skimage import data

from examples import pan_photographs


def test_motion_begins_at_rest_position_and_never_jumps():
    steps = pan_photographs.motion(np.random.default_rng(1), 2.0, 130)
    np.testing.assert_allclose(steps[0], np.eye(3), atol=1e-12)
    middle = steps @ [pan_photographs.WIDTH / 2, pan_photographs.HEIGHT / 2, 1]
    path = middle[:, :2] / middle[:, 2:]
    jumps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    assert jumps.mean() > 0.1
    assert jumps.max() < 15
    still = pan_photographs.motion(np.random.default_rng(0), 0.0, 30)
    np.testing.assert_allclose(still, np.broadcast_to(np.eye(3), still.shape), atol=1e-12)


def clip(photographs, objects, seed, count, plain=0.0, walls=0.0):
    return pan_photographs.clip(photographs, objects, np.random.default_rng(seed), count, plain, walls)


def test_the_same_seed_gives_the_same_frames():
    """The files may differ: x264 does not always give the same bytes for the same frames."""
    one, two, other = (clip([data.chelsea()], [], seed, 5) for seed in ((3, 0), (3, 0), (3, 1)))
    np.testing.assert_array_equal(one, two)
    assert (one != other).any()


def test_a_folder_of_photographs_becomes_clips(tmp_path, monkeypatch):
    cv2.imwrite(str(tmp_path / "cat.png"), data.chelsea()[..., ::-1])
    flags = ["--clips", "1", "--seed", "3", "--frames", "12", "--rate", "240"]
    monkeypatch.setattr(sys, "argv", ["pan", str(tmp_path), str(tmp_path / "a"), *flags])
    pan_photographs.main()
    with av.open(str(tmp_path / "a" / "pan_0000.mp4")) as file:
        assert file.streams.video[0].average_rate == 240
        frames = [frame.to_ndarray(format="gray") for frame in file.decode(video=0)]
    assert len(frames) == 12
    assert frames[0].shape == (pan_photographs.HEIGHT, pan_photographs.WIDTH)
    assert np.abs(frames[0].astype(int) - frames[11]).mean() > 1


def test_an_object_cut_out_moves_over_a_photograph():
    black = np.zeros((600, 800, 3), np.uint8)
    white = np.dstack([np.full((100, 100), 255, np.uint8)] * 4)
    clips = [clip([black], [white], seed, 3) for seed in range(12)]
    shares = [np.mean(frames > frames.min()) for frames in clips]
    assert min(shares) == 0  # black alone, or under ellipses of black
    assert 0.001 < max(shares) < 0.6


def test_a_plain_clip_has_plain_patches_before_a_smooth_gradient():
    stripes = np.repeat(np.resize(np.uint8([[20], [220]]), (600, 1)), 800, axis=1)
    pictures = [np.dstack([picture] * 3) for picture in (stripes, np.zeros_like(stripes))]
    steps = [np.abs(np.diff(clip(pictures, [], 6, 1, plain).astype(int), axis=1)) for plain in (0, 1)]
    shares = [np.mean(step > 8) for step in steps]
    assert shares[0] > 0.2
    assert 0 < shares[1] < shares[0]


@pytest.mark.parametrize("seed", range(5))
def test_a_wall_is_bright_with_the_texture_of_its_photograph(seed):
    rng = np.random.default_rng(seed)
    stripes = np.resize(np.uint8([[[20]], [[120]]]), (600, 800, 3))
    wall = pan_photographs.wall(stripes, rng)
    assert 160 < wall.mean() <= 250
    assert wall.std() <= 0.8 * stripes.std()
    assert np.corrcoef(wall.ravel(), stripes.ravel())[0, 1] > 0.9
    dark = clip([stripes // 8], [], seed, 1, walls=1.0)
    assert np.quantile(dark, 0.95) > 150 > dark.min()


def test_a_partly_transparent_picture_is_not_a_background(tmp_path, monkeypatch):
    cut_out = np.zeros((50, 50, 4), np.uint8)
    cut_out[10:40, 10:40] = 255
    cv2.imwrite(str(tmp_path / "thing.png"), cut_out)
    monkeypatch.setattr(sys, "argv", ["pan", str(tmp_path), str(tmp_path / "out")])
    with pytest.raises(SystemExit, match="no photograph"):
        pan_photographs.main()
