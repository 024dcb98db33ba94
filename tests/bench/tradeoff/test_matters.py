"""What matters to a network: when a difference counts, and one tiny run for real."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from bench.tradeoff import matters
from tests.clips import panned_luma, write_clip
from tests.trainer.conftest import WEIGHTS
from trainer.config import TrainConfig
from trainer.config_file import load_config


@pytest.mark.parametrize(
    ("ours", "said"),
    [
        ([0.1, 0.2, 0.29], "better"),
        ([0.1, 0.2, 0.3], "not separated"),
        ([0.35, 0.5, 0.1], "not separated"),
        ([0.41, 0.5, 0.6], "worse"),
    ],
)
def test_a_difference_counts_where_no_seed_contradicts_it(ours: list[float], said: str) -> None:
    assert matters.verdict(ours, [0.4, 0.3, 0.35]) == said


def test_rows_have_medians_and_ranges_and_the_first_has_no_verdict() -> None:
    scores = [{"lpips": lpips, "correlation": 1 - lpips} for lpips in (0.5, 0.3, 0.1)]
    worse = [{"lpips": 0.6, "correlation": 0.0}] * 3
    first, second = matters.summary({(matters.AS_IT_IS, "paper"): scores, ("no noise", "paper"): worse})
    assert (first["lpips"], first["lowest_lpips"], first["highest_lpips"]) == (0.3, 0.1, 0.5)
    assert (first["correlation"], first["seeds"]) == (0.7, 3)
    assert "lpips_verdict" not in first
    assert second["lpips_verdict"] == second["correlation_verdict"] == "worse"


def changed(name: str) -> TrainConfig:
    settings = {**matters.STREAM, **matters.CHANGES[name].settings}
    return load_config(matters.CONFIGURATION, [f"{key}={json.dumps(value)}" for key, value in settings.items()])


def test_each_row_changes_what_it_says() -> None:
    plain = changed(matters.AS_IT_IS).stream
    assert plain.resolved_recipe.threshold[0] < plain.resolved_recipe.threshold[1]
    assert plain.resolved_recipe.noise_sigma[1] > 0
    one = changed("one threshold").stream.resolved_recipe
    assert one.threshold[0] == one.threshold[1]
    assert changed("no noise").stream.resolved_recipe.noise_sigma == (0.0, 0.0)
    assert changed("4 samples a decode").stream.spec["samples_per_decode"] == 4
    effects = changed("effects").stream.resolved_recipe
    assert effects.leak_hz[0] > 0
    assert effects.noise_sigma == plain.resolved_recipe.noise_sigma


@pytest.mark.slow
@pytest.mark.skipif(not WEIGHTS.is_dir(), reason=f"no folder {WEIGHTS} with the published weight files")
def test_one_step_of_two_rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(matters, "CHANGES", {name: matters.CHANGES[name] for name in ("as it is", "lossy corpus")})
    folder, file = tmp_path / "clips", tmp_path / "out.json"
    folder.mkdir()
    for number in range(4):
        write_clip(folder / f"{number}.mp4", panned_luma(111, 128, 144, step=(1, 1 + number)), gop=25)
    status = matters.main([
        "--videos", str(folder), "--held-out", str(folder), "--seeds", "0", "--steps", "1", "--samples", "1",
        "--lpips", "squeeze", str(WEIGHTS / "squeezenet1_1_features_torchvision.pth"),
        str(WEIGHTS / "lpips_v0.1" / "squeeze.pth"), "--json", str(file),
    ])  # fmt: skip
    assert status == 0
    records = json.loads(file.read_text())
    assert {record["change"] for record in records} == set(matters.CHANGES)
    assert [record.get("lpips_verdict") is None for record in records] == [True, True, False, False]
    assert all(0 < record["lpips"] < 2 for record in records)
