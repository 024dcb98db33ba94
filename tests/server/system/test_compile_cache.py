"""Where compiled kernels are kept, and that a kernel never outlives what it was made of."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from importlib.metadata import PackageNotFoundError
from pathlib import Path

import pytest

from v2v_server.system import compile_cache
from v2v_server.system.compile_cache import choose_compile_cache, sources_digest

ROOT = Path(__file__).parents[3]
NAME = f"numba-{sources_digest()}"


def run(code: str, folder: Path = ROOT) -> str:
    """Return what the program prints in a fresh interpreter without a chosen folder."""
    environment = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, env=environment, cwd=folder, capture_output=True, text=True, check=True)
    return done.stdout.strip()


@pytest.fixture
def read_only_code(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The folder of the sources cannot be written. Permissions would not keep the superuser out; a file does."""
    (tmp_path / "simulation").mkdir()
    (tmp_path / "simulation" / "__pycache__").write_text("in the way")
    monkeypatch.setattr(compile_cache, "SOURCES", tmp_path / "simulation")


def test_what_the_user_says_counts() -> None:
    environment = {"NUMBA_CACHE_DIR": "/somewhere", "V2V_CACHE_DIR": "/else"}
    choose_compile_cache(environment)
    assert environment == {"NUMBA_CACHE_DIR": "/somewhere", "V2V_CACHE_DIR": "/else"}


@pytest.mark.parametrize("parents_choice", [{}, {"NUMBA_CACHE_DIR": "/of/older/sources/numba-0123456789ab"}])
def test_beside_the_code_where_that_can_be_written(
    parents_choice: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(compile_cache, "SOURCES", tmp_path / "simulation")
    (tmp_path / "simulation").mkdir()
    environment = parents_choice | {"V2V_CACHE_DIR": str(tmp_path / "cache")}
    choose_compile_cache(environment)
    assert environment["NUMBA_CACHE_DIR"] == str(tmp_path / "simulation" / "__pycache__" / NAME)
    assert not (tmp_path / "cache").exists()


@pytest.mark.usefixtures("read_only_code")
def test_where_the_code_cannot_be_written_the_cache_folder_is_taken(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(compile_cache, "sources_digest", lambda: "0123456789ab")
    environment = {"XDG_CACHE_HOME": "/else", "V2V_CACHE_DIR": str(tmp_path / "ours")}
    choose_compile_cache(environment)
    assert environment["NUMBA_CACHE_DIR"] == str(tmp_path / "ours" / "numba-0123456789ab")
    environment = {"XDG_CACHE_HOME": str(tmp_path / "user")}
    choose_compile_cache(environment)
    assert environment["NUMBA_CACHE_DIR"] == str(tmp_path / "user" / "v2v" / "numba-0123456789ab")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    environment = {}
    choose_compile_cache(environment)
    assert environment["NUMBA_CACHE_DIR"] == str(tmp_path / "home" / ".cache" / "v2v" / "numba-0123456789ab")
    assert Path(environment["NUMBA_CACHE_DIR"]).is_dir()


@pytest.mark.usefixtures("read_only_code")
def test_the_temporary_folder_is_used_only_if_other_users_cannot_write_to_it(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(compile_cache.tempfile, "gettempdir", lambda: str(tmp_path))
    (tmp_path / "file").write_text("in the way")
    nothing_else = {"XDG_CACHE_HOME": str(tmp_path / "file")}
    ours = tmp_path / f"v2v-{os.getuid()}"

    environment = nothing_else.copy()
    choose_compile_cache(environment)
    assert Path(environment["NUMBA_CACHE_DIR"]).parent == ours
    assert ours.stat().st_mode & 0o777 == 0o700

    ours.chmod(0o777)
    environment = nothing_else.copy()
    choose_compile_cache(environment)
    assert environment == nothing_else

    ours.rename(tmp_path / "elsewhere")
    (tmp_path / "elsewhere").chmod(0o700)
    ours.symlink_to(tmp_path / "elsewhere")
    environment = nothing_else | {"NUMBA_CACHE_DIR": "/of/older/sources/numba-0123456789ab"}
    choose_compile_cache(environment)
    assert environment == nothing_else


def test_the_server_can_be_imported_without_numba(monkeypatch: pytest.MonkeyPatch) -> None:
    def version(package: str) -> str:
        raise PackageNotFoundError(package)

    monkeypatch.setattr(compile_cache, "version", version)
    environment: dict[str, str] = {}
    choose_compile_cache(environment)
    assert not environment


def test_every_source_counts(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "a.py").write_text("A = 1")
    (tmp_path / "b.py").write_text("B = 1")
    seen = [sources_digest(tmp_path)]
    (tmp_path / "b.py").write_text("B = 2")
    seen.append(sources_digest(tmp_path))
    (tmp_path / "b.py").rename(tmp_path / "c.py")
    seen.append(sources_digest(tmp_path))
    (tmp_path / "d.py").write_text("")
    seen.append(sources_digest(tmp_path))
    monkeypatch.setattr(compile_cache, "version", lambda package: "0.0")
    seen.append(sources_digest(tmp_path))
    assert len(set(seen)) == 5
    # And nothing else does: neither what Python and numba leave there, nor when a file was written.
    (tmp_path / "__pycache__").mkdir()
    (tmp_path / "__pycache__" / "a.pyc").write_text("")
    os.utime(tmp_path / "a.py", (0, 0))
    assert sources_digest(tmp_path) == seen[-1]


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


@pytest.mark.slow
def test_a_change_of_one_module_reaches_the_kernels_of_another(tmp_path: Path) -> None:
    leave = shutil.ignore_patterns("__pycache__")
    for package in ("v2v_protocol", "v2v_server"):
        shutil.copytree(ROOT / package, tmp_path / package, ignore=leave)
    code = (
        "import numpy as np\n"
        "from v2v_server.simulation import noise, pixel\n"
        f"import sys; sys.path.append({str(ROOT)!r})\n"
        "from tests.oracles.noise import words\n"
        "key, counters = (1, 2, 3, 4), np.arange(5)\n"
        "compiled = pixel.words(key, noise.START, counters)\n"
        "np.testing.assert_array_equal(compiled, words(key, noise.START, counters))\n"
        "print(pixel.words.stats.cache_path, sum(pixel.words.stats.cache_hits.values()), *compiled)\n"
    )
    before = run(code, tmp_path).split()
    assert before[0].startswith(str(tmp_path))
    assert run(code, tmp_path).split() == [before[0], "1", *before[2:]]
    file = tmp_path / "v2v_server" / "simulation" / "noise.py"
    text = file.read_text(encoding="utf-8")
    file.write_text(text.replace("0x9E3779B9", "0x9E3779BB"), encoding="utf-8")
    after = run(code, tmp_path).split()
    assert after[2:] != before[2:]
