"""Mistakes that people make with the commands, and the words that each answer must contain. No mistake costs a file,
and none is answered with a traceback."""

from __future__ import annotations

import hashlib
import resource
import shlex
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

from tests.clips import panned_luma, write_clip
from tests.test_commands import MODULES
from v2v_pictures.files import write_png
from v2v_protocol.errors import UsageError
from v2v_protocol.events import EventList
from v2v_protocol.records import write_json
from v2v_server.offline.event_files import FORMS, write_events

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
    ("v2v-tradeoff --videos clips --plot a.mp4", ["--plot a.mp4", ".png"]),
    ("v2v-tradeoff --videos clips --recipe c.yaml --target-rate 1 --preset-out c.yaml", ["it is c.yaml"]),
    ("v2v-tradeoff --videos clips --json clips/b.boxes.json", ["name of a video's labels"]),
    ("v2v-prepare clips store --json clips/b.boxes.json", ["name of a video's labels"]),
    ("v2v-prepare clips store --json a.mp4", ["--json a.mp4", ".json"]),
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


@pytest.fixture
def desk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a clip under several names, a corpus, labels, and files of other kinds."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("V2V_CACHE_DIR", str(tmp_path / "cache"))
    write_clip(tmp_path / "a.mp4", panned_luma(30, 64, 64))
    (tmp_path / "link.mp4").symlink_to("a.mp4")
    (tmp_path / "hard.mp4").hardlink_to("a.mp4")
    for folder in ("clips", "b.masks", "run"):
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
    monkeypatch.setattr("os.access", lambda path, how: Path(path).name != "locked.png" and access(path, how))
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


WRITERS: dict[str, Callable[[Path], None]] = {
    ".png": _noise,
    ".json": lambda path: write_json(path, [{"key": "x" * 5000}]),
    **dict.fromkeys(FORMS, _events),
}


@pytest.mark.parametrize("ending", WRITERS)
def test_a_full_disk_leaves_the_older_file(ending: str, tmp_path: Path) -> None:
    path, limits = tmp_path / f"old{ending}", resource.getrlimit(resource.RLIMIT_FSIZE)
    path.write_bytes(b"the older file")
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, limits[1]))
    try:
        with pytest.raises(UsageError, match=path.name):
            WRITERS[ending](path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert path.read_bytes() == b"the older file"
    assert [each.name for each in tmp_path.iterdir()] == [path.name]


def test_outputs_replace_older_ones_and_follow_links(tmp_path: Path) -> None:
    (tmp_path / "named.json").symlink_to("target.json")
    for text in ("a", "b"):
        write_json(tmp_path / "named.json", [{"key": text}])
    assert (tmp_path / "named.json").is_symlink()
    assert '"b"' in (tmp_path / "target.json").read_text()
