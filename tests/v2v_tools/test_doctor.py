"""`v2v-doctor` finds problems, says what to change, and reports them in its exit status."""

from __future__ import annotations

import math
import re
import socket
import subprocess
import sys
from contextlib import closing
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest

from bench.processes import free_ports
from tests.clips import damaged, panned_luma, truncated, write_clip
from v2v_protocol.programs import install_line
from v2v_protocol.recipe import Recipe
from v2v_server.corpus.catalogue import open_catalogue
from v2v_server.corpus.scenes import picture_check
from v2v_server.corpus.scenes.picture_check import COMBED, DUPLICATES, defects_of_video
from v2v_server.motion.measure import measure
from v2v_tools.doctor import command
from v2v_tools.doctor import corpus as doctor_corpus
from v2v_tools.doctor import motion as doctor_motion
from v2v_tools.doctor.command import BAD, NOTE, OK, Finding
from v2v_tools.motion import describe_motion


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a process that loads torch, or processes that decode, and whatever this machine's memory is."""
    for module in (picture_check, doctor_motion):
        monkeypatch.setattr(module, "usable_cores", lambda: 0)
    monkeypatch.setattr(command, "_torch", lambda: Finding(OK, "torch", "here"))
    monkeypatch.setattr(command, "_memory", lambda: Finding(OK, "memory", "enough"))


def told(capsys: pytest.CaptureFixture[str], *flags: str) -> tuple[int, str]:
    status = command.main(("--port", str(free_ports(1)[0]), *flags))
    return status, capsys.readouterr().out


def test_nothing_is_in_the_way_where_tests_run(capsys: pytest.CaptureFixture[str]) -> None:
    status, said = told(capsys)
    assert status == 0
    assert "is free" in said
    assert ", libx264\n" in said
    assert f"\n{BAD} " not in said
    assert said.endswith("no problems found\n")


