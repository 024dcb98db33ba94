"""Test the command end to end: raw forms, conversion, reconstruction, scores, tables, records, pictures, video."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from tests.trainer.convert import raw_forms
from tests.trainer.convert.scene import expected_voxels, scene
from tests.trainer.evaluation.h5_file import random_recording
from tests.trainer.evaluation.test_metrics import slow_ssim
from trainer.convert import cli as convert_cli
from trainer.evaluation import cli
from trainer.evaluation import evaluate as evaluate_module
from trainer.evaluation.readers import Recording
from trainer.evaluation.reconstruct import Step
from trainer.models import FireNet
from v2v_protocol.errors import UsageError
from v2v_recordings.items import ConvertOptions, Light, Picture
from v2v_recordings.reading import read_items

TOP_PX, LEFT_PX = 82, 44
"""Headings and the arrow of time, beside the panels of a picture."""


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    torch.manual_seed(0)
    torch.save(FireNet(base_channels=4).state_dict(), tmp_path / "weights.pth")
    return tmp_path / "weights.pth"


def evaluate(*arguments: object) -> list[dict[str, Any]]:
    """Run the command and return its records."""
    out = Path(str(arguments[arguments.index("--weights") + 1])).with_name("records.json")
    cli.main([str(argument) for argument in (*arguments, "--json", out)])
    records: list[dict[str, Any]] = json.loads(out.read_text())
    return records


def test_scores_of_a_converted_bag_equal_those_computed_by_hand(tmp_path: Path, weights: Path) -> None:
    """The expected scores come from the known voxel grids, one pass of the network, and the formulas in float64."""
    original = scene()
    raw_forms.write_bag(tmp_path / "desk.bag", original)
    convert_cli.main([str(tmp_path / "desk.bag"), "--out", str(tmp_path / "h5")])
    sequence, mean = evaluate("--weights", weights, "--data", tmp_path / "h5")
    network = FireNet(base_channels=4)
    network.load_state_dict(torch.load(weights))
    grids = np.stack([expected_voxels(window, "discrete") for window in range(4)]).astype(np.float32)
    with torch.no_grad():
        predictions = network.forward_sequence(torch.from_numpy(grids)[None])[0, :, 0].double().clamp(0, 1).numpy()
    targets = original.pictures[1:] / 255
    pairs = list(zip(predictions, targets, strict=True))
    assert sequence["mse"] == pytest.approx(np.mean([(a - b) ** 2 for a, b in pairs]), abs=1e-6)
    assert sequence["ssim"] == pytest.approx(np.mean([slow_ssim(a, b, 1.0) for a, b in pairs]), abs=1e-5)
    assert sequence["ssim_range2"] == pytest.approx(np.mean([slow_ssim(a, b, 2.0) for a, b in pairs]), abs=1e-5)
    assert (sequence["sequence"], sequence["frames"], sequence["events"]) == ("desk", 4, 28)
    assert (mean["sequence"], mean["mse"], mean["voxels"]) == (None, sequence["mse"], "discrete")


def test_without_weights_the_shipped_network_is_used(tmp_path: Path) -> None:
    out = tmp_path / "records.json"
    assert cli.main(["--data", str(random_recording(tmp_path / "a.h5")), "--json", str(out)]) == 0
    sequence, _ = json.loads(out.read_text())
    assert (sequence["model"], Path(sequence["weights"]).name) == ("firenet", "firenet.pt")


def test_an_interrupt_prints_the_completed_scores(
    tmp_path: Path, weights: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("a.h5", "b.h5"):
        random_recording(tmp_path / "own" / name)
    one_by_one = evaluate_module.evaluate_sequence

    def until_the_second(run: Any, path: Path, *rest: Any) -> Any:
        if path.name == "b.h5":
            raise KeyboardInterrupt
        return one_by_one(run, path, *rest)

    monkeypatch.setattr(cli, "evaluate_sequence", until_the_second)
    assert cli.main(["--weights", str(weights), "--data", str(tmp_path / "own")]) == 130
    shown = capsys.readouterr()
    assert "scores of the completed sequences" in shown.err
    assert "constant grey" in shown.out


def test_scores_of_every_window_are_written(tmp_path: Path, weights: Path) -> None:
    data = random_recording(tmp_path / "a.h5")
    file = tmp_path / "frames.csv"
    sequence, _ = evaluate("--weights", weights, "--data", data, "--per-frame", file)
    lines = list(csv.DictReader(file.read_text(encoding="utf-8").splitlines()))
    assert [line["frame"] for line in lines] == [str(number) for number in range(5)]
    assert np.mean([float(line["mse"]) for line in lines]) == pytest.approx(sequence["mse"])
    assert sum(int(line["events"]) for line in lines) == sequence["events"]
    assert [float(line["seconds"]) for line in lines] == pytest.approx([1.02, 1.04, 1.06, 1.08, 1.1])


@pytest.mark.parametrize(
    ("flag", "value", "frames"),
    [("--window-seconds", 0.03, 3), ("--window-events", 200, 3), ("--window-pictures", 2, 2)],
)
def test_windows_need_not_end_at_pictures(tmp_path: Path, weights: Path, flag: str, value: float, frames: int) -> None:
    sequence, _ = evaluate("--weights", weights, "--data", random_recording(tmp_path / "a.h5"), flag, value)
    assert sequence["frames"] == frames
    assert sequence[flag.removeprefix("--").replace("-", "_")] == value
    assert 0 < sequence["mse"] < 1


def test_the_light_of_the_pictures_is_said_and_scored_as_asked(
    tmp_path: Path, weights: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    raw_forms.write_folder(tmp_path / "slider", raw_forms.ijrr_members(scene()))
    convert_cli.main([str(tmp_path / "slider"), "--out", str(tmp_path / "h5")])
    assert "light of the images: linear" in capsys.readouterr().out
    images = []
    for light in (None, Light.parse("linear")):
        with Recording(tmp_path / "h5" / "slider.h5", light=light) as recording:
            assert recording.stated_light == "linear"
            images.append(recording.image(recording.images[0]))
    np.testing.assert_array_equal(images[1], np.rint(255 * (images[0] / 255) ** (1 / 2.2)).astype(np.uint8))
    moved = ConvertOptions(frame_offset_ns=-1_500_000)
    times = [
        [item.t_ns for item in read_items(tmp_path / "slider", None, options) if isinstance(item, Picture)]
        for options in (ConvertOptions(), moved)
    ]
    assert [late - early for late, early in zip(*times, strict=True)] == [1_500_000] * len(times[0])
    given = ("--weights", weights, "--data", tmp_path / "h5")
    ours = evaluate(*given)
    assert "scored as stored (linear)" in capsys.readouterr().out
    other = evaluate(*given, "--light", "linear")
    assert "taken as linear, and scored as videos code them" in capsys.readouterr().out
    assert (ours[0]["light"], other[0]["light"]) == ("as stored", "linear")
    assert ours[0]["mse"] != other[0]["mse"]


@pytest.mark.parametrize(("folder", "name", "end"), [("evaid", "outdoor", 1.4), ("ijrr", "slider_depth", 2.5)])
def test_as_published_evaids_time_ranges_are_one_picture_later(
    tmp_path: Path, weights: Path, folder: str, name: str, end: float
) -> None:
    """EVAID's script keeps the picture at the end, and then drops the first one; the other scripts do neither."""
    random_recording(tmp_path / folder / f"{name}.h5", images=30, period=0.125)
    per_frame, last = tmp_path / "frames.csv", {}
    for flags in ((), ("--as-published",)):
        given = ("paper-discrete", "--weights", weights, "--data", tmp_path, "--metrics", "mse")
        evaluate(*given, "--per-frame", per_frame, *flags)
        seconds = [float(line["seconds"]) for line in csv.DictReader(per_frame.read_text().splitlines())]
        last[flags] = seconds[-1], len(seconds)
    ends, count = 1 + 0.125 * np.array([np.ceil(end / 0.125) - 1, np.ceil(end / 0.125)]), last[()][1]
    assert last[()] == (pytest.approx(ends[0]), count)
    assert last["--as-published",] == (pytest.approx(ends[int(folder == "evaid")]), count)


