"""Where compiled kernels are kept, and that none outlives what it was made of; and that OpenCV loads with its use."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from importlib.metadata import PackageNotFoundError
from pathlib import Path

import cv2 as real
import pytest

from v2v_server import flow as methods
from v2v_server.system import compile_cache
from v2v_server.system.compile_cache import choose_compile_cache, cv2, sources_digest

ROOT = Path(__file__).parents[3]
NAME = f"numba-{sources_digest()}"


def run(code: str, folder: Path = ROOT) -> str:
    """Return what the program prints in a fresh interpreter without a chosen folder."""
    environment = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, env=environment, cwd=folder, capture_output=True, text=True, check=True)
    return done.stdout.strip()


def chosen(environment: dict[str, str]) -> dict[str, str]:
    """Return the environment after the choice."""
    changed = environment.copy()
    choose_compile_cache(changed)
    return changed


@pytest.fixture
def read_only_code(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The folder of the sources cannot be written. Permissions would not keep the superuser out; a file does."""
    (tmp_path / "simulation").mkdir()
    (tmp_path / "simulation" / "__pycache__").write_text("in the way")
    monkeypatch.setattr(compile_cache, "SOURCES", tmp_path / "simulation")


def test_what_the_user_says_counts() -> None:
    environment = {"NUMBA_CACHE_DIR": "/somewhere", "V2V_CACHE_DIR": "/else"}
    assert chosen(environment) == environment


@pytest.mark.parametrize("parents_choice", [{}, {"NUMBA_CACHE_DIR": "/of/older/sources/numba-0123456789ab"}])
def test_beside_the_code_where_that_can_be_written(
    parents_choice: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(compile_cache, "SOURCES", tmp_path / "simulation")
    (tmp_path / "simulation").mkdir()
    environment = chosen(parents_choice | {"V2V_CACHE_DIR": str(tmp_path / "cache")})
    assert environment["NUMBA_CACHE_DIR"] == str(tmp_path / "simulation" / "__pycache__" / NAME)
    assert not (tmp_path / "cache").exists()


@pytest.mark.usefixtures("read_only_code")
def test_where_the_code_cannot_be_written_the_cache_folder_is_taken(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(compile_cache, "sources_digest", lambda: "0123456789ab")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    for environment, folder in (
        ({"XDG_CACHE_HOME": "/else", "V2V_CACHE_DIR": str(tmp_path / "ours")}, "ours"),
        ({"XDG_CACHE_HOME": str(tmp_path / "user")}, "user/v2v"),
        ({}, "home/.cache/v2v"),
    ):
        expected = tmp_path / folder / "numba-0123456789ab"
        assert chosen(environment)["NUMBA_CACHE_DIR"] == str(expected)
        assert expected.is_dir()


@pytest.mark.usefixtures("read_only_code")
def test_the_temporary_folder_is_used_only_if_other_users_cannot_write_to_it(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(compile_cache.tempfile, "gettempdir", lambda: str(tmp_path))
    (tmp_path / "file").write_text("in the way")
    nothing_else = {"XDG_CACHE_HOME": str(tmp_path / "file")}
    ours = tmp_path / f"v2v-{os.getuid()}"

    assert Path(chosen(nothing_else)["NUMBA_CACHE_DIR"]).parent == ours
    assert ours.stat().st_mode & 0o777 == 0o700

    ours.chmod(0o777)
    assert chosen(nothing_else) == nothing_else

    ours.rename(tmp_path / "elsewhere")
    (tmp_path / "elsewhere").chmod(0o700)
    ours.symlink_to(tmp_path / "elsewhere")
    assert chosen(nothing_else | {"NUMBA_CACHE_DIR": "/of/older/sources/numba-0123456789ab"}) == nothing_else


def test_the_server_can_be_imported_without_numba(monkeypatch: pytest.MonkeyPatch) -> None:
    def version(package: str) -> str:
        raise PackageNotFoundError(package)

    monkeypatch.setattr(compile_cache, "version", version)
    assert chosen({}) == {}


def test_every_source_counts(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def digest(**sources: str) -> str:
        folder = Path(tempfile.mkdtemp(dir=tmp_path))
        (folder / "__pycache__").mkdir()
        (folder / "__pycache__" / f"{folder.name}.pyc").touch()
        for name, text in sources.items():
            (folder / f"{name}.py").write_text(text)
        return sources_digest(folder)

    before = digest(a="A = 1", b="B = 1")
    seen = {before, digest(a="A = 1", b="B = 2"), digest(a="A = 1", c="B = 1"), digest(a="A = 1", b="B = 1", c="")}
    # And nothing else does: neither what Python and numba leave there, nor where and when a file was written.
    assert digest(a="A = 1", b="B = 1") == before
    monkeypatch.setattr(compile_cache, "version", lambda package: "0.0")
    assert len(seen | {digest(a="A = 1", b="B = 1")}) == 5


def test_the_processor_counts(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(compile_cache, "PROCESSORS", tmp_path / "cpuinfo")
    own = "processor\t: 0\nmodel\t\t: 1\ncpu MHz\t\t: 2445.4\nflags\t\t: fpu avx2\n"

    def seen(text: str) -> str:
        (tmp_path / "cpuinfo").write_text(text)
        return sources_digest()

    unknown = sources_digest()
    assert len({unknown, seen(own), seen(own.replace("avx2", "avx2 avx512f")), seen(own.replace(": 1", ": 2"))}) == 4
    # And nothing else does: neither how fast it runs, nor how many there are.
    assert seen(own.replace("2445.4", "1497.0") + "\nprocessor\t: 1\nmodel\t\t: 1\n") == seen(own)


@pytest.mark.parametrize("first", ["v2v_server", "numba"])
def test_numba_stores_the_kernels_there_in_any_import_order(first: str) -> None:
    code = f"import {first}; from v2v_server.simulation.pixel import words; print(words.stats.cache_path)"
    chosen = os.environ | {"NUMBA_CACHE_DIR": ""}
    choose_compile_cache(chosen)
    assert str(Path(run(code)).parent) == chosen["NUMBA_CACHE_DIR"]


# --- OpenCV -----------------------------------------------------------------------------------------------------------


def test_it_is_opencv() -> None:
    assert cv2.resize is real.resize
    assert cv2.ximgproc is real.ximgproc
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        cv2.nonsense  # type: ignore[attr-defined]  # noqa: B018


def test_presets_have_opencvs_numbers() -> None:
    assert methods.DIS_ULTRAFAST == real.DISOPTICAL_FLOW_PRESET_ULTRAFAST
    assert methods.DIS_FAST == real.DISOPTICAL_FLOW_PRESET_FAST


def test_a_worker_loads_it_with_its_first_use() -> None:
    is_loaded = "print('cv2' in sys.modules)"
    use = "import numpy as np; from v2v_server.flow import choose; choose(*np.zeros((2, 32, 32), np.uint8))"
    said = run(f"import sys; import v2v_server.worker.process; {is_loaded}; {use}; {is_loaded}")
    assert said.split() == ["False", "True"]
