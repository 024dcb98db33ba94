"""Check the image of the server by what it installs: an environment made by the lines of its Dockerfile serves."""

from __future__ import annotations

import json
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from tests.clips import write_panned
from tests.stream.conftest import SMALL, SMALL_FLAGS
from tests.waiting import until
from v2v_client import V2VStreamDataset

ROOT = Path(__file__).parents[1]
DEPLOY = ROOT / "deploy"


def instructions(name: str, kind: str) -> list[str]:
    """Return what follows each instruction of a kind in a Dockerfile."""
    return re.findall(rf"^{kind} (.*)$", (DEPLOY / name).read_text(), re.M)


def test_both_images_have_the_packages_of_the_wheel() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    for name in ("Dockerfile", "trainer.Dockerfile"):
        copied = {part for line in instructions(name, "COPY") for part in line.split()[:-1]}
        assert {path.parent.name for path in ROOT.glob("*/py.typed")} <= copied
        assert all((ROOT / each).exists() for each in copied)
        (extras,) = re.findall(r"'\.\[(\S+)\]'", " ".join(instructions(name, "RUN")))
        assert set(extras.split(",")) <= set(project["project"]["optional-dependencies"])


@pytest.mark.slow
def test_what_the_image_of_the_server_installs_starts_and_serves(compiled: None, tmp_path: Path) -> None:
    image, clips = tmp_path / "image", tmp_path / "clips"
    image.mkdir()
    for line in instructions("Dockerfile", "COPY"):
        *names, target = line.split()
        for name in names:
            if (ROOT / name).is_dir():
                shutil.copytree(ROOT / name, image / target, ignore=shutil.ignore_patterns("__pycache__"))
            else:
                shutil.copy(ROOT / name, image / target)
    subprocess.run([sys.executable, "-m", "venv", tmp_path / "environment"], check=True)
    programs = tmp_path / "environment" / "bin"
    (install,) = [line for line in instructions("Dockerfile", "RUN") if line.startswith("pip install")]
    done = subprocess.run(
        [programs / "python", "-m", *shlex.split(install)], cwd=image, capture_output=True, text=True, check=False
    )
    if "No matching distribution found" in done.stderr:
        pytest.skip("no package index can be reached")
    assert done.returncode == 0, done.stderr
    write_panned(clips, 2, 61, 48, 64)
    (entry,) = instructions("Dockerfile", "ENTRYPOINT")
    program, *flags = [text.replace("0.0.0.0:5555", "127.0.0.1:*") for text in re.findall(r'"([^"]*)"', entry)]
    flags[flags.index("--videos") + 1] = str(clips)
    port = tmp_path / "port"
    command = [programs / program, *flags, "--workers", "1", "--page", "--port-file", str(port), *SMALL_FLAGS]
    command += ["--cache-dir", str(tmp_path)]
    with subprocess.Popen(command, cwd=tmp_path, stdin=subprocess.DEVNULL) as server:
        try:
            until(lambda: server.poll() is not None or (port.exists() and port.read_text().strip()))
            assert server.poll() is None
            stream = V2VStreamDataset(port.read_text().strip(), 1, recipe=SMALL, timeout_seconds=300.0, insecure=True)
            with stream:
                assert next(iter(stream)).indices
            (line,) = instructions("Dockerfile", "HEALTHCHECK")
            check = json.loads(line[line.index("[") :].replace("5555", port.read_text().rpartition(":")[2].strip()))
            healthy = [programs / check[0], *check[1:]]
            subprocess.run(healthy, check=True)
        finally:
            server.terminate()
    assert server.returncode == -15 or server.returncode == 0
    assert subprocess.run(healthy, capture_output=True, check=False).returncode == 1
