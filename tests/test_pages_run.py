"""The command lines of README and guides run as they stand there, in a folder where the names that they use are
names of real clips. What is added to them only makes them smaller."""

from __future__ import annotations

import re
import shlex
import signal
import subprocess
import sys
import tarfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from bench.processes import free_ports
from tests.clips import panned_luma, write_panned
from tests.test_commands import MODULES, ROOT
from v2v_recordings.items import EventChunk, Picture
from v2v_recordings.layout_writer import RecordingWriter
from v2v_server.prepare_recordings import convert_recordings

VIDEOS = ("my.mp4", "VIDEO", "bigbuckbunny.mp4")
FOLDERS = ("smaller", "DIR", "CLIPS", "CORPUS", "webvid10k", "my-videos", "clips")
PAGES = [ROOT / "README.md", *sorted(ROOT.glob("docs/*.md")), *sorted(ROOT.glob("docs/guides/*.md"))]
SMALLER = {
    "v2v-preview": ["--seeds", "1", "--set", "voxels_per_clip=4"],
    "v2v-serve": ["--workers", "1", "--bind", "tcp://127.0.0.1:*", "--port-file", "port"],
    "v2v-train": ["--workers", "1", "--set", "stream.batch_size=1"],
    "v2v-prepare": ["--workers", "1"],
    "v2v-doctor": ["--port", str(free_ports(1)[0])],
    "v2v-simulate": ["--index", "0", "--quarantine", "0"],
    "v2v-tradeoff": ["--clips", "1", "--forms", "lossless fast"],
}
CANNOT = {
    r"^v2v-fit ": "recordings that may not be redistributed; tests/v2v_tools/fit fits simulated ones",
    r"^v2v-(serve|tradeoff) .*my_camera": "a recipe that v2v-fit writes",
    r"^v2v-convert ": "recordings that may not be redistributed",
    r"^v2v-eval ": "weights and recordings that may not be redistributed; the trainer's tests use synthetic ones",
    r"^v2v-train (e2vid |export |firenet-cpu|my\.yaml )": "weights of LPIPS, a finished training, a file of one's own",
    r"^v2v-serve .*--page": "a port that may be in use; tests of the page start it on a free one",
    r"^v2v-serve .*s3://": "another owner's bucket; tests/stream/test_object_storage.py starts it on its own",
}
"""Reasons why command lines cannot run in this test, by pattern."""
_BLOCK = re.compile(r"(?:^(?: {4}.*)?\n)+", re.M)
_COMMAND = re.compile(r"^ {4}(v2v-[a-z]+ .*)$", re.M)
_NAMES = re.compile(rf"(?<= )({'|'.join(map(re.escape, (*VIDEOS, *FOLDERS)))})/?(?= |$)")
_ASIDE = re.compile(r" --workers \d+| +#.*")
_INLINE = re.compile(r"`(v2v-[a-z]+ [^`]*--out [^`]*)`")


def blocks(page: Path) -> list[list[str]]:
    """The command lines of each code block of a page, and those in a sentence or a table that write a file, each by
    itself. What `uvx` installs first is left out."""
    text = re.sub(r" *\\\n\s*", " ", page.read_text(encoding="utf-8"))
    text = re.sub(r"uvx --from '\S+' ", "", text)
    in_blocks = [found for block in _BLOCK.findall(text) if (found := _COMMAND.findall(block))]
    return in_blocks + [[line] for line in _INLINE.findall(text)]


def can_run(line: str) -> bool:
    return not any(re.search(pattern, line) for pattern in CANNOT)


def distinct_blocks() -> Iterator[Any]:
    """Each block with a line that no block before it has. Folders and videos are the same under any name, and numbers
    of workers are; remarks do not count."""
    seen: set[str] = set()
    for page in PAGES:
        for block in blocks(page):
            lines = [line for line in block if can_run(line)]
            plain = [_ASIDE.sub("", line) for line in lines]
            kinds = {_NAMES.sub(lambda name: "VIDEO" if name[0] in VIDEOS else "DIR", line) for line in plain}
            if not kinds <= seen:
                yield pytest.param(lines, id=f"{page.stem}: {block[0][:40].strip()}")
            seen |= kinds


