"""Mistakes that people make with the commands, and the words that each answer must contain. No mistake costs a file,
and none is answered with a traceback."""

from __future__ import annotations

import copy
import hashlib
import os
import pickle
import re
import resource
import shlex
import socket
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import nullcontext
from http.server import BaseHTTPRequestHandler, HTTPServer
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.clips import panned_luma, write_clip
from tests.test_commands import MODULES, ROOT, flags_of
from trainer.config import StreamConfig
from trainer.run.checkpoint import require_writable
from v2v_client import Batch, V2VDataset, V2VStreamDataset
from v2v_client.in_process import ShownSample
from v2v_client.options import Options
from v2v_pictures.files import write_png
from v2v_protocol.errors import ServerLost, UsageError
from v2v_protocol.events import EventList
from v2v_protocol.recipe import PRESETS, Recipe
from v2v_protocol.settings import nearest, settings_of
from v2v_protocol.spec import StreamSpec
from v2v_protocol.spec_flags import recipe_setting
from v2v_protocol.write_aside import write_json
from v2v_recordings.writers import ENDINGS, write_events
from v2v_server.config import ServeConfig
from v2v_server.corpus.catalogue import list_corpus
from v2v_server.corpus.sources.source import SourceOptions, open_source
from v2v_server.simulation.clip import simulate
from v2v_server.simulation.kernels import Voxels
from v2v_server.store.cache import make_cache
from v2v_server.video.rows import Rows

