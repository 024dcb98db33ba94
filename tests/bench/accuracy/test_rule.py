"""The rule by which a network ships, on figures that need no network."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from bench.accuracy import rule
from tests.bench.accuracy.test_recordings import written
from trainer.evaluation.metrics import make_metrics
from trainer.models import NETWORKS

Figures = dict[str, float]


def figures(lpips: float, correlation: float, mse: float = 0.03, grey_mse: float = 0.04) -> Figures:
    return {"lpips": lpips, "correlation": correlation, "mse": mse, "grey_mse": grey_mse}


@pytest.mark.parametrize(
    ("networks", "ships", "out"),
    [
        ({}, None, {}),
        ({"a": figures(0.3, 0.6), "b": figures(0.2, 0.56)}, "b", {"a": "LPIPS 0.300, b has 0.200"}),
        ({"a": figures(0.3, 0.6), "b": figures(0.2, 0.54)}, "a", {"b": "correlation 0.540, more than 0.05 below"}),
        (
            # A network that is out by its error sets no bar for the others.
            {"a": figures(0.3, 0.6), "b": figures(0.1, 0.9, mse=0.04)}, "a", {"b": "squared error 0.0400, a constant"},
        ),
        ({"a": figures(0.3, 0.6, mse=float("nan"))}, None, {"a": "squared error nan"}),
    ],
)  # fmt: skip
def test_the_rule(networks: dict[str, Figures], ships: str | None, out: dict[str, str]) -> None:
    verdict = rule.apply(networks)
    assert verdict.ships == ships
    assert verdict.out.keys() == out.keys()
    for name, why in out.items():
        assert verdict.out[name].startswith(why)


UNITS = st.floats(0, 1)


@given(st.dictionaries(st.sampled_from("abcde"), st.builds(figures, UNITS, UNITS, UNITS, UNITS)))
def test_each_network_ships_or_is_out_for_a_reason(networks: dict[str, Figures]) -> None:
    ships, out = rule.apply(networks)
    assert out.keys() == networks.keys() - {ships}
    better = [name for name, each in networks.items() if each["mse"] < each["grey_mse"]]
    assert (ships is None) == (not better)
    if ships is not None:
        assert all(networks[ships]["correlation"] >= networks[name]["correlation"] - rule.SLACK for name in better)


def test_one_grey_stands_for_all_judged_pictures() -> None:
    frames = torch.rand(2, 4, 1, 8, 8)
    frames[:, 2:, :, :, :4], frames[:, 2:, :, :, 4:] = 0.25, 0.75
    frames[1] += 0.1  # the mean of each picture would not do: events do not say how bright it is
    found = rule.on_worlds(
        (torch.zeros(2, 4, 5, 8, 8), frames), NETWORKS["firenet"](base_channels=2), make_metrics(["mse"], {})
    )
    assert found["grey_mse"] == pytest.approx(0.0625 + 0.05**2, rel=1e-5)


@given(st.lists(st.lists(UNITS, min_size=4, max_size=4), min_size=1, max_size=5))
def test_its_squared_error_comes_of_means(pictures: list[list[float]]) -> None:
    means = {name: float(np.mean(values)) for name, values in {"grey": pictures, "square": np.square(pictures)}.items()}
    found = rule.with_grey_mse(means | {"mse": 0.5})
    assert found == {"mse": 0.5, "grey_mse": pytest.approx(np.var(pictures), abs=1e-12)}


def test_the_mean_weighs_both_kinds_of_data_alike() -> None:
    kinds = [{"lpips_vgg": 0.1, "correlation": 0.2}, {"lpips_vgg": 0.3, "correlation": 0.8}]
    assert rule.mean_of(kinds, "lpips_vgg") == pytest.approx({"lpips": 0.2, "correlation": 0.5})


@pytest.mark.parametrize("published", [False, True])
def test_recordings_without_a_scored_picture_are_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, published: bool
) -> None:
    written(tmp_path, monkeypatch)
    found, by_grids = rule.on_recordings(
        tmp_path, NETWORKS["firenet"](base_channels=2), make_metrics(["mse"], {}), 96, published=published
    )
    assert found.keys() == {"mse", "grey_mse"}
    assert sum(each["windows"] for each in by_grids.values()) > 0
