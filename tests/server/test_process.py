"""Where compiled kernels are kept."""

from __future__ import annotations

from pathlib import Path

import pytest

from v2v_server import process
from v2v_server.process import choose_compile_cache


def test_what_the_user_says_counts() -> None:
    environment = {"NUMBA_CACHE_DIR": "/somewhere", "V2V_CACHE_DIR": "/else"}
    choose_compile_cache(environment)
    assert environment["NUMBA_CACHE_DIR"] == "/somewhere"


def test_beside_the_code_where_that_can_be_written() -> None:
    environment = {"V2V_CACHE_DIR": "/else"}
    choose_compile_cache(environment)
    assert environment == {"V2V_CACHE_DIR": "/else"}


def test_where_the_code_cannot_be_written_the_cache_folder_is_taken(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    allowed = str(tmp_path)
    monkeypatch.setattr(process.os, "access", lambda path, mode: str(path).startswith(allowed))
    environment = {"XDG_CACHE_HOME": "/else", "V2V_CACHE_DIR": allowed}
    choose_compile_cache(environment)
    assert environment["NUMBA_CACHE_DIR"] == str(tmp_path / "numba")
    environment = {"XDG_CACHE_HOME": allowed}
    choose_compile_cache(environment)
    assert environment["NUMBA_CACHE_DIR"] == str(tmp_path / "v2v" / "numba")
    # Nothing of the user's can be written either: the folder for temporary files.
    (tmp_path / "file").write_text("in the way")
    environment = {"XDG_CACHE_HOME": str(tmp_path / "file")}
    choose_compile_cache(environment)
    assert Path(environment["NUMBA_CACHE_DIR"]).name == "v2v-numba"
