"""Recordings of simulated cameras: what follows from the light, whatever camera is drawn."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from bench.accuracy import learn, recordings
from bench.frame import Report, parser_of
from trainer.evaluation.metrics import mse
from trainer.evaluation.readers import Recording
from trainer.models import NETWORKS
from v2v_protocol.errors import UsageError

HZ = 100.0


def light(first: float, last: float) -> recordings.Reals:
    """Return 21 pictures of a plain wall: half as long in each light."""
    return np.repeat([first, last], (10, 11))[:, None, None] * np.ones((16, 24))


@pytest.mark.parametrize(("first", "last", "sign"), [(0.1, 0.9, 1), (0.9, 0.1, -1), (0.5, 0.5, 0)])
def test_a_step_of_light_fires_its_sign_at_its_time_and_nothing_else_but_noise(
    first: float, last: float, sign: int
) -> None:
    events, drawn = recordings.seen(light(first, last), HZ, np.random.default_rng(0))
    assert (np.diff(events.t_ns) >= 0).all()
    assert events.x.max() < 24
    assert events.y.max() < 16
    noise = 5 * 0.2 * 16 * 24  # at most 5 a pixel and second
    signs = np.where(events.p, 1, -1)
    wrong = np.count_nonzero(signs != sign) if sign else len(events)
    assert wrong < noise
    if sign:
        change = abs(np.log((recordings.DARK + last**2.2) / (recordings.DARK + first**2.2)))
        expected = change / drawn["threshold_pos" if sign > 0 else "threshold_neg"] * 16 * 24
        assert np.count_nonzero(signs == sign) == pytest.approx(expected, rel=0.1, abs=noise + 16 * 24)
        assert np.count_nonzero(events.t_ns < 0.09e9) < noise


def written(folder: Path, monkeypatch: pytest.MonkeyPatch, *flags: str) -> Report:
    """Write recordings to a folder, one of them too short for a picture, one with many events, one of a picture that
    ``firenet-cpu`` trains on; return the report.
    """

    def scenes(side: int, films: list[Path]) -> Iterator[tuple[str, recordings.Reals, float]]:
        yield "step", light(0.2, 0.8), HZ
        yield "flash", light(0.2, 0.8)[7:13], HZ
        yield "busy", np.random.default_rng(0).random((21, 16, 24)), HZ
        yield "gravel_60", light(0.2, 0.8), HZ

    monkeypatch.setattr(recordings, "scenes", scenes)
    parser = parser_of("recordings", recordings)
    return recordings.measure(parser.parse_args(["--out", str(folder), "--side", "32", *flags]))


def test_every_recording_has_true_pictures_at_their_times_and_none_shows_one_of_the_training(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert [record["recording"] for record in written(tmp_path, monkeypatch).records] == ["step", "flash", "busy"]
    with Recording(tmp_path / "step.h5") as found:
        assert len(found.images) == 5
        levels = [found.image(image).mean() for image in found.images]
    assert levels == [204.0] * 5


def test_the_rule_needs_what_it_judges_by(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UsageError, match="needs --photographs DIR and --lpips"):
        written(tmp_path, monkeypatch, "--weights", "a=a.pth")


def test_networks_are_judged_by_the_rule(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Candidates only: one that normalises its input, as published FireNet does, is shown beside."""
    torch.manual_seed(0)
    torch.save(NETWORKS["firenet"](base_channels=2).state_dict(), tmp_path / "weights.pth")
    frames = torch.rand(2, 4, 1, 32, 32)
    monkeypatch.setattr(learn, "held_out", lambda *_: {"worlds": (torch.zeros(2, 4, 5, 32, 32), frames)})
    metrics = {"lpips_alex": mse, "correlation": mse, "mse": mse}
    monkeypatch.setattr(recordings, "make_metrics", lambda *_: metrics)
    flags = ["--photographs", "x", "--lpips", "alex", "x", "x"]
    networks = [f"--weights=mine={tmp_path}/weights.pth", f"--normalized-weights=published={tmp_path}/weights.pth"]
    found = written(tmp_path, monkeypatch, *flags, *networks)
    judged = [record for record in found.records if "network" in record and "windows" not in record]
    assert [(record["network"], record["data"]) for record in judged] == [
        (name, data) for name in ("mine", "published") for data in ("recordings", "worlds", "mean")
    ]
    for one, other, mean in zip(judged[::3], judged[1::3], judged[2::3], strict=True):
        assert mean["mse"] == pytest.approx((one["mse"] + other["mse"]) / 2)
        assert min(one["grey_mse"], other["grey_mse"]) > 0.05  # 1 / 12 is that of random greys
    parts = [record for record in found.records if "windows" in record]
    assert {record["data"] for record in parts} == {"grids from 81"}  # the first 100 ms have no picture
    assert {record["network"] for record in parts} == {"mine", "published"}
    text = " ".join(found.lines)
    assert "mine" in text
    assert "published" not in text
