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


# How many, frames, height, width; and how they are coded.
CLIPS: dict[str, tuple[int, tuple[int, int, int], dict[str, Any]]] = {
    "next to nothing to decode": (4, (200, 48, 64), {"gop": 5}),
    "decoded from far before": (2, (240, 360, 480), {"gop": 240, "b_frames": 2}),
    "as large, decoded from just before": (2, (240, 360, 480), {"gop": 5}),
}


@pytest.fixture(scope="module")
def clips(compiled: None, request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("clips")
    number, shape, coding = CLIPS[request.param]
    for each in range(number):
        write_clip(folder / f"{each}.mp4", panned_luma(*shape, step=(1, 1 + each)), **coding)
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
        ("consumers", "next to nothing to decode", ("voxels",), LITTLE, 2, 0.5, ""),
        ("decode", "decoded from far before", ("voxels",), LITTLE, 1, 0.0, ""),
        ("simulate", "as large, decoded from just before", ("voxels", "flow"), MUCH, 1, 0.0, ""),
        ("handover", "next to nothing to decode", ("voxels",), LITTLE, 1, 0.0, "handover"),
        ("broker", "next to nothing to decode", ("voxels",), LITTLE, 2, 0.0, "broker"),
    ],
    indirect=["clips"],
)
def test_the_sentence_names_the_slow_part(
    part: str,
    clips: Path,
    arrays: tuple[str, ...],
    recipe: dict[str, Any],
    workers: int,
    pause_seconds: float,
    slow: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    if slow:
        monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(SLOW), *filter(None, [os.environ.get("PYTHONPATH")])]))
        monkeypatch.setenv("V2V_SLOW", slow)
    flags = [flag for name, value in recipe.items() for flag in ("--set", f"{name}={value}")]
    with LocalServer(clips, workers=workers, flags=flags) as server:
        said = verdicts(server.address, arrays, recipe, pause_seconds)
    assert said
    assert {each["part"] for each in said} == {part}, said[-1]
