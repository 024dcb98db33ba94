"""Each part of a real service is made slow in turn, and the sentence names it."""

from __future__ import annotations

import os
import threading
from pathlib import Path
from typing import Any

import pytest

from tests.clips import panned_luma, write_clip
from v2v_client import V2VStreamDataset
from v2v_client.local_server import LocalServer
from v2v_protocol.errors import V2VError
from v2v_server.status.client import StatusClient
from v2v_server.status.snapshot import WINDOW_SECONDS

pytestmark = [pytest.mark.slow, pytest.mark.alone]

SLOW = Path(__file__).parent / "slow"
LITTLE = {"voxels_per_clip": 2, "bins": 2, "crop_height_px": 32, "crop_width_px": 32}
MUCH = {
    "voxels_per_clip": 6, "bins": 2, "crop_height_px": 320, "crop_width_px": 448,
    "leak_hz": 0.5, "threshold_mismatch_sigma": 0.2,
}  # fmt: skip


@pytest.fixture(scope="module")
def small(compiled: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Clips that take next to nothing to decode."""
    folder = tmp_path_factory.mktemp("small")
    for number in range(4):
        write_clip(folder / f"{number}.mp4", panned_luma(200, 48, 64, step=(1, 1 + number)), gop=5)
    return folder


@pytest.fixture(scope="module")
def large(compiled: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Clips that have to be decoded from far before."""
    folder = tmp_path_factory.mktemp("large")
    for number in range(2):
        write_clip(folder / f"{number}.mp4", panned_luma(240, 360, 480, step=(1, 1 + number)), gop=240, b_frames=2)
    return folder


@pytest.fixture(scope="module")
def near(compiled: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Clips as large that are decoded from just before."""
    folder = tmp_path_factory.mktemp("near")
    for number in range(2):
        write_clip(folder / f"{number}.mp4", panned_luma(240, 360, 480, step=(1, 1 + number)), gop=5)
    return folder


def verdicts(
    address: str, arrays: tuple[str, ...], recipe: dict[str, Any], pause_seconds: float
) -> list[dict[str, Any]]:
    """What is said of a service, once the window has nothing of the start in it, while a consumer takes batches."""
    stop = threading.Event()
    trouble: list[V2VError] = []

    def take() -> None:
        try:
            dataset = V2VStreamDataset(address, 4, arrays, recipe)
            while not stop.is_set():
                for _ in dataset:
                    if stop.wait(pause_seconds):
                        return
        except V2VError as error:
            trouble.append(error)

    consumer = threading.Thread(target=take)
    consumer.start()
    said = []
    try:
        with StatusClient(address) as client:
            while not trouble and not client.get_status()["totals"]["samples"]:
                stop.wait(0.2)
            stop.wait(WINDOW_SECONDS + 2.0)
            said += [client.get_status()["waiting"] for _ in range(3)]
    finally:
        stop.set()
        consumer.join(60)
    assert not trouble
    return said


@pytest.mark.parametrize(
    ("part", "clips", "arrays", "recipe", "workers", "pause_seconds", "slow"),
    [
        ("consumers", "small", ("voxels",), LITTLE, 2, 0.5, ""),
        ("decode", "large", ("voxels",), LITTLE, 1, 0.0, ""),
        ("simulate", "near", ("voxels", "flow"), MUCH, 1, 0.0, ""),
        ("handover", "small", ("voxels",), LITTLE, 1, 0.0, "handover"),
        ("broker", "small", ("voxels",), LITTLE, 2, 0.0, "broker"),
    ],
)
def test_the_sentence_names_the_slow_part(
    part: str,
    clips: str,
    arrays: tuple[str, ...],
    recipe: dict[str, Any],
    workers: int,
    pause_seconds: float,
    slow: str,
    request: pytest.FixtureRequest,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    if slow:
        monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(SLOW), *filter(None, [os.environ.get("PYTHONPATH")])]))
        monkeypatch.setenv("V2V_SLOW", slow)
    flags = [flag for name, value in recipe.items() for flag in ("--set", f"{name}={value}")]
    with LocalServer(request.getfixturevalue(clips), workers=workers, flags=flags) as server:
        said = verdicts(server.address, arrays, recipe, pause_seconds)
    assert said
    assert {each["part"] for each in said} == {part}, said[-1]
