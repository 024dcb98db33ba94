"""Test AEE and 3PE for known flow in files of MVSEC's layout, through converter and command, in both conventions.

columns   0: no depth   1: no flow   2-5: flow (length, 0), by field and part of the rows
events    window 0, 1: rows 0-49 of column 2 (part A), rows 100-119 of column 3 (part B), rows 190-199 of column 4
          (the hood), every row of column 0; two that cancel in column 5
          window 2: none
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import torch
from torch import Tensor

from tests.trainer.evaluation.test_flow import constant
from trainer.convert.cli import main as convert
from trainer.evaluation.cli import main as evaluate
from trainer.evaluation.flow import FlowRun, evaluate_flow
from trainer.evaluation.voxelise import VoxelSettings
from trainer.models import EVFlowNet

HEIGHT, WIDTH = 200, 6
PARTS = {"A": (0, 100), "B": (100, 190), "hood": (190, 200)}
LENGTHS = {"A": (1.0, 5.0, 2.0, 7.0), "B": (4.0, 0.5, 6.0, 1.0), "hood": (30.0, 20.0, 10.0, 40.0)}
"""px, of fields 0 .. 3; there are three windows."""
WITH_EVENTS = {"A": 50, "B": 20, "hood": 10}
"""Pixels with known flow and events, in windows 0 and 1."""
PREDICTED = 2.0


def write_raw(folder: Path, name: str) -> Path:
    times = 1000.0 + 0.05 * np.arange(4)
    places = [
        *((0, row, 1) for row in range(HEIGHT)),
        *((2, row, 1) for row in range(50)),
        *((3, row, -1) for row in range(100, 120)),
        *((4, row, 1) for row in range(190, 200)),
        (5, 0, 1), (5, 0, -1),
    ]  # fmt: skip
    events = [(x, y, time + 0.02, p) for time in times[:2] for x, y, p in places]
    flow, depth = np.zeros((4, 2, HEIGHT, WIDTH)), np.ones((4, HEIGHT, WIDTH), np.float32)
    for part, (first, end) in PARTS.items():
        flow[:, 0, first:end] = np.array(LENGTHS[part])[:, None, None]
    flow[..., 1] = 0
    depth[..., 0] = np.nan
    with h5py.File(folder / f"{name}_data.hdf5", "w") as file:
        file["davis/left/events"] = np.array(events, float)
        file["davis/left/image_raw"] = np.zeros((4, HEIGHT, WIDTH), np.uint8)
        file["davis/left/image_raw_ts"] = times
        file["davis/left/image_raw_event_inds"] = np.array([0, 0, len(places), 2 * len(places) - 1])
    with h5py.File(folder / f"{name}_gt.hdf5", "w") as file:
        file["davis/left/flow_dist"], file["davis/left/depth_image_raw"] = flow, depth
        file["davis/left/depth_image_raw_ts"] = times
    return folder / f"{name}_data.hdf5"


def by_hand(predicted: float, fields: tuple[int, ...], counted: tuple[str, ...]) -> dict[str, float]:
    """Fields of the windows; a window without events scores 0 if it is among the fields' three."""
    four_columns = {part: 4 * (PARTS[part][1] - PARTS[part][0]) for part in counted}
    with_events = {part: WITH_EVENTS[part] for part in counted}
    found = {}
    for kind, pixels, number in (("dense", four_columns, 3), ("sparse", with_events, 2)):
        errors = [{part: abs(LENGTHS[part][field] - predicted) for part in counted} for field in fields[:number]]
        weight = sum(pixels.values())
        found[f"aee_{kind}"] = [sum(pixels[part] * each[part] for part in counted) / weight for each in errors]
        found[f"3pe_{kind}"] = [
            100 * sum(pixels[part] * (each[part] > 3) for part in counted) / weight for each in errors
        ]
    return {name: sum(values) / len(values) for name, values in found.items()}


@pytest.mark.parametrize("name", ["indoor_flying1", "outdoor_day1"])
@pytest.mark.parametrize("as_published", [False, True])
def test_aee_and_3pe_of_a_constant_and_a_zero_prediction(tmp_path: Path, name: str, as_published: bool) -> None:
    data, weights, out = tmp_path / "data" / "mvsec", tmp_path / "a.pth", tmp_path / "a.json"
    assert not convert([str(write_raw(tmp_path, name)), "--out", str(data)])
    torch.save(constant(PREDICTED, 0.0).state_dict(), weights)
    flags = ["--as-published"] if as_published else []
    given = ["--weights", str(weights), "--data", str(tmp_path / "data"), "--cuts", "none", "--json", str(out)]
    assert not evaluate(["mvsec-flow", *given, *flags])
    found = {record["predictor"]: record for record in json.loads(out.read_text())}
    whole = as_published or name.startswith("indoor")
    counted = ("A", "B", "hood") if whole else ("A", "B")
    for predictor, predicted in (("network", PREDICTED), ("zeros", 0.0)):
        expected = by_hand(predicted, (1, 2, 3) if as_published else (0, 1, 2), counted)
        if as_published:  # the window without events scores 0
            expected = {key: value * 2 / 3 if "sparse" in key else value for key, value in expected.items()}
        assert found[predictor]["windows"] == 3
        assert {key: found[predictor][key] for key in expected} == pytest.approx(expected, rel=1e-5)


class Late(EVFlowNet):
    """Take the previous window as well, as E-RAFT does, and ignore it."""

    lead_voxels = 1

    def unroll(self, x: Tensor, state: Any, steps: int, _guide: Any) -> tuple[Tensor, tuple[()]]:
        return self.unet(x)[0 if state is not None else len(x) // steps :], ()


@pytest.mark.parametrize("as_published", [False, True])
def test_as_published_the_events_of_eraft_are_those_of_the_window_before(tmp_path: Path, as_published: bool) -> None:
    """Windows 0 and 1 have events; as published windows 1 and 2 count, with fields 2 and 3, and window 0 scores 0."""
    assert not convert([str(write_raw(tmp_path, "indoor_flying1")), "--out", str(tmp_path)])
    network = Late(base_channels=2)
    network.load_state_dict(constant(PREDICTED, 0.0).state_dict())
    run = FlowRun(network, VoxelSettings(), as_published=as_published)
    found = evaluate_flow(run, tmp_path / "indoor_flying1.h5", None)
    every = ("A", "B", "hood")
    expected = by_hand(PREDICTED, (2, 3) if as_published else (0, 1), every)
    of_zeros = by_hand(0.0, (1, 2) if as_published else (0, 1), every)
    share = 2 / 3 if as_published else 1
    for name in ("aee_sparse", "3pe_sparse"):
        assert found["network"].means[name] == pytest.approx(share * expected[name], rel=1e-5)
        assert found["zeros"].means[name] == pytest.approx(share * of_zeros[name], rel=1e-5), "it is no E-RAFT"