def test_a_port_that_is_taken_is_worth_a_note(capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket() as taker:
        taker.bind(("127.0.0.1", 0))
        taker.listen()
        status, said = told(capsys, "--port", str(taker.getsockname()[1]))
    assert status == 0
    assert "cannot be taken" in said
    assert "--bind tcp://127.0.0.1:" in said


def test_a_corpus_is_looked_at(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_clip(tmp_path / "long.mp4", panned_luma(21, 140, 160))
    for number in range(7):
        write_clip(tmp_path / f"short{number}.mp4", panned_luma(12, 140, 160))
    truncated(tmp_path / "short0.mp4", tmp_path / "cut.mp4", 0.5)
    (tmp_path / "broken.mp4").write_bytes(b"no video")
    (tmp_path / "long.boxes.txt").write_text("1,1,10,10,20,20,1,1,1\n3,1,10,10,20,20,1,1,1\n3,2,50,50,20,20,1,1,1\n")
    recipe = tmp_path / "recipe.yaml"
    recipe.write_text("voxels_per_clip: 4\n")
    flags = ["--videos", str(tmp_path), "--cache-dir", str(tmp_path), "--recipe", str(recipe)]
    status, said = told(capsys, *flags)
    assert status == 0
    for each in (
        "8 videos: 8 h264; 105 frames that decode",
        "2 files cannot be used: broken.mp4",
        "cut.mp4: is truncated: ",
        "voxels_per_clip=2 admits",
        "1 sample an epoch",
        "1 of 1 sidecars .boxes.txt can be read: 2 frames have labels, 3 boxes",
    ):
        assert each in said
    (line,) = (line for line in said.splitlines() if "7 videos give no sequence" in line)
    assert all(f"short{number}.mp4" in line for number in range(7))
    recipe.write_text("voxels_per_clip: 5\n")
    status, said = told(capsys, *flags)
    assert status == 1
    assert "\nbad   corpus        8 videos give no sequence" in said


def test_videos_that_take_more_memory_than_a_worker_has_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_clip(tmp_path / "small.mp4", panned_luma(21, 140, 160))
    write_clip(tmp_path / "large.mp4", panned_luma(21, 600, 800))
    write_clip(tmp_path / "short.mp4", panned_luma(3, 600, 800))
    recipe = tmp_path / "recipe.yaml"
    recipe.write_text("voxels_per_clip: 4\nresize_scale: [0.9, 1.0]\n")
    flags = ["--videos", str(tmp_path), "--cache-dir", str(tmp_path), "--recipe", str(recipe)]
    for limit_mib, named in ((1024, None), (270, "large.mp4"), (200, "large.mp4; small.mp4")):
        monkeypatch.setattr(doctor_corpus, "memory_limit", lambda limit=limit_mib << 20: limit)
        status, said = told(capsys, *flags)
        found = re.search(
            r"samples of \d videos need up to 0.29 GB of memory, a worker of this host may use .*: (.*)", said
        )
        assert (status, None if found is None else found[1]) == (int(named is not None), named)


def test_a_corpus_that_is_not_there_is_in_the_way(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, said = told(capsys, "--videos", str(tmp_path / "nowhere"))
    assert status == 1
    assert "there is no such folder" in said


def pretend(monkeypatch: pytest.MonkeyPatch, found: dict[str, str | None]) -> None:
    version = metadata.version

    def pretended(name: str) -> str:
        if name in found and found[name] is None:
            raise metadata.PackageNotFoundError(name)
        return str(found.get(name) or version(name))

    monkeypatch.setattr(command.metadata, "version", pretended)


def test_what_is_missing_or_too_old_is_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pretend(monkeypatch, {"av": None, "pyzmq": "25.9"})
    assert {"av<19,>=18", "pyzmq>=26"} == set(command._missing("server"))
    assert {"av<19,>=18", "pyzmq>=26"} == set(command._missing("trainer"))  # one of its own, one of the client's
    status, said = told(capsys, "--videos", ".")
    assert status == 1  # neither part is whole
    assert install_line("server") in said


def test_opencv_without_contrib_serves_too(monkeypatch: pytest.MonkeyPatch) -> None:
    here = metadata.version("opencv-contrib-python-headless")
    pretend(monkeypatch, {"opencv-contrib-python-headless": None, "opencv-python-headless": here})
    assert command._missing("server") == []
    pretend(monkeypatch, {"opencv-contrib-python-headless": None, "opencv-python-headless": "4.5"})
    assert command._missing("server") == ["opencv-contrib-python-headless>=4.10"]


def test_a_server_without_torch_is_whole(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    pretend(monkeypatch, {"torch": None})
    monkeypatch.setattr(command, "_torch", lambda: Finding(BAD, "torch", "was loaded"))
    status, said = told(capsys)
    assert status == 0
    assert "torch" not in said
    assert "no problems found" in said


@pytest.mark.parametrize(
    ("longest", "said", "admits"),
    [
        ((), "", ""),
        ((1, 15), "leave the short ones out", ""),
        ((1, 30), "leave the short ones out", "voxels_per_clip=20 admits some"),
        ((30, 35), "leave them out", "voxels_per_clip=30 admits all"),
    ],
)
def test_short_clips_are_not_advised_without_their_cost(longest: tuple[int, ...], said: str, admits: str) -> None:
    remedy = doctor_corpus._remedy(longest, 40)
    assert said in remedy
    assert admits in remedy
    assert ("admits" in remedy) == bool(admits)
    assert "voxels_per_clip=1 " not in remedy
    assert not remedy or "recurrent network" in remedy


def test_a_gpu_that_torch_does_not_see_is_in_the_way(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    done = subprocess.CompletedProcess([], 0, stdout='warning\n["2.9+cpu", []]\n')
    monkeypatch.setattr(subprocess, "run", lambda *_, **__: done)
    monkeypatch.setattr(command, "_cards", lambda: "NVIDIA H100")
    assert command._torch().level == BAD
    monkeypatch.setattr(command, "_cards", lambda: "")
    assert command._torch().level == NOTE
    done.stdout = '["2.9", ["NVIDIA H100"]]\n'
    assert command._torch().level == OK
    done.stdout = ""
    assert command._torch().level == BAD


def test_it_starts_where_nothing_else_is_installed() -> None:
    """It has to say so there: what it imports at its start is the standard library, numpy and msgpack."""
    others = ("av", "zmq", "numba", "cv2", "yaml", "rich", "torch", "psutil")
    program = f"import sys, v2v_tools.doctor.command\nprint(*sorted(set({others!r}) & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


def test_how_videos_are_stored_is_said_where_it_matters(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_clip(tmp_path / "plain.mp4", panned_luma(60, 140, 160))
    write_clip(tmp_path / "raw.h264", panned_luma(60, 140, 160), b_frames=2)
    (tmp_path / "recipe.yaml").write_text("voxels_per_clip: 4\n")
    flags = ["--videos", str(tmp_path), "--cache-dir", str(tmp_path), "--recipe", str(tmp_path / "recipe.yaml")]
    status, said = told(capsys, *flags)
    assert status == 0
    assert "1 video has no time stamps that name their frames (raw.h264)" in said
    assert "run v2v-prepare once" in said


def test_defects_of_pictures_are_said_with_what_can_be_done(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    moving = panned_luma(60, 140, 160)
    boxed = moving.copy()
    boxed[:, :14] = boxed[:, -28:] = boxed[:, :, :10] = 0
    cut = np.concatenate((moving[:30], 255 - np.flip(moving[30:], (1, 2))))
    frozen = moving[np.minimum(np.arange(60), 30)]
    black = moving.copy()
    black[20:40] = 0
    films = {"boxed": boxed, "cut": cut, "twos": moving[np.arange(60) // 2], "frozen": frozen, "black": black}
    for name, luma in films.items():
        write_clip(tmp_path / f"{name}.mp4", luma, full_range=True)
    (tmp_path / "recipe.yaml").write_text("voxels_per_clip: 4\n")
    flags = ["--videos", str(tmp_path), "--cache-dir", str(tmp_path), "--recipe", str(tmp_path / "recipe.yaml")]
    status, said = told(capsys, *flags)
    assert status == 0
    for each in (
        "looked at 5 of 5 videos, at most 8 s and 400 frames of each: 10 sequences\n",
        "2 of 10 sequences (20%) have bars at the sides of the picture (boxed.mp4: 100% of the frames have",
        "bars: top 14 px, bottom 28 px, left 10 px)",
        "bars make no events: v2v-serve --scene auto leaves them out of the picture",
        "2 of 10 sequences (20%) have duplicated frames (twos.mp4: ",
        "every picture twice",
        "have hard cuts or jumps (",
        "cut.mp4: hard cuts or jumps: 1",
        "(10%) have still stretches (frozen.mp4",
        "have black stretches (black.mp4",
    ):
        assert each in said
    assert "no problems found" not in said
    status, said = told(capsys, "--videos", str(tmp_path / "boxed.mp4"), *flags[2:], "--rows", "0.1:0.8")
    assert "have bars at the sides of the picture (boxed.mp4: 100% of the frames have bars: left 10 px" in said


def test_what_moves_is_measured_and_the_command_that_tells_the_error_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_clip(tmp_path / "slow.mp4", panned_luma(21, 140, 160, step=(0, 0)))
    flags = ["--videos", str(tmp_path), "--cache-dir", str(tmp_path)]
    _, said = told(capsys, *flags)
    assert re.search(r"\nok    motion        0 px a frame .*; 33 frames in the middle of 1 video\n(?! +->)", said)
    write_clip(tmp_path / "fast.mp4", panned_luma(21, 140, 160, step=(3, 4)))
    _, said = told(capsys, *flags)
    assert re.search(
        r"\nnote  motion        5 px a frame .*, 0% of it turns back .* 2 videos\n +-> v2v-tradeoff ", said
    )


@pytest.mark.parametrize(
    ("rates", "settings", "said"),
    [
        ([25, 25, 50, math.nan], {}, "(25 to 50 frames/s): a voxel grid lasts 0.1 to 0.2 s; --set voxel_seconds=0.2 "),
        ([24, 60], {"frames_per_bin": 2}, "lasts 0.17 to 0.42 s; --set voxel_seconds=0.29 --set frames_per_bin=1 "),
        ([25, 26, 24, math.nan], {}, ""),
        ([25] * 40 + [50] * 2, {}, ""),
        ([24, 60], {"voxel_seconds": 0.1}, ""),
        ([24, 60], {"grids_per_frame": 2}, ""),
        ([math.nan, math.inf], {}, ""),
    ],
)
def test_mixed_frame_rates_are_said_with_the_duration_to_ask_for(
    rates: list[float], settings: dict[str, float], said: str
) -> None:
    lines = list(doctor_corpus._rates(np.array(rates, np.float64), Recipe.from_dict(settings)))
    assert len(lines) == bool(said)
    assert all(said in f"{text}; {change}" for _, _, text, change in lines)


@pytest.mark.slow
@pytest.mark.parametrize("processes", [0, 2])
def test_a_video_that_does_not_decode_is_counted(
    processes: int, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(picture_check, "usable_cores", lambda: processes)
    write_clip(tmp_path / "good.mp4", panned_luma(60, 140, 160))
    damaged(tmp_path / "good.mp4", tmp_path / "spoiled.mp4", 30)
    _, said = told(capsys, "--videos", str(tmp_path), "--cache-dir", str(tmp_path))
    assert "looked at 1 of 2 videos" in said
    assert "1 more did not decode" in said


@pytest.mark.parametrize("kind", ["twos", "combed"])
def test_preview_and_doctor_agree_on_what_changes(
    kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    moving = panned_luma(120, 140, 160, step=(0, 3))
    woven = moving[::2].copy()
    woven[:, 1::2] = moving[1::2, 1::2]
    luma = {"twos": moving[np.arange(60) // 2], "combed": woven}[kind]
    (tmp_path / "videos").mkdir()
    write_clip(tmp_path / "videos" / "clip.mkv", luma, codec="ffv1", pixel_format="gray", full_range=True)
    _, said = told(capsys, "--videos", str(tmp_path / "videos"), "--cache-dir", str(tmp_path))
    with closing(open_catalogue(tmp_path / "videos", cache_dir=tmp_path / "index", processes=0)) as catalogue:
        defects = defects_of_video(catalogue, "clip.mkv")
    text, _ = describe_motion(measure(luma), defects)
    assert "flicker" not in text
    change = picture_check.CHANGES[DUPLICATES if kind == "twos" else COMBED]
    assert text.startswith("changes that motion does not explain: ")
    assert change in text
    assert change in said
