"""Configuration of a training run: defaults, files, settings, and messages that name the key."""

from __future__ import annotations

from operator import attrgetter
from pathlib import Path
from typing import Any

import pytest

from trainer.config import TrainConfig, differences
from trainer.config_file import load_config, shipped
from v2v_protocol.errors import UsageError
from v2v_protocol.recipe import Recipe, preset


def written(folder: Path, name: str, text: str) -> str:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return str(path)


@pytest.mark.parametrize("name", shipped())
def test_every_shipped_configuration_is_valid(name):
    config = load_config(name)
    assert config.to_dict() == TrainConfig.from_dict(config.to_dict()).to_dict()


E2VID = {
    "network.name": "e2vid", "stream.batch_size": 12, "run.epochs": 80,
    "stream.resolved_recipe.voxels_per_clip": 40, "stream.resolved_recipe.bins": 5,
    "stream.resolved_recipe.crop_height_px": 128, "stream.resolved_recipe.crop_width_px": 128,
    "loss.lpips_weight": 1, "loss.l1_weight": 1, "loss.temporal_weight": 1,
    "loss.lpips_network": "vgg", "loss.temporal_first_step": 20, "loss.temporal_rule": "half",
    "optimizer.name": "adam", "optimizer.learning_rate": 1e-4, "optimizer.amsgrad": True,
    "optimizer.weight_decay": 0, "optimizer.learning_rate_decay": 1, "optimizer.clip_gradient_norm": 0,
    "optimizer.ema_decay": 0,
}  # fmt: skip
ADAM = {
    "optimizer.name": "adam", "optimizer.learning_rate": 1e-4, "optimizer.weight_decay": 0,
    "optimizer.learning_rate_decay": 1, "optimizer.amsgrad": True,
    "compute.precision": "tf32", "compute.cudnn_benchmark": True,
}  # fmt: skip
WORLDS = {
    "loss.flow": "stream", "loss.valid": "consistent", "stream.resolved_recipe": preset("worlds"),
    "stream.videos_kind": "photographs", "stream.rows": "full",
}  # fmt: skip
PUBLISHED = {
    "e2vid": E2VID,
    "e2vid-webvid100": {"run.epochs": 8000, "run.keep_epochs": 0},
    "e2vid-webvid1k": {"run.epochs": 800, "run.keep_epochs": 0},
    "e2vid-alex-tc": {
        "loss.l1_weight": 0, "loss.lpips_network": "alex", "loss.temporal_first_step": 1, "loss.temporal_rule": "half",
    },
    "hypere2vid": ADAM | {
        "network.name": "hypere2vid", "optimizer.learning_rate": 1e-3, "stream.batch_size": 12, "run.epochs": 80,
        "loss.guide_epochs": 16,
    },
    "etnet": ADAM | {
        "network.name": "etnet", "optimizer.name": "adamw", "optimizer.learning_rate": 2e-4,
        "optimizer.weight_decay": 0.01, "optimizer.learning_rate_decay": 0.94, "stream.batch_size": 6,
        "run.epochs": 100,
    },
    "evflownet": ADAM | {
        "network.name": "evflownet", "stream.batch_size": 10, "run.epochs": 50, "loss.gamma": 0,
        "loss.raft_size": "large",
    },
    "eraft": ADAM | {
        "network.name": "eraft", "stream.batch_size": 10, "run.epochs": 50, "loss.gamma": 0.8,
        "loss.raft_size": "large",
    },
    "eraft-as-published": {"loss.gamma": 0},
    "evflownet-worlds": WORLDS | {"network.name": "evflownet", "loss.gamma": 0},
    "eraft-worlds": WORLDS | {"network.name": "eraft", "loss.gamma": 0.8},
}  # fmt: skip


@pytest.mark.parametrize("name", PUBLISHED)
def test_recipes_have_the_published_values(name):
    config = load_config(name)
    assert {key: attrgetter(key)(config) for key in PUBLISHED[name]} == PUBLISHED[name]


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