def test_there_are_commands_of_each_kind() -> None:
    lines = [line for page in PAGES for block in blocks(page) for line in block]
    assert len(lines) > 25
    for pattern in CANNOT:
        assert any(re.search(pattern, line) for line in lines), pattern
    ran = {line.split()[0] for line in lines if can_run(line)}
    assert ran >= {"v2v-serve", "v2v-preview", "v2v-simulate", "v2v-prepare", "v2v-train", "v2v-doctor"}


@pytest.fixture(scope="module")
def clips(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two clips, long and large enough for the paper's recipe, in WebVid's upper rows too."""
    return write_panned(tmp_path_factory.mktemp("clips"), 2, 203, 256, 256)


@pytest.mark.slow
@pytest.mark.parametrize("lines", list(distinct_blocks()))
def test_documented_commands_run(
    lines: list[str], clips: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name, value in {"PYTHONPATH": str(ROOT), "V2V_CACHE_DIR": str(tmp_path / "cache")}.items():
        monkeypatch.setenv(name, value)
    for name in VIDEOS:
        (tmp_path / name).symlink_to(clips / "0.mp4")
    for name in FOLDERS:
        (tmp_path / name).symlink_to(clips)
    if any("REDS" in line for line in lines):
        pictures = tmp_path / "REDS" / "train_sharp" / "000"
        pictures.mkdir(parents=True)
        for number, luma in enumerate(panned_luma(203, 128, 128)):
            Image.fromarray(luma).save(pictures / f"{number:08d}.png")
    if any("openvid/" in line for line in lines):
        (tmp_path / "openvid" / "train").mkdir(parents=True)
        with tarfile.open(tmp_path / "openvid" / "train" / "00000.tar", "w") as archive:
            archive.add(clips, "clips")
    if any("--videos-kind recordings" in line for line in lines):
        at = np.arange(9000)
        (tmp_path / "raw").mkdir()
        with RecordingWriter(tmp_path / "raw/a.h5", source="test") as writer:
            writer.add(EventChunk(1_000_000 * at, at % 128, at % 127, at % 2 == 0))
            for number, luma in enumerate(panned_luma(45, 128, 128)):
                writer.add(Picture(200_000_000 * number, luma))
        if not any("v2v-prepare" in line for line in lines):
            made = convert_recordings(tmp_path / "raw", tmp_path / "recordings", 1)
            assert not any(each.problem for each in made)
    if any("photographs/" in line for line in lines):
        (tmp_path / "photographs").mkdir()
        Image.fromarray(panned_luma(1, 256, 256)[0]).save(tmp_path / "photographs/a.jpg")
    for line in lines:
        program, *given = shlex.split(line, comments=True)
        smaller = SMALLER.get(program, [])
        if "--whole" in given:  # it has other flags, and the clips are small
            smaller = []
        if "--count" in given:
            smaller = [*smaller, "--count", "2"]
        if given[:1] == ["data"]:  # it trains nothing
            smaller = []
        elif program == "v2v-train":
            smaller = [*smaller, "--set", "run.steps=2"]
        if "--cache" in given:
            smaller = [*smaller, "--cache", "decoded"]
        command = [sys.executable, "-m", MODULES[program], *given, *smaller]
        status, said = served(command) if program == "v2v-serve" else finished(command)
        assert status == 0, f"{line}\n{said}"


def finished(command: list[str]) -> tuple[int, str]:
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=500)
    return done.returncode, done.stdout + done.stderr


def served(command: list[str]) -> tuple[int, str]:
    """Starts a server, waits until it is ready, and ends it as Ctrl-C does."""
    said, port = Path("said"), Path("port")
    with said.open("w") as out, subprocess.Popen(command, stdout=out, stderr=out) as process:
        try:
            deadline = time.monotonic() + 120
            while not port.exists() and process.poll() is None and time.monotonic() < deadline:
                time.sleep(0.05)
            ready = port.exists()
            process.send_signal(signal.SIGINT)
            status = process.wait(60)
        finally:
            process.kill()
    port.unlink(missing_ok=True)
    return (0 if ready and status in (0, 130) else 1), said.read_text()