@pytest.mark.parametrize("name", ["a.hdf5", "a.hdf", "a"])
def test_a_single_file_is_evaluated_alone(tmp_path: Path, weights: Path, name: str) -> None:
    random_recording(tmp_path / "own" / "a.h5", images=3)
    random_recording(tmp_path / "own" / name, images=5)
    (record, _) = evaluate("--weights", weights, "--data", tmp_path / "own" / name, "--metrics", "mse")
    assert (record["sequence"], record["frames"]) == ("a", 4)


def test_names_in_brackets_are_shown(tmp_path: Path, weights: Path, capsys: pytest.CaptureFixture[str]) -> None:
    random_recording(tmp_path / "own[night]" / "walk[left].h5", images=40, events=3)
    evaluate("--weights", weights, "--data", tmp_path / "own[night]", "--metrics", "mse")
    printed = capsys.readouterr().out
    assert printed.startswith("own[night] ")
    assert printed.count("walk[left]") == 2, "in the table, and with its windows without events"


def test_data_sets_of_the_paper(tmp_path: Path, weights: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Two sequences of IJRR have time ranges, one of HQF is whole; the table has the mean and the paper's rows."""
    data = tmp_path / "data"
    random_recording(data / "ijrr" / "slider_depth.h5", images=41, period=0.1, events=3000, seed=1)
    random_recording(data / "ijrr" / "office_zigzag.h5", images=131, period=0.1, events=3000, seed=2)
    random_recording(data / "hqf" / "desk.h5", images=5, seed=3)
    records = evaluate(
        "paper-discrete",
        "--weights",
        weights,
        "--data",
        data,
        "--metrics",
        "mse,ssim_range2",
        "--out",
        tmp_path / "out",
    )
    frames = {(record["data_set"], record["sequence"]): record["frames"] for record in records}
    # The clock starts at 1 s: multiples of 0.1 are inexact.
    assert frames == {
        ("HQF", "desk"): 4,
        ("HQF", None): 4,
        ("IJRR", "office_zigzag"): pytest.approx(70, abs=1),
        ("IJRR", "slider_depth"): pytest.approx(15, abs=1),
        ("IJRR", None): frames["IJRR", "office_zigzag"] + frames["IJRR", "slider_depth"],
    }
    scores = {record["sequence"]: record["mse"] for record in records if record["data_set"] == "IJRR"}
    assert scores[None] == pytest.approx((scores["office_zigzag"] + scores["slider_depth"]) / 2, rel=1e-12)
    printed = capsys.readouterr().out
    assert "mean of 2 of 7" in printed
    assert "paper: E2VID WebVid10K" in printed
    assert "0.562" in printed
    assert "EVAID: 0 of 11 sequences scored" in printed
    assert sorted(path.relative_to(tmp_path / "out").as_posix() for path in (tmp_path / "out").rglob("*.png")) == [
        "HQF/desk.png",
        "IJRR/office_zigzag.png",
        "IJRR/slider_depth.png",
    ]


def test_pictures_and_video(tmp_path: Path, weights: Path) -> None:
    random_recording(tmp_path / "own" / "a.h5", size=(36, 41), images=6)
    evaluate("--weights", weights, "--data", tmp_path / "own", "--out", tmp_path / "out", "--rows", 2, "--video")
    picture = cv2.imread(str(tmp_path / "out" / "own" / "a.png"))
    rows = picture[TOP_PX : TOP_PX + 2 * (36 + 18), LEFT_PX : LEFT_PX + 3 * (41 + 4)]
    assert picture.shape[0] > TOP_PX + len(rows)  # headings above, a legend below
    video = cv2.VideoCapture(str(tmp_path / "out" / "own" / "a.mp4"))
    frames = []
    while (read := video.read())[0]:
        frames.append(read[1])
    assert len(frames) == 5
    assert frames[0].shape == (36 + 18, 136, 3)
    assert video.get(cv2.CAP_PROP_FPS) == pytest.approx(50, rel=0.01)
    video.release()
    # The last row of the picture is the last frame of the video, up to its compression.
    difference = rows[54:].astype(int) - frames[-1][:, :135]
    assert np.abs(difference).mean() < 20


def test_recordings_without_pictures_need_a_rate(tmp_path: Path, weights: Path) -> None:
    raw_forms.write_evt3(tmp_path / "own.raw", scene())
    convert_cli.main([str(tmp_path / "own.raw"), "--out", str(tmp_path / "h5")])
    arguments = ("--fps", 100, "--rows", 1, "--out", tmp_path)
    (record, _) = evaluate("--weights", weights, "--data", tmp_path / "h5" / "own.h5", *arguments)
    picture = cv2.imread(str(tmp_path / "own" / "own.png"))
    assert (picture[TOP_PX : TOP_PX + 24, LEFT_PX + 2 * (24 + 4) :] == 255).all()  # two panels
    assert (record["frames"], record["reconstruction_hz"]) == (3, 100)
    assert "mse" not in record


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--data", "absent"], "--data absent: no such folder"),
        (["absent.yaml", "--data", "{data}"], "no file absent.yaml"),
        (["paper-discrete", "--data", "{data}"], "--lpips alex BACKBONE HEADS"),
        (["paper-discrete", "--data", "{data}", "--metrics", "mse"], "holds no sequence of hqf/*.h5 (HQF), evaid"),
        (["--data", "{data}", "--fps", "10", "--metrics", "mse"], "--fps computes no scores"),
        (["--data", "{data}", "--fps", "10"], "--fps computes no scores: give --out DIR"),
        (["--data", "{data}", "--rows", "0", "--out", "x"], "0 rows"),
        (["--data", "{data}", "--video"], "a video needs a folder to write it to: give --out"),
        (["--data", "{data}", "--device", "gpu"], "--device gpu: PyTorch cannot compute there"),
        (["--data", "{data}", "--device", "cuda:99"], "--device cuda:99: PyTorch cannot compute there"),
        (["--data", "{data}", "--device", "meta"], "--device meta: PyTorch cannot compute there"),
        (["--data", "{data}/a.h5", "--json", "{data}/none/a.json"], "there is no folder"),
    ],
)
def test_mistakes_end_with_status_2(
    tmp_path: Path, weights: Path, arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    random_recording(tmp_path / "own" / "a.h5", images=3)
    assert cli.main(["--weights", str(weights), *(a.replace("{data}", str(tmp_path / "own")) for a in arguments)]) == 2
    assert message in capsys.readouterr().err


def test_recordings_that_cannot_be_scored_are_named_before_the_others_are_scored(
    tmp_path: Path, weights: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """One is shorter than its time range, one is no recording, and one fails while it is scored."""
    random_recording(tmp_path / "hqf" / "desk.h5")
    random_recording(tmp_path / "hqf" / "still_life.h5")
    random_recording(tmp_path / "ijrr" / "slider_depth.h5")
    (tmp_path / "ijrr" / "office_zigzag.h5").write_bytes(b"no recording")
    one_by_one, named = evaluate_module.evaluate_sequence, []

    def but_the_second(run: Any, path: Path, *rest: Any) -> Any:
        named.append(capsys.readouterr().err)
        if path.stem == "still_life":
            raise UsageError(f"{path}: not finite")
        return one_by_one(run, path, *rest)

    monkeypatch.setattr(cli, "evaluate_sequence", but_the_second)
    given = ["paper-discrete", "--weights", str(weights), "--data", str(tmp_path), "--metrics", "mse"]
    assert cli.main([*given, "--json", str(tmp_path / "scores.json")]) == 1
    assert [("slider_depth.h5 lasts" in each, "office_zigzag.h5" in each) for each in named] == [
        (True, True),
        (False, False),
    ]
    assert "v2v-eval: not scored: " in (last := capsys.readouterr().err)
    assert "still_life.h5: not finite" in last
    scored = json.loads((tmp_path / "scores.json").read_text(encoding="utf-8"))
    assert [each["sequence"] for each in scored] == ["desk", None]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((), "holds only that range, give --cuts none"),
        (("--cuts", "none", "--json", "{data}/none/a.json"), "none/a.json: there is no folder"),
    ],
)
def test_nothing_is_evaluated_if_no_recording_or_no_output_can_be(
    tmp_path: Path,
    weights: Path,
    arguments: tuple[str, ...],
    message: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    random_recording(tmp_path / "ijrr" / "slider_depth.h5")  # shorter than its time range
    evaluated = []

    def reconstruct(recording: Recording, *_rest: object, **_named: object) -> Iterator[Step]:
        evaluated.append(recording.name)
        return iter(())

    monkeypatch.setattr(evaluate_module, "reconstruct", reconstruct)
    fixed = ["paper-discrete", "--weights", str(weights), "--data", str(tmp_path), "--metrics", "mse"]
    assert cli.main([*fixed, *(argument.replace("{data}", str(tmp_path)) for argument in arguments)]) == 2
    assert message in capsys.readouterr().err
    assert not evaluated
