"""Test configurations, the paper's data sets, and its results."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

from trainer.evaluation import paper
from trainer.evaluation.config import EvaluationConfig, folder_config, parse_config, read_config, shipped
from trainer.evaluation.data_sets import DATA_SETS
from trainer.evaluation.voxelise import VoxelSettings
from v2v_protocol.errors import UsageError


def test_shipped_configurations_name_the_whole_paper() -> None:
    assert set(shipped()) >= {"paper-discrete", "paper-interpolated", "firenet"}
    assert list(read_config("mvsec-flow").data_sets[0].time_ranges) == list(paper.FLOW_SEQUENCES)
    for name in shipped().keys() - {"mvsec-flow"}:
        config = read_config(name)
        assert [data_set.name for data_set in config.data_sets] == ["HQF", "EVAID", "IJRR", "MVSEC"]
        assert config.voxels is not None
        assert "correlation" in config.metrics
    assert read_config("paper-discrete").voxels == VoxelSettings(kind="discrete")
    assert read_config("firenet").model_options == {"normalize_voxels": True}


def test_the_default_metrics_tell_a_picture_from_constant_grey() -> None:
    content = {"data": [{"name": "mine", "sequences": ["desk"]}]}
    assert "correlation" in parse_config(content, "a.yaml").metrics
    assert "correlation" in EvaluationConfig(()).metrics


def test_sequences_and_time_ranges_of_the_paper() -> None:
    assert {name: len(data_set.time_ranges) for name, data_set in DATA_SETS.items()} == {
        "HQF": 14, "EVAID": 11, "IJRR": 7, "MVSEC": 6
    }  # fmt: skip
    assert all(time_range is None for time_range in DATA_SETS["HQF"].time_ranges.values())
    assert DATA_SETS["IJRR"].time_ranges["slider_depth"] == (1.0, 2.5)
    assert DATA_SETS["MVSEC"].time_ranges["outdoor_day2"] == (100.0, 160.0)
    assert DATA_SETS["EVAID"].time_ranges["playball"] == (25.0, 30.0)
    assert not DATA_SETS["EVAID"].time_ranges.keys() & {"blocks", "umbrella", "room2"}


def test_the_documented_conversions_write_to_the_data_sets_folders() -> None:
    page = (Path(__file__).parents[3] / "docs" / "evaluation.md").read_text(encoding="utf-8")
    converted = set(re.findall(r"v2v-convert raw/\S+ --out data/(\w+)", page))
    assert converted == {data_set.folder for data_set in DATA_SETS.values()}
    command = re.search(r"v2v-eval (\S+) --weights \S+ --data data ", page)
    assert command is not None
    assert read_config(command[1]).data_sets


def test_results_of_the_paper() -> None:
    assert paper.RESULTS["E2VID WebVid10K"]["HQF"] == {"mse": 0.032, "ssim_range2": 0.676, "lpips_alex": 0.265}
    assert paper.RESULTS["E2VID+"]["MVSEC"]["mse"] == 0.132
    assert all(set(results) == set(DATA_SETS) for results in paper.RESULTS.values())


def test_own_data_sets(tmp_path: Path) -> None:
    (tmp_path / "own.yaml").write_text(
        "model: {name: firenet, options: {normalize_voxels: true}}\n"
        "voxels: {kind: interpolated, span: window}\n"
        "metrics: [mse]\n"
        "data: [IJRR, {name: mine, folder: here, sequences: {a: [0, 10], b: null}}, {name: also, sequences: [c]}]\n"
    )
    config = read_config(str(tmp_path / "own.yaml"))
    assert config.data_sets[0] is DATA_SETS["IJRR"]
    assert (config.data_sets[1].folder, config.data_sets[1].time_ranges) == ("here", {"a": (0.0, 10.0), "b": None})
    assert (config.data_sets[2].folder, config.data_sets[2].time_ranges) == ("also", {"c": None})
    assert (config.model, config.voxels) == ("firenet", VoxelSettings(kind="interpolated", span="window"))
    assert config.metrics == ("mse",)


def test_folders_and_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("b.h5", "a.hdf5", "notes.txt"):
        (tmp_path / name).touch()
    (data_set,) = folder_config(tmp_path).data_sets
    assert (data_set.name, dict(data_set.time_ranges)) == (tmp_path.stem, {"a": None, "b": None})
    assert dict(folder_config(tmp_path / "b.h5").data_sets[0].time_ranges) == {"b": None}
    monkeypatch.chdir(tmp_path)
    assert folder_config(Path(".")).data_sets[0].name == tmp_path.stem
    (tmp_path / "empty").mkdir()
    with pytest.raises(UsageError, match=r"no recordings.*v2v-convert"):
        folder_config(tmp_path / "empty")


def test_one_entry_needs_no_list() -> None:
    found = parse_config({"data": ["HQF"], "metrics": "mse", "paper": "E2VID+"}, "x")
    assert (found.metrics, found.paper) == (("mse",), ("E2VID+",))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ([], "x: .* should have the keys model, voxels, metrics, data, paper"),
        ({"data": ["HQF"], "colour": 1}, "unknown key 'colour'"),
        ({}, "x: data: None should be a list"),
        ({"data": ["KITTI"]}, "'KITTI' is none of the paper's: HQF, EVAID, IJRR, MVSEC"),
        ({"data": ["HQF", {"name": "HQF", "sequences": ["b"]}]}, "two data sets are named HQF"),
        ({"data": [{"name": "a"}]}, "needs a name and sequences"),
        ({"data": [{"name": "a", "sequences": "b"}]}, "sequences .b.: give a list"),
        ({"data": [{"name": "a", "sequences": {"b": [1]}}]}, r"b: \[1\] is not \[first second"),
        ({"data": [{"name": "a", "sequences": {"b": [3, 2]}}]}, r"b: \[3, 2\] s"),
        ({"data": ["HQF"], "voxels": {"kind": "square"}}, "kind 'square'"),
        ({"data": ["HQF"], "voxels": {"size": 3}}, "voxels: unknown key 'size'"),
        ({"data": ["HQF"], "model": {"options": "normalize"}}, "x: model: options: 'normalize' should be names and"),
        ({"data": ["HQF"], "model": {"options": {1: 2}}}, r"x: model: options: \{1: 2\} should be names and"),
        ({"data": ["HQF"], "metrics": ["psnr"]}, "'psnr' is none of mse"),
        ({"data": ["HQF"], "paper": ["V2E"]}, "'V2E' is none of E2VID"),
    ],
)
def test_mistakes_are_named(content: Any, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        parse_config(content, "x")


def test_missing_or_malformed_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"no file absent; shipped configurations: .*paper-discrete"):
        read_config("absent")
    (tmp_path / "a.yaml").write_text("data: [HQF")
    with pytest.raises(UsageError, match="is not YAML"):
        read_config(str(tmp_path / "a.yaml"))
