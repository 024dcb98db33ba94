"""The configurations of recordings train on prepared ones, with pictures and true flow."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.digests.clips import write_recordings
from tests.trainer.training import losses
from trainer.config_file import load_config
from trainer.train import main

SMALL = {
    "stream.recipe.voxels_per_clip": 3, "stream.recipe.crop_height_px": 32, "stream.recipe.crop_width_px": 40,
    "stream.batch_size": 2, "stream.workers": 1, "stream.loader_workers": 0, "stream.timeout_seconds": 600,
    "network.options.base_channels": 2, "compute.device": "cpu", "compute.threads": 1, "run.epochs": 100,
    "run.steps": 2, "run.log_every": 1, "run.save_every": 100, "run.preview_every": 0,
}  # fmt: skip
PICTURES = {"loss.lpips_weight": 0, "loss.temporal_first_step": 1}
CONFIGURATIONS = {
    "e2vid-esim": PICTURES,
    "e2vid-esim-interpolated": PICTURES,
    "e2vid-esim-alex-tc": PICTURES,
    "e2vid-esim-raft": PICTURES | {"loss.temporal_weight": 0},
    "evflownet-esim": {},
}
"""What needs no weights of others."""


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_recordings(tmp_path_factory.mktemp("recordings") / "prepared")


@pytest.mark.slow
@pytest.mark.parametrize("name", CONFIGURATIONS)
def test_a_configuration_trains_on_recordings(compiled: None, name: str, recordings: Path, tmp_path: Path) -> None:
    changes = SMALL | CONFIGURATIONS[name] | {"stream.videos": recordings}
    sets = [text for key, value in changes.items() for text in ("--set", f"{key}={value}")]
    assert main([name, *sets, "--out", str(tmp_path / "run")]) == 0
    made = losses(tmp_path / "run")
    assert [each["step"] for each in made] == [1, 2]
    assert all(each["total"] > 0 for each in made)
    if name in ("e2vid-esim", "e2vid-esim-alex-tc"):
        assert all(each["temporal"] > 0 for each in made)


def test_networks_of_interpolated_grids_differ_in_their_input_only() -> None:
    one, other = load_config("e2vid-esim").to_dict(), load_config("e2vid-esim-interpolated").to_dict()
    assert (one["loss"].pop("voxels"), other["loss"].pop("voxels")) == ("voxels", "voxels_bilinear")
    assert one == other