def test_settings_win_over_the_file_and_the_file_over_what_it_extends(tmp_path):
    written(tmp_path, "base.yaml", "run: {steps: 1, epochs: 2}\nstream: {recipe: {preset: paper, bins: 3}}\n")
    mine = written(tmp_path, "mine.yaml", "extends: base.yaml\nrun: {steps: 10, log_every: 7}\n")
    config = load_config(mine, ["run.steps=100", "stream.recipe.voxels_per_clip=8", "optimizer.learning_rate=1e-3"])
    assert (config.run.steps, config.run.epochs, config.run.log_every) == (100, 2, 7)
    recipe = config.stream.resolved_recipe
    assert (recipe.bins, recipe.voxels_per_clip) == (3, 8)
    assert config.optimizer.learning_rate == 1e-3


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
        ("compute.channels_last=maybe", r"compute\.channels_last = 'maybe': give true, false or auto"),
        ("compute.channels_last=1", r"compute\.channels_last = 1: give true, false or auto"),
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
        ("stream.mix=[{weight: .5, recipe: {gama: 2}}]", r"unknown recipe key 'gama'.*gamma"),
        ("stream.spec.preset=natural-davis346", r"natural-davis346 names a recipe: set stream\.recipe"),
        ("stream.spec.voxel_dtype=int4", r"voxel_dtype = 'int4'"),
        ("loss.l1_weight=0", r"l1_weight, lpips_weight and temporal_weight are all 0"),
        ("loss.l1_weight=-1", r"loss\.l1_weight = -1: give a number from 0"),
        ("loss.flow=guess", r"loss\.flow = 'guess': choose one of raft, stream"),
        ("run.validate_config=mine.yaml", r"run\.validate_config = mine\.yaml: run\.validate is missing"),
        ("stream.recipe.preset.bins=3", "preset is 'paper' in the file, not a group of keys"),
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


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("run: 3\n", "run = 3: it is a section"),
        ("- a\n", "expected sections of keys and values, found list"),
        ("run: {", "not YAML"),
        ("extends: no-such.yaml\n", "No such file.*shipped configurations: e2vid"),
        ("extends: c.yaml\n", "extends itself"),
        (
            "loss: {temporal_weight: 1, temporal_first_step: 40}\n",
            r"loss\.temporal_first_step = 40: give less than .*= 40",
        ),
    ],
)
def test_a_wrong_file_is_named(tmp_path, text, message):
    with pytest.raises(UsageError, match=message):
        load_config(written(tmp_path, "c.yaml", text))


def test_differences_name_keys_and_both_values():
    ours = TrainConfig().to_dict()
    theirs = TrainConfig.from_dict({"optimizer": {"learning_rate": 0.5}}).to_dict()
    assert differences(ours, ours) == {}
    assert differences(ours, theirs) == {"optimizer.learning_rate": (1e-4, 0.5)}


@pytest.mark.parametrize(
    ("own", "entry", "expected"),
    [
        ("{preset: clean, bins: 3}", "{gamma: 2}", {"preset": "clean", "bins": 3, "gamma": 2}),
        ("{preset: clean, bins: 3}", "{preset: sensor}", {"preset": "sensor", "bins": 3}),
        ("{preset: clean, bins: 3}", "sensor", {"preset": "sensor"}),
        ("davis346", "{bins: 3}", {"preset": "davis346", "bins": 3}),
    ],
)
def test_an_entry_of_a_mixture_inherits_the_fields_of_the_recipe(
    own: str, entry: str, expected: dict[str, Any]
) -> None:
    config = load_config("e2vid", [f"stream.recipe={own}", f"stream.mix=[{{weight: .5, videos: a, recipe: {entry}}}]"])
    mixed, _ = config.stream.mixed["stream.mix.0"]
    assert mixed.resolved_recipe == Recipe.from_dict(expected)
