"""Configuration of a training run: defaults, files, settings, and messages that name the key."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from trainer.config import TrainConfig, differences
from trainer.config_file import load_config, shipped
from v2v_protocol.errors import UsageError
from v2v_protocol.recipe import preset


def written(folder: Path, name: str, text: str) -> str:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return str(path)


def test_the_defaults_are_valid_and_survive_plain_values():
    config = TrainConfig()
    assert TrainConfig.from_dict(config.to_dict()) == config
    assert TrainConfig.from_dict(yaml.safe_load(yaml.safe_dump(config.to_dict()))) == config


@pytest.mark.parametrize("name", shipped())
def test_every_shipped_configuration_is_valid(name):
    config = load_config(name)
    assert config.to_dict() == TrainConfig.from_dict(config.to_dict()).to_dict()


def test_the_papers_e2vid():
    """Batch, clip, crop, optimiser and weights of the losses as published."""
    config = load_config("e2vid")
    recipe = config.stream.resolved_recipe
    assert (config.network.name, config.stream.batch_size, config.run.epochs) == ("e2vid", 12, 80)
    assert (recipe.voxels_per_clip, recipe.bins, recipe.crop_height_px, recipe.crop_width_px) == (40, 5, 128, 128)
    loss, optimizer = config.loss, config.optimizer
    assert (loss.lpips_weight, loss.l1_weight, loss.temporal_weight) == (1, 1, 1)
    assert (loss.lpips_network, loss.temporal_first_step, loss.temporal_rule) == ("vgg", 20, "half")
    assert (optimizer.name, optimizer.learning_rate, optimizer.amsgrad) == ("adam", 1e-4, True)
    assert (optimizer.weight_decay, optimizer.learning_rate_decay, optimizer.clip_gradient_norm) == (0, 1, 0)
    assert optimizer.ema_decay == 0


@pytest.mark.parametrize(
    ("name", "changed"),
    [
        ("e2vid-fixed-thresholds", {"stream.recipe"}),
        ("e2vid-contrast", {"stream.recipe"}),
        ("e2vid-webvid100", {"stream.videos", "run.epochs", "run.keep_epochs"}),
        ("e2vid-webvid1k", {"stream.videos", "run.epochs", "run.keep_epochs"}),
        ("e2vid-filtered", {"stream.list"}),
    ],
)
def test_an_ablation_differs_in_one_thing(name, changed):
    assert differences(load_config("e2vid").to_dict(), load_config(name).to_dict()).keys() == changed


def test_the_other_recipes_are_those_of_the_code_and_the_paper():
    assert [load_config(f"e2vid-webvid{size}").run.epochs for size in ("100", "1k")] == [8000, 800]
    assert [load_config(f"e2vid-webvid{size}").run.keep_epochs for size in ("100", "1k")] == [0, 0]
    alex = load_config("e2vid-alex-tc").loss
    assert (alex.l1_weight, alex.lpips_network, alex.temporal_first_step, alex.temporal_rule) == (0, "alex", 1, "half")
    published = {
        "hypere2vid": ("adam", 1e-3, 0, 1, 12, 80),
        "etnet": ("adamw", 2e-4, 0.01, 0.94, 6, 100),
        "evflownet": ("adam", 1e-4, 0, 1, 10, 50),
        "eraft": ("adam", 1e-4, 0, 1, 10, 50),
    }
    for name, expected in published.items():
        config = load_config(name)
        rates = (config.optimizer.learning_rate, config.optimizer.weight_decay, config.optimizer.learning_rate_decay)
        assert (config.optimizer.name, *rates, config.stream.batch_size, config.run.epochs) == expected, name
        assert (config.network.name, config.optimizer.amsgrad) == (name, True)
        assert (config.compute.precision, config.compute.cudnn_benchmark) == ("tf32", True)
    assert load_config("hypere2vid").loss.guide_epochs == 16
    assert [load_config(name).loss.gamma for name in ("eraft", "eraft-as-published", "evflownet")] == [0.8, 0, 0]
    assert {load_config(name).loss.raft_size for name in ("eraft", "evflownet")} == {"large"}


def test_settings_win_over_the_file_and_the_file_over_what_it_extends(tmp_path):
    written(tmp_path, "base.yaml", "run: {steps: 1, epochs: 2}\nstream: {recipe: {preset: paper, bins: 3}}\n")
    mine = written(tmp_path, "mine.yaml", "extends: base.yaml\nrun: {steps: 10, log_every: 7}\n")
    config = load_config(mine, ["run.steps=100", "stream.recipe.voxels_per_clip=8", "optimizer.learning_rate=1e-3"])
    assert (config.run.steps, config.run.epochs, config.run.log_every) == (100, 2, 7)
    recipe = config.stream.resolved_recipe
    assert (recipe.bins, recipe.voxels_per_clip) == (3, 8)
    assert config.optimizer.learning_rate == 1e-3


def test_a_file_may_extend_a_shipped_one(tmp_path):
    config = load_config(written(tmp_path, "mine.yaml", "extends: tiny-cpu\nrun: {steps: 3}\n"))
    assert (config.network.name, config.run.steps) == ("firenet", 3)


@pytest.mark.parametrize("name", ["evflownet", "eraft"])
def test_worlds_give_exact_flow_where_it_is_seen(name):
    plain, worlds = load_config(name), load_config(f"{name}-worlds")
    assert (worlds.network, worlds.loss.gamma) == (plain.network, plain.loss.gamma)
    assert (worlds.loss.flow, worlds.loss.valid) == ("stream", "consistent")
    assert worlds.stream.resolved_recipe == preset("worlds")
    assert (worlds.stream.videos_kind, worlds.stream.rows) == ("photographs", "full")


def test_streams_are_mixed_in_with_what_they_say(tmp_path):
    mine = (
        "extends: e2vid-filtered\nstream: {mix: [{weight: .2, videos: b, rows: full}, {weight: .3, recipe: sensor}]}\n"
    )
    mixed = load_config(written(tmp_path, "mine.yaml", mine)).stream.mixed
    assert {name: weight for name, (_, weight) in mixed.items()} == {
        "stream": 0.5,
        "stream.mix.0": 0.2,
        "stream.mix.1": 0.3,
    }
    first, *others = (stream for stream, _ in mixed.values())
    assert [(each.videos, each.rows, each.list) for each in others] == [
        ("b", "full", ""),
        (first.videos, first.rows, first.list),
    ]
    assert others[1].resolved_recipe == preset("sensor")
    assert {each.batch_size for each in others} == {first.batch_size}


def test_numbers_without_a_point_are_numbers(tmp_path):
    """YAML 1.1 takes 1e-4 for text."""
    config = load_config(written(tmp_path, "c.yaml", "optimizer: {learning_rate: 1e-4, weight_decay: 0}\n"))
    assert (config.optimizer.learning_rate, config.optimizer.weight_decay) == (1e-4, 0.0)


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("optimizer.learning_rat=1", r"optimizer\.learning_rat .*did you mean 'learning_rate'"),
        ("optimiser.learning_rate=1", r"'optimiser' \(did you mean 'optimizer'"),
        ("optimizer.learning_rate=fast", r"optimizer\.learning_rate = 'fast': give a number"),
        ("optimizer.learning_rate=true", r"optimizer\.learning_rate = True: give a number"),
        ("optimizer.learning_rate=.nan", r"optimizer\.learning_rate = nan: give a number from 1e-12"),
        ("optimizer.ema_decay=1", r"optimizer\.ema_decay = 1: give a number from 0 to 0\.999999"),
        ("optimizer.amsgrad=1", r"optimizer\.amsgrad = 1: give true or false"),
        ("optimizer.name=sgd", r"optimizer\.name = 'sgd': choose one of adam, adamw"),
        ("network.name=unet", r"network\.name = 'unet': choose one of e2vid, .*firenet"),
        ("network.options.bins=4", r"network\.options\.bins: set stream\.recipe\.bins"),
        ("stream.batch_size=0", r"stream\.batch_size = 0: give a whole number from 1"),
        ("stream.batch_size=2.5", r"stream\.batch_size = 2\.5: give a whole number"),
        ("stream.batch_size=true", r"stream\.batch_size = True: give a whole number"),
        ("stream.videos=3", r"stream\.videos = 3: give text"),
        ("stream.recipe.gama=2", r"unknown recipe key 'gama'.*gamma"),
        ("stream.recipe.lead_frames=1", r"stream\.recipe\.lead_frames: leave it out"),
        ("stream.spec.flow_from=3", r"stream\.spec\.flow_from: section loss decides"),
        ("stream.mix=3", r"stream\.mix\.0 = None: give keys of section stream and weight"),
        ("stream.mix=[{weight: 1.2}]", r"stream\.mix\.0 = {'weight': 1\.2}: give .* at most 1"),
        ("stream.mix=[{videos: a}]", r"stream\.mix\.0 = {'videos': 'a'}: give keys"),
        ("stream.mix=[{weight: .7}, {weight: .7}]", r"stream\.mix\.1 = {'weight': 0\.7}: give"),
        ("stream.mix=[{weight: .5, mix: []}]", r"stream\.mix\.0 = "),
        ("stream.mix=[{weight: .5, lst: a}]", r"unknown key stream\.mix\.0\.lst \(did you mean 'list'"),
        ("stream.mix=[{weight: .5, spec: {flow_from: 3}}]", r"stream\.mix\.0\.spec\.flow_from: section loss decides"),
        ("stream.spec.preset=natural-davis346", r"natural-davis346 names a recipe: set stream\.recipe"),
        ("stream.spec.voxel_dtype=int4", r"voxel_dtype = 'int4'"),
        ("loss.l1_weight=0", r"l1_weight, lpips_weight and temporal_weight are all 0"),
        ("loss.l1_weight=-1", r"loss\.l1_weight = -1: give a number from 0"),
        ("loss.flow=guess", r"loss\.flow = 'guess': choose one of raft, stream"),
        ("run.validate_config=mine.yaml", r"run\.validate_config = mine\.yaml: run\.validate is missing"),
        ("loss=3", r"--set loss=3: write SECTION\.KEY=VALUE"),
        ("run.steps", r"--set run\.steps: write SECTION\.KEY=VALUE"),
        ("run.steps=[", r"not a value in YAML"),
        ("run.steps.more=1", r"run\.steps = \{'more': 1\}: give a whole number"),
    ],
)
def test_a_wrong_setting_is_named(tmp_path, setting, message):
    file = written(tmp_path, "c.yaml", "stream: {recipe: {preset: paper}}\n")
    with pytest.raises(UsageError, match=message):
        load_config(file, [setting])


def test_temporal_consistency_must_fit_the_clip(tmp_path):
    file = written(tmp_path, "c.yaml", "loss: {temporal_weight: 1, temporal_first_step: 40}\n")
    with pytest.raises(UsageError, match=r"loss\.temporal_first_step = 40: give less than .*= 40"):
        load_config(file)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("run: 3\n", "run = 3: it is a section"),
        ("- a\n", "expected sections of keys and values, found list"),
        ("run: {", "not YAML"),
        ("extends: no-such.yaml\n", "No such file.*shipped configurations: e2vid"),
        ("extends: c.yaml\n", "extends itself"),
    ],
)
def test_a_wrong_file_is_named(tmp_path, text, message):
    with pytest.raises(UsageError, match=message):
        load_config(written(tmp_path, "c.yaml", text))


def test_a_setting_below_a_single_value_is_refused(tmp_path):
    file = written(tmp_path, "c.yaml", "stream: {recipe: paper}\n")
    with pytest.raises(UsageError, match="recipe is 'paper' in the file, not a group of keys"):
        load_config(file, ["stream.recipe.bins=3"])


def test_differences_name_keys_and_both_values():
    ours = TrainConfig().to_dict()
    theirs = TrainConfig.from_dict({"optimizer": {"learning_rate": 0.5}}).to_dict()
    assert differences(ours, ours) == {}
    assert differences(ours, theirs) == {"optimizer.learning_rate": (1e-4, 0.5)}
