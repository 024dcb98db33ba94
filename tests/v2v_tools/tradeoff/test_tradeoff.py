"""Speed against accuracy: measures with known answers, the Pareto front, the chosen setting, one short run for real."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from tests.bench.small import FLAGS, clips, records
from tests.clips import panned_luma, write_clip
from tests.oracles.decoded import decode_luma
from v2v_protocol.errors import UsageError
from v2v_protocol.recipe import Recipe
from v2v_protocol.spec import StreamSpec
from v2v_server.config import ServeConfig
from v2v_server.corpus.catalogue import open_catalogue
from v2v_server.video.probe import probe
from v2v_tools.tradeoff import command as tradeoff
from v2v_tools.tradeoff.measures import (
    Leases,
    compare,
    cpu_seconds,
    diversity,
    leases_of,
)
from v2v_tools.tradeoff.report import FORM, JUDGES, THRESHOLDS, TRUE_RATE, best, dominates, dominators, error_fields
from v2v_tools.tradeoff.settings import BESIDE, SOURCE, STORES, ServeSetting, axes, settings


def voxels(*values: float) -> np.ndarray[Any, Any]:
    return np.array(values, np.float32).reshape(1, 1, 1, -1)


def errors(sums: npt.NDArray[Any]) -> tuple[float | None, float | None]:
    fields = error_fields(np.tile(sums, (len(THRESHOLDS), 1)))
    return fields["voxel_error_at_0.2"], fields["count_error_at_2"]


def test_measures_of_known_pairs() -> None:
    assert errors(compare(voxels(3, -1, 0, 0), voxels(2, -1, 0, -2))) == ((1 + 2) / 5, (4 - 5) / 5)
    assert errors(compare(voxels(1, 0), voxels(0, 0))) == (None, None)
    full = np.full((1, 1, 1, 1), 127, np.int8)
    assert compare(full, -full).tolist() == [254, 127, 127]  # not subtracted in int8


COSTS = st.dictionaries(st.text(min_size=1, max_size=3), st.tuples(*[st.integers(0, 4).map(float)] * 3), min_size=1)


@given(COSTS)
def test_the_front_holds_what_nothing_dominates_and_the_rest_names_its_better(
    costs: dict[str, tuple[float, ...]],
) -> None:
    found = dominators(costs)
    assert set(found) == set(costs)
    front = [name for name, better in found.items() if better is None]
    assert front
    for name, better in found.items():
        beaten = any(
            all(a <= b for a, b in zip(other, costs[name], strict=True))
            and any(a < b for a, b in zip(other, costs[name], strict=True))
            for other in costs.values()
        )
        assert beaten == (better is not None)
        if better is not None:
            assert better in front
            assert dominates(costs[better], costs[name])
            assert not dominates(costs[name], costs[better])


def record(name: str, rate: float, error: float, count: int) -> dict[str, Any]:
    """Return a setting whose form or frames have an error, and the other half of it."""
    of = [each.key for each in JUDGES][:: 1 - 2 * (count % 2)]
    return dict(zip(of, (error, error / 2), strict=True)) | {
        "lost_share": 0.2, "name": name, "samples_per_core_second": rate, "samples_per_decode": count
    }  # fmt: skip


CHOICES = [
    record("exact", 4, 0.0, 1), record("exact 2", 8, 0.0, 2), record("exact 4", 12, 0.0, 4),
    record("prepared", 15, 0.3, 1), record("prepared worse", 20, 0.4, 1), record("prepared 4", 40, 0.3, 4),
]  # fmt: skip


@pytest.mark.parametrize(
    ("rate", "error", "name"),
    [
        (1, None, "exact"), (4, None, "exact"), (5, None, "exact 2"), (13, None, "prepared"), (16, None, "prepared 4"),
        (None, 0.0, "exact 4"), (None, 0.3, "prepared 4"), (None, 1.0, "prepared 4"),
    ],
)  # fmt: skip
def test_the_best_setting(rate: float | None, error: float | None, name: str) -> None:
    assert best(CHOICES, target_rate=rate, max_error=error)["name"] == name


def test_wishes_that_nothing_fulfils_name_the_nearest() -> None:
    with pytest.raises(UsageError, match="the fastest setting makes 40 samples"):
        best(CHOICES, target_rate=41, max_error=None)
    with pytest.raises(UsageError, match=r"the smallest error of a setting is 0\.3"):
        best(CHOICES[3:], target_rate=None, max_error=0.1)


def test_where_an_error_cannot_be_told_no_setting_is_the_best() -> None:
    untold = [*CHOICES[1:], CHOICES[0] | {"lost_share": 0.634}]
    with pytest.raises(UsageError, match=r"no best setting: .* no block follows 63% of .*, and the limit is 20%"):
        best(untold, target_rate=1, max_error=None)


def test_the_choice_is_written_and_a_wish_that_nothing_fulfils_is_status_1(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    compared = settings([], StreamSpec(), axes(["samples_per_decode=1,2", "noise_sigma=0.01"]))
    found = [
        {"measure": "setting", "name": setting.name, "samples_per_decode": setting.spec.samples_per_decode,
         "samples_per_core_second": 5.0 * setting.spec.samples_per_decode, "lost_share": 0.0, FORM.key: None,
         **{each.key: 0.25 for each in TRUE_RATE}}
        for setting in compared
    ]  # fmt: skip
    out = tmp_path / "chosen.yaml"
    flags = ["--videos", "clips", "--preset-out", str(out)]
    assert tradeoff.choose(found, compared, tradeoff._parser().parse_args([*flags, "--target-rate", "11"])) == 1
    assert "v2v-tradeoff: --target-rate 11: the fastest setting makes 10" in capsys.readouterr().err
    assert not out.exists()
    assert tradeoff.choose(found, compared, tradeoff._parser().parse_args([*flags, "--max-error", "0.25"])) == 0
    assert "best: source, K = 2, substep_px = 0" in capsys.readouterr().out
    assert ServeConfig.load(str(out), {"videos": "clips"}).spec == compared[2].spec
    comments = [line for line in out.read_text(encoding="utf-8").splitlines() if line.startswith("# ")]
    for measure in (FORM, *TRUE_RATE):
        assert any(measure.title in line and measure.reference in line for line in comments)


AXES = ["bins=5, 10,5", "voxel_seconds=0.1,0.2"]
CAMERA_OF_A_USER = StreamSpec(recipe=Recipe(leak_hz=(0.1, 0.2)))
EVERY = settings([BESIDE, *STORES], CAMERA_OF_A_USER, axes(AXES))


def test_settings_are_all_combinations_under_names_of_their_own() -> None:
    assert EVERY[0].name == "source, K = 1, substep_px = 0, bins = 5, voxel_seconds = 0.1"
    assert len({setting.name for setting in EVERY}) == len(EVERY) == 3 * 2 * 2 * 2 * (2 + len(STORES))
    assert len({setting.way for setting in EVERY}) == len({setting.single for setting in EVERY}) == len(EVERY) // 3


def test_a_form_is_judged_by_the_same_setting_from_exactly_decoded_frames() -> None:
    for setting in EVERY:
        exact = setting.exact
        assert (exact.form, exact.spec.samples_per_decode, exact.values) == (SOURCE, 1, setting.values)
        assert (exact.spec.recipe, exact.spec.substep_px) == (setting.spec.recipe, setting.spec.substep_px)


@pytest.mark.parametrize("setting", EVERY[::7], ids=lambda setting: setting.name)
def test_every_setting_is_a_configuration_of_the_server(setting: ServeSetting, tmp_path: Path) -> None:
    file = tmp_path / "preset.yaml"
    file.write_text(setting.yaml("top:0.54", "a test"), encoding="utf-8")
    config = ServeConfig.load(str(file), {"videos": "clips"})
    assert config.rows == "top:0.54"
    assert config.spec == setting.spec
    command = f"--size {STORES[setting.form]}" if setting.form in STORES else ""
    assert command in file.read_text(encoding="utf-8")


def test_works_take_turns_and_the_fastest_round_of_each_lease_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [0.0]
    monkeypatch.setattr(time, "process_time", lambda: clock[0])
    costs = {
        "a": iter([9.0, 1.0, 4.0, 3.0, 2.0, 5.0, 5.0]),
        "b": iter([9.0, 10.0, 10.0, 20.0, 20.0, 30.0, 30.0]),
    }
    done: list[str] = []

    def work(name: str) -> Callable[[int], None]:
        def do(number: int) -> None:
            done.append(f"{name}{number}")
            clock[0] += next(costs[name])

        return do

    found = cpu_seconds({name: work(name) for name in costs}, 2)
    there, back = ["a0", "b0", "a1", "b1"], ["b0", "a0", "b1", "a1"]
    assert done == ["a0", "b0", *there, *back, *there]
    assert found == {"a": (1.0 + 2.0) / 2 / 4, "b": 10.0 / 4}  # of four views


def test_one_lease_alone_has_no_diversity(tmp_path: Path) -> None:
    (tmp_path / "clips").mkdir()
    write_clip(tmp_path / "clips" / "a.mp4", panned_luma(40, 100, 180))
    spec = StreamSpec(recipe=Recipe(voxels_per_clip=3, crop_height_px=64, crop_width_px=64))
    with contextlib.closing(open_catalogue(tmp_path / "clips", cache_dir=tmp_path / "cache", processes=0)) as catalogue:
        root, leases = leases_of(ServeSetting(SOURCE, spec), catalogue)
    assert diversity(Leases(root, leases[:1])) == []
    siblings, batch = diversity(Leases(root, leases))
    assert (siblings["name"], batch["name"]) == ("siblings", "batch")
    assert -1 <= batch["course_correlation"] < 1
    assert 1 <= siblings["effective_samples_of_2"] <= 2
    assert siblings["effective_samples_of_2"] <= siblings["effective_samples_of_4"] <= 4


@pytest.mark.parametrize(
    "flags",
    [
        [],
        ["--clips", "0"], ["--target-rate", "-1"], ["--max-error", "nan"], ["--forms", "h265 1"],
        ["--preset-out", "x.yaml"],
        ["--set", "gama=1"], ["--rows", "upper"], ["--vary", "substep_px"], ["--vary", "tolerance=0.01"],
        ["--vary", "samples_per_decode=3"],
        ["--vary", "voxel_seconds=0.1,101"], ["--preset-out", "nowhere/x.yaml", "--max-error", "1"],
    ],
)  # fmt: skip
def test_wrong_usage_is_status_2(tmp_path: Path, flags: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert tradeoff.main(["--videos", str(tmp_path), *flags]) == 2
    error = capsys.readouterr().err
    assert error.startswith("v2v-tradeoff: ")
    assert error.count("\n") == 1


def test_a_folder_beside_has_the_same_clips(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name, frames in (("clips", 40), ("shorter", 39)):
        (tmp_path / name).mkdir()
        write_clip(tmp_path / name / "a.mp4", panned_luma(frames, 100, 180))
    (tmp_path / "empty").mkdir()
    flags = ["--rows", "full", "--set", "voxels_per_clip=3", "--set", "crop_height_px=64", "--set", "crop_width_px=64"]
    for name, complaint in (
        ("shorter", "a.mp4 has 39 frames of 180x100 px instead of 40 frames of 180x100 px: encode it again with all"),
        ("empty", "a.mp4: there is no such file: give a folder with each clip under its own name"),
    ):
        beside = ["--videos", str(tmp_path / "clips"), "--beside", str(tmp_path / name)]
        assert tradeoff.main([*beside, *flags]) == 2
        assert complaint in capsys.readouterr().err


@pytest.mark.slow
def test_a_short_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, chosen = tmp_path / "tradeoff.json", tmp_path / "chosen.yaml"
    folder = clips(tmp_path / "clips")
    smaller = tmp_path / "smaller"
    smaller.mkdir()
    for path in folder.iterdir():
        facts = probe(path)
        luma = decode_luma(path, facts.index, 0, facts.frames).frames
        write_clip(smaller / path.name, luma, options={"crf": "40"}, full_range=facts.full_range)
    flags = ["--videos", str(folder), "--beside", str(smaller), "--rows", "full", "--clips", "2"]
    flags += ["--forms", "lossless fast", "--vary", "samples_per_decode=1,4"]
    flags += ["--set", "leak_hz=0.01", "--max-error", "5", "--preset-out", str(chosen)]
    assert tradeoff.main([*flags, *FLAGS, "--json", str(out)]) == 0
    found = records(out)
    by_name = {item["name"]: item for item in found if item["measure"] == "setting"}
    spec = StreamSpec()
    varied = axes(["samples_per_decode=1,4"])
    assert set(by_name) == {setting.name for setting in settings([BESIDE, "lossless fast"], spec, varied)}
    way = {item["way"]: item for item in by_name.values()}
    error = {name: item["voxel_error_at_0.2"] for name, item in way.items()}
    assert error["source, substep_px = 1"] == error["source, substep_px = 0"] == 0
    assert error["beside, substep_px = 0"] > 0
    assert error["lossless fast, substep_px = 1"] == 0
    at_the_true_rate = {name: item[TRUE_RATE[0].key] for name, item in way.items()}
    assert at_the_true_rate["source, substep_px = 0"] == at_the_true_rate["beside, substep_px = 0"]
    assert at_the_true_rate["source, substep_px = 0"] > at_the_true_rate["source, substep_px = 1"] > 0
    assert {item["way"] for item in found if item["measure"] == "speed"} == {
        "source, substep_px = 0",
        "source, substep_px = 1",
    }
    assert min(item["voxel_error_at_0.2"] for item in found if item["measure"] == "scale") > 0
    fastest = max(by_name.values(), key=lambda item: item["samples_per_core_second"])
    assert f"best: {fastest['name']}" in capsys.readouterr().out
    assert yaml.safe_load(chosen.read_text(encoding="utf-8")).get("substep_px", 0) == fastest["substep_px"]