OUTPUTS = [
    ("v2v-preview a.mp4 --out a.mp4", ["--out a.mp4", "also reads"]),
    ("v2v-preview a.mp4 --out ./a.mp4", ["also reads"]),
    ("v2v-preview a.mp4 --out link.mp4", ["link.mp4", "it is a.mp4"]),
    ("v2v-preview link.mp4 --out a.mp4", ["it is link.mp4"]),
    ("v2v-preview hard.mp4 --out a.mp4", ["it is hard.mp4"]),
    ("v2v-preview clips --out clips/b.mp4", ["beside other .mp4 files"]),
    ("v2v-preview clips --out linked/b.mp4", ["beside other .mp4 files"]),
    ("v2v-preview clips/list.txt --out clips/b.mp4", ["beside other .mp4 files"]),
    ("v2v-preview clips --out clips", ["it is a folder"]),
    ("v2v-preview clips --out clips/new.mp4", ["--out clips/new.mp4", "a later run would read", "such as new.mp4"]),
    ("v2v-preview . --out sheet.png", ["it lies in .", "/sheet.png"]),
    ("v2v-preview linked --out clips/new.gif", ["it lies in linked"]),
    ("v2v-simulate clips --out s.npz --picture clips/s.png", ["it lies in clips"]),
    ("v2v-simulate clips --out s.npz --events clips/e.h5", ["--events clips/e.h5", "it lies in clips"]),
    ("v2v-catalogue --videos clips --shard 1/2 --out clips/parts", ["--out clips/parts", "such as parts"]),
    ("v2v-catalogue --videos clips --shard 1/2 --out clips", ["--out clips", "such as clips-out"]),
    ("v2v-convert clips --out clips/h5", ["it lies in clips"]),
    ("v2v-eval --data clips --out clips/pictures", ["it lies in clips"]),
    ("v2v-serve --videos clips --cache clips", ["--cache clips", "such as clips-cache"]),
    ("v2v-serve --videos linked --cache clips/cache", ["--cache clips/cache", "it lies in linked"]),
    ("v2v-train finetune-cpu --videos .", ["--out runs/finetune-cpu", "it lies in .", "films"]),
    ("v2v-train finetune-cpu --videos clips --out clips/run", ["it lies in clips"]),
    ("v2v-train finetune-cpu --set stream.videos=clips --out clips/run", ["it lies in clips"]),
    ("v2v-preview a.mp4 --out sheet.bmp", ["unknown ending", ".png"]),
    ("v2v-preview a.mp4 --out nowhere/sheet.png", ["there is no folder nowhere"]),
    ("v2v-preview a.mp4 --out locked.png", ["locked.png is write-protected"]),
    ("v2v-simulate a.mp4 --out s.npz --picture a.mp4", ["--picture a.mp4", ".png"]),
    ("v2v-simulate a.mp4 --out a.boxes.json", ["--out a.boxes.json", ".npz"]),
    ("v2v-simulate a.mp4 --out s.npz --events s.npz", ["--events s.npz", "it is s.npz"]),
    ("v2v-simulate a.mp4 --out s.npz --picture b.masks/0.png", ["name of a video's labels"]),
    ("v2v-fit e.dat --out c.yaml --picture e.dat", ["--picture e.dat", ".png"]),
    ("v2v-fit e.yaml --out e.yaml", ["it is e.yaml"]),
    ("v2v-fit e.dat --out c.txt", [".yaml"]),
    ("v2v-fit e.dat --out c.yaml --check c.yaml", ["it is c.yaml"]),
    ("v2v-tradeoff --videos clips --json a.mp4", ["--json a.mp4", ".json"]),
    ("v2v-tradeoff --videos clips --recipe c.yaml --target-rate 1 --preset-out c.yaml", ["it is c.yaml"]),
    ("v2v-tradeoff --videos clips --json clips/b.boxes.json", ["name of a video's labels"]),
    ("v2v-prepare clips store --json clips/b.boxes.json", ["name of a video's labels"]),
    ("v2v-prepare clips store --json a.mp4", ["--json a.mp4", ".json"]),
    ("v2v-prepare clips a.mp4", ["a.mp4 is a file"]),
    ("v2v-prepare clips a.mp4/store", ["a.mp4 is a file"]),
    ("v2v-prepare clips clips/store", ["overlap"]),
    ("v2v-prepare clips linked", ["overlap"]),
    ("v2v-prepare clips/list.txt clips", ["overlap"]),
    ("v2v-prepare clips run", ["holds config.yaml"]),
    ("v2v-prepare clips locked.png/store", ["locked.png is a file"]),
    ("v2v-prepare clips locked/store", ["locked is write-protected"]),
    ("v2v-quarantine --videos a.mp4 --json a.mp4", [".json"]),
    ("v2v-loadtest --videos a.mp4 --json a.mp4", [".json"]),
    ("v2v-loadtest --connect tcp://127.0.0.1:9 --json nowhere/x.json", ["there is no folder nowhere"]),
    ("v2v-convert e.dat --out h5 --json e.dat", [".json"]),
    ("v2v-convert e.dat --out e.dat", ["e.dat"]),
    ("v2v-eval --data e.h5 --per-frame e.h5", ["--per-frame e.h5", ".csv"]),
    ("v2v-eval --data e.h5 --json nowhere/x.json", ["there is no folder nowhere"]),
    ("v2v-serve --videos a.mp4 --port-file a.mp4", ["--port-file a.mp4", "it is a.mp4"]),
    ("v2v-serve --videos clips --port-file clips/b.mp4", ["--port-file", "beside other .mp4 files"]),
    ("v2v-train run/config.yaml --videos clips --out run", ["--out run", "would replace run/config.yaml"]),
]  # fmt: skip
"""Outputs that would destroy an input, or cannot be written: refused before the work."""


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    return write_clip(tmp_path_factory.mktemp("clip") / "a.mp4", panned_luma(30, 64, 64)).read_bytes()


