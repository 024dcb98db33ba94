"""Build what a release consists of, in ``out/release``: wheel, source distribution, list of components (CycloneDX), and
their hashes. `make release` runs it, twice, and compares the bytes. Nothing is uploaded.

What is committed is built, at the time of its commit. On a package index the README has no tree around it: with
REPOSITORY_URL in the environment its links lead to this version in the repository, and the metadata list its addresses.
"""

from __future__ import annotations

import gzip
import hashlib
import io
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
OUT = ROOT / "out" / "release"
_LINK = re.compile(r"\]\((?!https?:|#)([^)#]*)")
"""The end of a link or picture of Markdown that leads into the tree: its path."""
_PICTURES = (".gif", ".png", ".svg")


def with_addresses(readme: str, repository: str, version: str) -> str:
    """Return the README with each link into the tree as an address in the repository, at the tag of this version."""
    return _LINK.sub(
        lambda link: f"]({repository}/{'raw' if link[1].endswith(_PICTURES) else 'blob'}/v{version}/{link[1]}", readme
    )


def urls(repository: str, version: str) -> str:
    """Return the table of addresses for ``pyproject.toml``."""
    pages = {"Source": "", "Issues": "/issues", "Changelog": f"/blob/v{version}/CHANGELOG.md"}
    return "\n[project.urls]\n" + "".join(f'{name} = "{repository}{path}"\n' for name, path in pages.items())


def repack(archive: Path, epoch: int) -> None:
    """Write a source distribution again with members in order of their names, of one time, and of no user."""
    packed = io.BytesIO()
    with tarfile.open(archive) as old, tarfile.open(fileobj=packed, mode="w", format=tarfile.PAX_FORMAT) as new:
        for member in sorted(old.getmembers(), key=lambda member: member.name):
            member.uid = member.gid = 0
            member.uname = member.gname = ""
            member.mtime, member.pax_headers = epoch, {}
            new.addfile(member, old.extractfile(member) if member.isfile() else None)
    with archive.open("wb") as file, gzip.GzipFile(filename="", mode="wb", fileobj=file, mtime=epoch) as zipped:
        zipped.write(packed.getvalue())


def build(out: Path) -> None:
    """Build wheel and source distribution of the commit into a folder."""
    epoch = int(_said("git", "log", "-1", "--format=%ct"))
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder) / "v2v-stream"
        tree.mkdir()
        archive = subprocess.run(["git", "archive", "HEAD"], cwd=ROOT, check=True, stdout=subprocess.PIPE).stdout
        with tarfile.open(fileobj=io.BytesIO(archive)) as tar:
            tar.extractall(tree, filter="data")
        (version,) = re.findall(
            r'^__version__ = "(.+)"$', (tree / "v2v_protocol" / "__init__.py").read_text("utf-8"), re.M
        )
        if repository := os.environ.get("REPOSITORY_URL", "").rstrip("/"):
            readme = tree / "README.md"
            readme.write_text(with_addresses(readme.read_text("utf-8"), repository, version), "utf-8")
            with (tree / "pyproject.toml").open("a", encoding="utf-8") as project:
                project.write(urls(repository, version))
        environment = os.environ | {"SOURCE_DATE_EPOCH": str(epoch)}
        command = [sys.executable, "-m", "build", "--outdir", str(out), str(tree)]
        done = subprocess.run(command, check=False, env=environment, capture_output=True, text=True)
        if done.returncode:
            sys.exit(done.stdout + done.stderr)
    (source,) = out.glob("*.tar.gz")
    repack(source, epoch)


def _said(*command: str) -> str:
    return subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout.strip()


def _hash(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def main() -> None:
    """Build twice, compare, check the metadata, list components and hashes."""
    if _said("git", "status", "--porcelain", "--untracked-files=no"):
        sys.exit("uncommitted changes: a release is built from a commit")
    shutil.rmtree(OUT, ignore_errors=True)
    with tempfile.TemporaryDirectory() as folder:
        build(OUT)
        build(again := Path(folder))
        for path in sorted(OUT.iterdir()):
            if _hash(path) != _hash(again / path.name):
                sys.exit(f"{path.name}: a second build has other bytes")
    built = sorted(OUT.iterdir())
    subprocess.run([sys.executable, "-m", "twine", "check", "--strict", *map(str, built)], check=True)
    components = [sys.executable, "-m", "cyclonedx_py", "requirements", "--output-reproducible", "--of", "JSON"]
    subprocess.run([*components, "-o", str(OUT / "components.cdx.json"), str(ROOT / "constraints.txt")], check=True)
    hashes = [f"{_hash(path)}  {path.name}\n" for path in sorted(OUT.iterdir())]
    (OUT / "SHA256SUMS").write_text("".join(hashes), "utf-8")
    print("".join(hashes), end="")


if __name__ == "__main__":
    main()
