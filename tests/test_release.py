"""Test how a release is built: links that lead out of the tree, archives with equal bytes, one version everywhere."""

from __future__ import annotations

import io
import re
import runpy
import tarfile
import tomllib
from pathlib import Path

import yaml

from v2v_protocol import __version__

ROOT = Path(__file__).parents[1]
RELEASE = runpy.run_path(str(ROOT / "deploy" / "release.py"))


def test_links_of_the_readme_lead_into_the_repository() -> None:
    text = RELEASE["with_addresses"]((ROOT / "README.md").read_text("utf-8"), "https://a.example/x", "1.2.3")
    links = re.findall(r"\]\(([^)]*)\)", text)
    assert len(links) > 20
    assert [link for link in links if not link.startswith(("https://", "#"))] == []
    assert "https://a.example/x/raw/v1.2.3/docs/pictures/preview.gif" in links
    assert "https://a.example/x/blob/v1.2.3/docs/reliability.md#chaos" in links


def test_a_picture_that_is_a_link_keeps_both_addresses() -> None:
    text = RELEASE["with_addresses"]("[![a [b] c](a.png)](b.md) [c](#d)", "R", "1")
    assert text == "[![a [b] c](R/raw/v1/a.png)](R/blob/v1/b.md) [c](#d)"


def test_addresses_are_a_table_of_the_project() -> None:
    named = tomllib.loads(RELEASE["urls"]("https://a.example/x", "1.2.3"))["project"]["urls"]
    assert named["Changelog"] == "https://a.example/x/blob/v1.2.3/CHANGELOG.md"


def packed(path: Path, names: list[str], mtime: int, user: str) -> Path:
    with tarfile.open(path, "w:gz") as archive:
        for name in names:
            member = tarfile.TarInfo(name)
            member.size, member.mtime, member.uname, member.mode = len(name), mtime, user, 0o755
            archive.addfile(member, io.BytesIO(name.encode()))
    return path


def test_equal_content_becomes_equal_bytes(tmp_path: Path) -> None:
    first = packed(tmp_path / "a.tar.gz", ["x/b", "x/a"], 5, "me")
    second = packed(tmp_path / "b.tar.gz", ["x/a", "x/b"], 7, "you")
    for path in (first, second):
        RELEASE["repack"](path, 1_000_000_000)
    assert first.read_bytes() == second.read_bytes()
    with tarfile.open(first) as archive:
        assert archive.getnames() == ["x/a", "x/b"]
        assert archive.extractfile("x/b").read() == b"x/b"  # type: ignore[union-attr]
        assert archive.getmember("x/a").mode == 0o755


def test_the_version_is_in_one_place_and_the_citation_agrees() -> None:
    assert yaml.safe_load((ROOT / "CITATION.cff").read_text("utf-8"))["version"] == __version__


def test_the_source_distribution_has_every_folder() -> None:
    lines = (ROOT / "MANIFEST.in").read_text("utf-8").splitlines()
    grafted = {line.split()[1] for line in lines if line.startswith("graft ")}
    folders = {
        path.parent.name for path in ROOT.glob("*/*.*") if not path.parent.name.startswith((".", "out", "build"))
    }
    assert folders - grafted <= {"dist", "v2v_stream.egg-info", "__pycache__"}


def test_files_of_licences_exist() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    assert all((ROOT / name).is_file() for name in project["license-files"])