@pytest.fixture
def desk(clip: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a clip under several names, a corpus, labels, and files of other kinds."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("V2V_CACHE_DIR", str(tmp_path / "cache"))
    (tmp_path / "a.mp4").write_bytes(clip)
    (tmp_path / "link.mp4").symlink_to("a.mp4")
    (tmp_path / "hard.mp4").hardlink_to("a.mp4")
    for folder in ("clips", "b.masks", "run", "locked"):
        (tmp_path / folder).mkdir()
    (tmp_path / "linked").symlink_to("clips")
    for name in ("b", "c"):
        (tmp_path / "clips" / f"{name}.mp4").write_bytes((tmp_path / "a.mp4").read_bytes())
    (tmp_path / "clips" / "b.boxes.json").write_text("{}")
    (tmp_path / "clips" / "list.txt").write_text("b.mp4 0.2 0.2\n")
    for name in ("e.dat", "e.h5", "e.yaml", "c.yaml", "locked.png", "b.masks/0.png"):
        (tmp_path / name).write_text("precious: 1\n")
    (tmp_path / "run" / "config.yaml").write_text("network: {name: firenet}  # a comment\n")
    (tmp_path / "locked.png").chmod(0o444)
    return tmp_path


def contents(folder: Path) -> dict[str, str]:
    """Digests of all files below a folder, without the cache."""
    files = (path for path in folder.rglob("*") if path.is_file() and "cache" not in path.parts)
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def answer(line: str, capsys: pytest.CaptureFixture[str]) -> str:
    """Run a command line in this process; return its error, after checking that it is one line with status 2."""
    program, *given = shlex.split(line)
    status = import_module(MODULES[program]).main(given)
    said = capsys.readouterr().err
    assert status == 2, said
    assert "Traceback" not in said
    assert len(said.strip().splitlines()) == 1, said
    return said


@pytest.mark.parametrize(("line", "words"), OUTPUTS, ids=[line for line, _ in OUTPUTS])
def test_an_output_never_destroys_an_input(
    line: str, words: list[str], desk: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    # Root may write anywhere, so the check itself is asked.
    access = import_module("os").access
    monkeypatch.setattr("os.access", lambda path, how, **_: Path(path).stem != "locked" and access(path, how))
    monkeypatch.setattr("v2v_server.commands.prepare.open_catalogue", None)  # the destination is checked before it
    before = contents(desk)
    said = answer(line, capsys)
    assert [word for word in words if word not in said] == [], said
    assert contents(desk) == before


def _events(path: Path) -> None:
    rng, count = np.random.default_rng(1), 20_000
    x, y = rng.integers(0, 64, (2, count)).astype(np.uint16)
    write_events(path, EventList(x, y, np.sort(rng.integers(0, 10**6, count)), rng.random(count) < 0.5, 64, 64))


def _noise(path: Path) -> None:
    write_png(path, np.random.default_rng(1).integers(0, 255, (99, 99, 3), np.uint8))


OLDER = b"\x89PNG\r\n\x1a\nthe older file"
WRITERS: dict[str, Callable[[Path], None]] = {
    ".png": _noise,
    ".json": lambda path: write_json(path, [{"key": "x" * 5000}]),
    **dict.fromkeys(ENDINGS, _events),
}


@pytest.mark.parametrize("ending", WRITERS)
def test_a_full_disk_leaves_the_older_file(ending: str, tmp_path: Path) -> None:
    path, limits = tmp_path / f"old{ending}", resource.getrlimit(resource.RLIMIT_FSIZE)
    path.write_bytes(OLDER)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, limits[1]))
    try:
        with pytest.raises(UsageError, match=path.name):
            WRITERS[ending](path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert path.read_bytes() == OLDER
    assert [each.name for each in tmp_path.iterdir()] == [path.name]


def test_outputs_replace_older_ones_and_follow_links(tmp_path: Path) -> None:
    (tmp_path / "named.json").symlink_to("target.json")
    for text in ("a", "b"):
        write_json(tmp_path / "named.json", [{"key": text}])
    assert (tmp_path / "named.json").is_symlink()
    assert '"b"' in (tmp_path / "target.json").read_text()


NO_PICTURES = [
    "a.mp4",
    "clips",
    "x.py",
    "x",
    "x.gif",
    "x.jpg",
    "e.h5",
    "c.yaml",
    "e.png",
    "link.png",
    "b.masks/1.png.txt",
]


@pytest.mark.parametrize("name", NO_PICTURES)
def test_a_picture_replaces_only_a_picture(name: str, desk: Path) -> None:
    (desk / "e.png").write_text("precious: 1\n")
    (desk / "link.png").symlink_to("a.mp4")
    before = contents(desk)
    with pytest.raises(UsageError, match=name):
        _noise(Path(name))
    assert contents(desk) == before


def test_a_picture_replaces_a_picture(tmp_path: Path) -> None:
    (tmp_path / "empty.png").touch()
    for name in ("new.PNG", "new.PNG", "empty.png"):
        _noise(tmp_path / name)
        assert (tmp_path / name).stat().st_size > 1000


def test_a_catalogue_passes_over_folders_of_outputs(desk: Path) -> None:
    clip = (desk / "a.mp4").read_bytes()
    make_cache(desk / "clips" / "cache")
    require_writable(desk / "clips" / "runs" / "one")
    require_writable(desk / "clips")  # not made here: it stays a corpus
    before = list_corpus(open_source("clips", SourceOptions()), Rows.parse("full"), print).ids
    for folder in ("cache", "runs/one/films"):
        (desk / "clips" / folder).mkdir(exist_ok=True)
        (desk / "clips" / folder / "film.mp4").write_bytes(clip)
    corpus = list_corpus(open_source("clips", SourceOptions()), Rows.parse("full"), print)
    assert corpus.ids == before == ("b.mp4", "c.mp4")
    assert corpus.left_out.startswith("2 folders that a v2v command wrote were passed over: cache/, runs/one/.")
    assert list_corpus(open_source("clips/cache", SourceOptions()), Rows.parse("full"), print).ids == ("film.mp4",)


WRONG = [
    # what a command does not take, and the flag that it means
    ("v2v-serve clips", "--videos clips"),
    ("v2v-loadtest clips", "--videos clips"),
    ("v2v-doctor clips", "--videos clips"),
    ("v2v-tradeoff clips --json x.json", "--videos clips"),
    ("v2v-train clips", "v2v-train NAME --videos clips"),
    ("v2v-train finetune --videos clips", "did you mean 'finetune-cpu'"),
    ("v2v-train e2vd --videos clips", "did you mean 'e2vid'"),
    ("v2v-train etnet --videos clips --set loss.lpips_weight=0 --set loss.flow=stream", "--set stream.list= for"),
    ("v2v-preview a.mp4 --output x.png", "did you mean '--out'"),
    ("v2v-preview --videos clips --out x.png", "without a flag"),
    ("v2v-simulate --video a.mp4 --out x.npz", "without a flag"),
    # recipes, presets and stream settings in each other's place
    ("v2v-preview a.mp4 --out x.png --set crop=64", "'crop_height_px' or 'crop_width_px'"),
    ("v2v-preview a.mp4 --out x.png --set substep_px=1", "--substep-px 1 instead of --set"),
    ("v2v-simulate a.mp4 --out x.npz --set scene=auto", "--scene auto instead of --set"),
    ("v2v-serve --videos clips --set flow_from=1", "--flow-from 1 instead of --set"),
    ("v2v-loadtest --connect tcp://127.0.0.1:9 --set flow_from=1", "--flow-from 1 instead of --set"),
    ("v2v-serve --videos clips --tolerance 0.1", "'0.1': give 0, or leave it out: it left effects out of clips"),
    ("v2v-serve --videos clips --set tolerance=0.1", "tolerance = 0.1: give 0, or leave it out"),
    ("v2v-tradeoff --videos clips --vary tolerance=0.01", "tolerance = 0.01: give 0, or leave it out"),
    ("v2v-fit --check paper --set substep_px=1", "--substep-px 1 instead of --set"),
    ("v2v-tradeoff --videos clips --set shuffle=false", "a setting of the stream"),
    ("v2v-serve --videos clips --preset davis346", "--recipe davis346"),
    ("v2v-preview a.mp4 --out x.png --preset c.yaml", "--recipe c.yaml"),
    ("v2v-serve --videos clips --preset natual", "did you mean 'natural'"),
    ("v2v-serve --videos clips --recipe natural", "--preset natural"),
    ("v2v-preview a.mp4 --out x.png --recipe davis346-runing", "did you mean 'davis346-running'"),
    ("v2v-preview a.mp4 --out x.png --recipe none.yaml", "none.yaml: No such file"),
    ("v2v-serve --videos clips --set bins", "write KEY=VALUE"),
    ("v2v-serve --videos clips --set bins=0", "from 1 to 1024"),
    ("v2v-preview a.mp4 --out x.png --scene on", "choose one of off, auto"),
    # videos
    ("v2v-preview nowhere.mp4 --out x.png", "nowhere.mp4"),
    ("v2v-preview e.dat --out x.png", "e.dat"),
    ("v2v-serve --videos run --bind tcp://127.0.0.1:*", "run"),
    ("v2v-preview a.mp4 --out x.png --rows top:2", "0 <= top < bottom <= 1"),
    ("v2v-simulate a.mp4 --out x.npz --arrays voxel", "voxels"),
    ("v2v-simulate a.mp4 --out x.npz", "voxels_per_clip at most 5"),
    # words of other commands, tools and libraries
    ("v2v-preview a.mp4 --out x.png --lr 1", "(v2v-train --set optimizer.learning_rate=X)"),
    ("v2v-preview --input a.mp4 --out x.png", "(give the input without a flag)"),
    ("v2v-serve --input clips", "did you mean '--videos'"),
    ("v2v-serve --videos clips --port 5555", "did you mean '--bind'"),
    ("v2v-serve --videos clips --seed 3", "the consumer chooses it: V2VStreamDataset(..., seed=N)"),
    ("v2v-serve --videos clips --batch-size 3", "the consumer chooses it: V2VStreamDataset(..., batch_size=N)"),
    ("v2v-serve --videos clips --device cuda", "v2v-train --set compute.device=cuda"),
    ("v2v-loadtest --videos clips --host x", "did you mean '--connect'"),
    ("v2v-serve --videos clips --num-workers 3", "did you mean '--workers'"),
    ("v2v-train finetune-cpu --videos clips --batch-size 3", "v2v-train --set stream.batch_size=N"),
    ("v2v-train finetune-cpu --videos clips --lr 3", "v2v-train --set optimizer.learning_rate=X"),
    ("v2v-simulate a.mp4 --out x.npz --dvs-h5 e.h5", "did you mean '--events'"),
    ("v2v-simulate a.mp4 --output-folder x", "did you mean '--out'"),
    ("v2v-simulate a.mp4 --out x.npz --pos-thres .2", "it belongs to the recipe, --set threshold=..."),
    ("v2v-serve --videos clips --threshold .2", "it belongs to the recipe, --set threshold=..."),
    ("v2v-preview a.mp4 --out x.png --cutoff-hz 30", "--set photoreceptor_hz=..."),
    ("v2v-preview a.mp4 --out x.png --set pos_thres=.2", "did you mean 'threshold'"),
    ("v2v-preview a.mp4 --out x.png --set leak_rate_hz=1", "did you mean 'leak_hz'"),
    # flags without effect, and a space in place of a sign
    ("v2v-serve --videos clips --cache-gib 3", "--cache-gib has no effect without --cache DIR; give both, or neither"),
    ("v2v-serve --videos clips --keep-defects bars", "--keep-defects has no effect without --scene auto"),
    ("v2v-preview a.mp4 --out x.png --keep-defects bars", "--keep-defects has no effect without --scene auto"),
    ("v2v-simulate a.mp4 --out x.npz --keep-defects bars", "--keep-defects has no effect without --scene auto"),
    ("v2v-serve --videos clips --page-host 127.0.0.1", "--page-host has no effect without --page"),
    ("v2v-serve --videos clips --page-names a", "--page-names has no effect without --page"),
    ("v2v-serve --videos clips --scale-seconds 9", "--scale-seconds has no effect without --workers LEAST:MOST"),
    ("v2v-serve --videos clips --ray-label a=b", "--ray-label has no effect without --engine ray"),
    ("v2v-serve --videos clips --photograph-seconds 3", "has no effect without --videos-kind photographs"),
    ("v2v-serve --videos clips --workers 0", "--worker-bind tcp://HOST:5556"),
    ("v2v-preview a.mp4 --out x.png --set bins 3", "--set bins 3: write --set bins=3"),
    ("v2v-preview a.mp4 --out x.png --set bins = 3", "write --set bins=3"),
    ("v2v-preview a.mp4 --out x.png --set bins =3", "write --set bins=3"),
    ("v2v-preview a.mp4 --out x.png --set bins=3 gamma=2", "--set bins=3 gamma=2: write --set bins=3 --set gamma=2;"),
    ("v2v-serve --videos clips --rows top 0.54", "--rows top 0.54: write --rows top:0.54, without a space"),
    ("v2v-simulate a.mp4 --out x.npz --arrays voxels flow", "write --arrays voxels,flow"),
    ("v2v-simulate a.mp4 --out x.npz --arrays voxels, flow", "write --arrays voxels,flow"),
    # numbers and addresses
    ("v2v-serve --videos clips --workers many", "give a whole number"),
    ("v2v-serve --videos clips --bind 127.0.0.1:5555", "tcp://HOST:PORT"),
    ("v2v-serve --videos clips --bind tcp://0.0.0.0:5555", "--insecure"),
    ("v2v-loadtest --connect 127.0.0.1:5555", "tcp://"),
    ("v2v-fit", "RECORDING"),
    ("v2v-fit e.dat --out c.yaml --set bins=3", "--set needs --check"),
    ("v2v-eval --data nowhere", "no such folder"),
    ("v2v-convert nowhere --out h5", "nowhere"),
]  # fmt: skip
"""Words that a command does not know, each with what the answer must name."""


@pytest.mark.parametrize(("line", "word"), WRONG, ids=[line for line, _ in WRONG])
def test_an_answer_names_what_to_type(line: str, word: str, desk: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = contents(desk)
    said = answer(line, capsys)
    assert word in said
    assert contents(desk) == before


NO_HINT = ["--lr", "--xyz", "--put", "--q", "--frobnicate", "--ten", "--a", "--", "zz", "abc", ""]


@pytest.mark.parametrize("word", NO_HINT)
def test_nothing_is_suggested_rather_than_nonsense(word: str) -> None:
    known = ["--help", "--out", "--videos", "--debug", "--version", "--set", "--recipe", "--page"]
    assert "did you mean" not in nearest(word, known)


IN_PYTHON: list[tuple[Callable[[], object], str]] = [
    (lambda: dataset()[0], r"dataset\[0\]: a stream has no index; .* V2VDataset makes samples by index"),
    (lambda: dataset().load_state_dict("last.pt"), r"'last.pt', .* Batch.resume_state itself"),  # type: ignore[arg-type]
    (lambda: dataset().load_state_dict({"network": {}}), r"version None, expected version \d+. Give the saved"),
    (lambda: dataset(workers=3), r"V2VStreamDataset.local\(..., workers=N\)"),
    (lambda: dataset(num_workers=3), r"DataLoader\(dataset, ..., num_workers=N\)"),
    (lambda: dataset(videos="clips"), r"V2VStreamDataset.local\(videos\) starts a server"),
    (lambda: dataset(pin_memory=True), r"DataLoader\(..., pin_memory=True\)"),
    (lambda: dataset(recipe={"pos_thres": 0.2}), r"did you mean 'threshold'"),
    (lambda: dataset(recipe={"contrast_threshold": 0.2}), r"did you mean 'threshold'"),
    (lambda: dataset(bins=3), r"no argument 'bins': it belongs to the recipe, recipe={'bins': ...}"),
    (lambda: dataset(substep=1), r"did you mean 'substep_px'"),
    (lambda: dataset(recipe={"substep_px": 1}), r"give substep_px=1 beside the recipe"),
    (lambda: dataset(recipe={"crop": 64}), r"did you mean 'crop_height_px' or 'crop_width_px'"),
    (lambda: dataset(recipe="none.yaml"), r"none.yaml: No such file"),
    (lambda: dataset(recipe="natural"), r"--preset natural"),
    (lambda: dataset(preset="paper"), r"unknown preset 'paper'"),
    (lambda: dataset(arrays="voxel"), r"voxels"),
    (lambda: batch().voxel, r"a Batch has no 'voxel' \(did you mean 'voxels'\?\)"),
    (lambda: batch()["frame"], r"this batch has voxels"),
    (lambda: simulated(pos_thres=0.2), r"'pos_thres' \(did you mean 'threshold_pos'\?\)"),
    (lambda: simulated(cn=0.2), r"'cn' \(did you mean 'threshold_neg'\?\)"),
    (lambda: simulated(threshold=0.2), r"'threshold' \(did you mean 'threshold_pos'\?\)"),
    (lambda: simulated(frobnicate=1), r"'frobnicate'; known: .*leak_hz"),
    (lambda: dataset(voxel_dtype=np.int8), r"voxel_dtype = .*int8.*: choose one of int8, int16"),
    (lambda: V2VStreamDataset(5555), r"address 5555: give tcp://host:port"),  # type: ignore[arg-type]
    (lambda: V2VStreamDataset(None), r"address None: give tcp://host:port"),  # type: ignore[arg-type]
    (lambda: V2VDataset(["a.mp4"]), r"videos = \['a.mp4'\]: give one folder"),  # type: ignore[arg-type]
    (lambda: V2VDataset("clips", batch_size=2), r"DataLoader\(V2VDataset\(...\), batch_size=N\)"),
    (lambda: V2VStreamDataset.local(None), r"videos = None: give one folder"),  # type: ignore[arg-type]
    (lambda: sample().to("cpu"), r"a Sample has no 'to'; its arrays are NumPy's: torch.from_numpy"),
    (lambda: sample().cuda(), r"a Sample has no 'cuda'; its arrays are NumPy's"),
    (lambda: batch().cuda(), r"a Batch has no 'cuda'; write .to"),
    (lambda: batch().flow, r"create the dataset with arrays=\('voxels', 'flow'\)"),
    (lambda: batch().to("float32"), r"batch.to\('float32'\): give a device, such as .*, or torch.float32"),
    (lambda: batch().to(np.float32), r"give a device, such as .*, or torch.float32"),  # type: ignore[arg-type]
    (lambda: batch().to("gpu"), r"batch.to\('gpu'\): give a device, such as .*, or a torch.dtype"),
    (lambda: V2VStreamDataset.local("clips", rate=25), r'flag of v2v-serve: flags=\["--rate", "..."\]; known: videos'),
    (lambda: V2VStreamDataset.local("clips", cache_gib=3), r'flags=\["--cache-gib", "..."\]'),
    (lambda: V2VStreamDataset.local("clips", port=5555), r'flags=\["--bind", "..."\]'),
    (lambda: V2VStreamDataset.local("clips", videos_kind="sequences"), r'flags=\["--videos-kind", "..."\]'),
    (lambda: V2VStreamDataset.local("clips", threads=3), r"did you mean 'workers'"),
    (lambda: V2VStreamDataset.local("clips", bins=3), r"it belongs to the recipe, recipe={'bins': ...}; known"),
]


def dataset(**options: Any) -> V2VStreamDataset:
    return V2VStreamDataset("tcp://127.0.0.1:9", **options)


def simulated(**arguments: Any) -> Voxels:
    return simulate(np.zeros((11, 8, 8), np.uint8), threshold_pos=0.2, **arguments)


def sample() -> ShownSample:
    return ShownSample({"voxels": np.zeros((1, 1, 2, 2), np.int8)}, None, Recipe(), "")  # type: ignore[arg-type]


def batch() -> Batch:
    return Batch({"voxels": torch.zeros(1, 1, 1, 2, 2)}, (0,), 0, (), {}, 0.0, 0.0, 1, Recipe())


@pytest.mark.parametrize("number", range(len(IN_PYTHON)))
def test_mistakes_in_python_are_named(number: int) -> None:
    mistake, words = IN_PYTHON[number]
    with pytest.raises((UsageError, AttributeError, KeyError), match=words):
        mistake()


UNUSUAL = [
    ({"threshold_pos": 20}, "threshold_pos = 20: real cameras have 0.01 to 5 log units. An event would need"),
    ({"threshold_neg": 20}, "threshold_neg = 20: real cameras have 0.01 to 5 log units"),
    (
        {"noise_sigma": 5},
        "noise_sigma = 5: real cameras have 0 to 1 log units. Noise would make .* Divide percent by 100",
    ),
    ({"leak_hz": 1000.0, "frames_per_second": 25}, "leak_hz = 1000: real cameras have"),
    ({"refractory_seconds": 1, "frames_per_second": 25}, "refractory_seconds = 1: .* Divide milliseconds by 1000"),
    ({"gamma": 0.1}, "gamma = 0.1: real cameras have"),
    ({"log_eps": 1e-9}, "log_eps = 1e-09: .* fire at the least change"),
    ({"noise_sigma": 0.5, "gamma": 1.0, "log_eps": 0.1, "hot_pixel_count": 1, "hot_pixel_sigma": 3}, None),
]


@pytest.mark.parametrize(("arguments", "words"), UNUSUAL, ids=str)
def test_a_simulation_warns_of_values_that_no_camera_has(
    arguments: dict[str, Any], words: str | None, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("v2v_protocol.recipe._WARNED", set())
    for _ in range(2):
        simulate(np.zeros((11, 8, 8), np.uint8), **{"threshold_pos": 0.2} | arguments)
    assert len(caplog.messages) == (words is not None)
    assert all(re.match(f"warning: {words}", said) for said in caplog.messages)


def test_numbers_of_any_library_are_numbers_and_a_dtype_may_come_alone() -> None:
    frames = np.random.default_rng(0).integers(0, 255, (11, 8, 8), np.uint8)
    plain, *others = (simulate(frames, threshold_pos=each) for each in (0.25, torch.tensor(0.25), np.float32(0.25)))
    for other in others:
        np.testing.assert_array_equal(other.array("voxels"), plain.array("voxels"))
    assert batch().to(dtype=torch.float16).voxels.dtype == torch.float16


def test_a_batch_is_copied_and_pickled_although_it_names_unknown_attributes() -> None:
    for made in (copy.copy(batch()), pickle.loads(pickle.dumps(batch()))):
        assert made.voxels.shape == (1, 1, 1, 2, 2)


def test_a_recipe_file_is_a_recipe_by_name_everywhere(tmp_path: Path) -> None:
    file = tmp_path / "my.yaml"
    file.write_text("preset: davis346\nbins: 3\n")
    expected = PRESETS["davis346"].replace(bins=3)
    asked = Options(("voxels",), recipe=str(file)).spec(None, "")["recipe"]
    assert StreamSpec.from_dict({"recipe": asked}).recipe == expected
    assert recipe_setting(str(file), []) == StreamConfig(recipe=str(file)).resolved_recipe == expected
    assert ServeConfig.load(None, {"videos": "x", "recipe": str(file)}).spec.recipe == expected


COMMANDS_OF_SAMPLES = ("v2v-serve", "v2v-preview", "v2v-simulate", "v2v-loadtest")


@pytest.mark.parametrize("program", COMMANDS_OF_SAMPLES)
def test_all_commands_that_make_samples_take_the_flags_of_the_stream(program: str) -> None:
    flags = {"--preset", "--recipe", "--set", *(f"--{name.replace('_', '-')}" for name in settings_of(StreamSpec))}
    assert flags <= flags_of(program)


@pytest.mark.parametrize(
    ("scheme", "words"),
    [
        ("tcp://127.0.0.1:{unused}", "nothing listens there"),
        ("tcp://no-such-host.invalid:5555", "host name cannot be resolved"),
        ("tcp://127.0.0.1:{page}", "another program listens there, or the server's page"),
    ],
)
def test_an_address_without_a_server_is_explained_in_the_log_and_in_the_error(
    scheme: str, words: str, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch, unused_port: int
) -> None:
    monkeypatch.setattr("v2v_client.connection._REPORT_SECONDS", 0.2)
    with HTTPServer(("127.0.0.1", 0), BaseHTTPRequestHandler) as page:
        threading.Thread(target=page.serve_forever, args=(0.01,), daemon=True).start()
        address = scheme.format(unused=unused_port, page=page.server_port)
        with pytest.raises(ServerLost, match=words):
            next(iter(V2VStreamDataset(address, timeout_seconds=0.6)))
        page.shutdown()
    (reported,) = caplog.messages
    assert words in reported


@pytest.mark.slow
@pytest.mark.parametrize("command", ["script.py", "-", "-i"])
def test_a_script_needs_no_main_guard_the_first_time_either(desk: Path, command: str) -> None:
    """A file, standard input, and an interactive session."""
    small = {"voxels_per_clip": 4, "crop_height_px": 16, "crop_width_px": 16}
    made = "V2VDataset('clips', cache_dir='new cache', recipe=small)"
    script = f"from v2v_client import V2VDataset\nsmall = {small}\nprint(repr({made}))\n"
    (desk / "script.py").write_text(script)
    done = subprocess.run(
        [sys.executable, command],
        cwd=desk,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        input="" if command == "script.py" else script,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert re.fullmatch(r"V2VDataset\('clips', \d+ samples, seed 0, epoch 0\)\n", done.stdout), done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        ("--bind tcp://127.0.0.1:{taken}", "--bind tcp://127.0.0.1:{taken}: Address already in use; give another port"),
        ("--bind tcp://127.0.0.1:* --page {taken}", "--page {taken} at 127.0.0.1: Address already in use"),
        ("--bind tcp://127.0.0.1:* --keys nowhere", "v2v-keys init"),
        ("--bind tcp://127.0.0.1:* --cache a.mp4", "--cache"),
        ("--bind tcp://192.0.2.1:5555 --insecure", "give an address of this host"),
    ],
)
def test_a_server_checks_its_addresses_and_folders_before_the_videos(
    flags: str, words: str, desk: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("v2v_server.serve.load_catalogue", lambda _: pytest.fail("the videos were catalogued"))
    monkeypatch.setattr("v2v_server.commands.serve.start_ahead", lambda _: nullcontext([]))
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        said = answer(f"v2v-serve --videos clips {flags.format(taken=port)}", capsys)
    assert words.format(taken=port) in said
