"""Test that the wheel works without the source tree: every command, the shipped configurations, types."""

from __future__ import annotations

import os
import subprocess
import sys
import sysconfig
import tomllib
from pathlib import Path

import pytest

from tests.clips import panned_luma, write_clip

pytestmark = pytest.mark.slow
ROOT = Path(__file__).parents[1]
COMMANDS = tuple(tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["scripts"])


def ran(*command: str | Path, cwd: Path) -> str:
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(
        [str(part) for part in command], cwd=cwd, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, f"{command}: {done.stderr}"
    return done.stdout


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the programs' folder of an environment with the wheel, which uses this environment's dependencies."""
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    tracked = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=False)
    if tracked.returncode:
        pytest.skip("not a git checkout: what belongs into a wheel is not known")
    for name in filter(None, tracked.stdout.split("\0")):
        if (ROOT / name).is_file():
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            (source / name).write_bytes((ROOT / name).read_bytes())
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    ran(*pip, "wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", folder, source, cwd=folder)
    (wheel,) = folder.glob("*.whl")
    ran(sys.executable, "-m", "venv", "--without-pip", folder / "environment", cwd=folder)
    python = folder / "environment" / "bin" / "python"
    ran(*pip, "--python", python, "install", "--no-deps", "--no-index", wheel, cwd=folder)
    (site,) = (folder / "environment" / "lib").glob("python*/site-packages")
    # Only the folder: what its own .pth files name (this tree, installed to be edited) stays unseen.
    (site / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n", encoding="utf-8")
    return python.parent


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_is_there(installed: Path, tmp_path: Path, command: str) -> None:
    assert ran(installed / command, "--help", cwd=tmp_path)


def test_packages_come_from_the_wheel_with_their_types(installed: Path, tmp_path: Path) -> None:
    packages = ("v2v_protocol", "v2v_pictures", "v2v_recordings", "v2v_server", "v2v_tools", "v2v_client", "trainer")
    script = f"import importlib; print(*(importlib.import_module(n).__path__[0] for n in {packages}), sep='\\n')"
    for path in ran(installed / "python", "-c", script, cwd=tmp_path).splitlines():
        assert Path(path).is_relative_to(installed.parent)
        assert (Path(path) / "py.typed").is_file(), path


def test_benches_are_not_installed(installed: Path, tmp_path: Path) -> None:
    script = "from importlib.util import find_spec; print(find_spec('bench'))"
    assert ran(installed / "python", "-c", script, cwd=tmp_path) == "None\n"


def test_configurations_are_shipped(installed: Path, tmp_path: Path) -> None:
    script = "from trainer.config_file import shipped; print(*shipped())"
    there = set(ran(installed / "python", "-c", script, cwd=tmp_path).split())
    assert there == {path.stem for path in (ROOT / "trainer" / "configs").glob("*.yaml")}
    assert "network" in ran(installed / "v2v-train", "tiny-cpu", "--show-config", cwd=tmp_path)


def test_a_first_picture(installed: Path, tmp_path: Path) -> None:
    write_clip(tmp_path / "clip.mp4", panned_luma(210, 160, 200))
    ran(installed / "v2v-preview", "clip.mp4", "--out", "sheet.png", cwd=tmp_path)
    assert (tmp_path / "sheet.png").read_bytes().startswith(b"\x89PNG")


def test_a_module_of_the_users_own_named_trainer(installed: Path, tmp_path: Path) -> None:
    """It comes first for the user's script, and the client and the commands do not see it."""
    (tmp_path / "trainer.py").write_text("MINE = True\n", encoding="utf-8")
    (tmp_path / "own.py").write_text("import trainer, v2v_client; print(trainer.MINE, v2v_client.V2VStreamDataset)\n")
    assert ran(installed / "python", "own.py", cwd=tmp_path).startswith("True <class")
    assert "network" in ran(installed / "v2v-train", "tiny-cpu", "--show-config", cwd=tmp_path)
