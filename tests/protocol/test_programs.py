"""The installed programs: each is there, and one whose packages are missing says which."""

from __future__ import annotations

import runpy
import sys
import tomllib
from pathlib import Path

import pytest

from v2v_protocol import programs

SCRIPTS = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text("utf-8"))["project"]["scripts"]


@pytest.mark.parametrize("name", sorted(SCRIPTS))
def test_every_program_is_there_and_says_what_it_does(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    module, function = SCRIPTS[name].split(":")
    assert module == programs.__name__
    monkeypatch.setattr(sys, "argv", [name, "--help"])
    try:
        status = getattr(programs, function)()
    except SystemExit as end:
        status = end.code
    assert not status
    assert name in capsys.readouterr().out


@pytest.mark.parametrize(("package", "said"), [("h5py", "h5py"), ("torch.utils.tensorboard", "torch")])
def test_a_missing_package_is_named(
    package: str, said: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def load(module: str) -> None:
        raise ModuleNotFoundError(f"No module named {package!r}", name=package)

    monkeypatch.setattr(programs, "import_module", load)
    assert programs.convert() == 2
    line = capsys.readouterr().err
    assert line.startswith(f"v2v-convert: needs the Python package {said}, ")
    assert "pip install '.[convert]'" in line


def test_a_local_server_without_its_packages_says_so_too(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def load(module: str) -> None:
        raise ModuleNotFoundError("No module named 'av'", name="av")

    monkeypatch.setattr(programs, "import_module", load)
    monkeypatch.setattr(sys, "argv", ["v2v_server", "--help"])
    with pytest.raises(SystemExit) as ended:
        runpy.run_module("v2v_server", run_name="__main__")
    assert ended.value.code == 2  # that of wrong usage, which LocalServer quotes
    assert "v2v-serve: needs the Python package av, " in capsys.readouterr().err


def test_a_module_of_ours_that_is_missing_is_a_defect(monkeypatch: pytest.MonkeyPatch) -> None:
    def load(module: str) -> None:
        raise ModuleNotFoundError("No module named 'v2v_server.nowhere'", name="v2v_server.nowhere")

    monkeypatch.setattr(programs, "import_module", load)
    with pytest.raises(ModuleNotFoundError):
        programs.serve()
