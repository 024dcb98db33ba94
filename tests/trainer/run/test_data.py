"""Test the pictures of firenet-cpu: each is free to use, and none is trained on, held out and judged by at once."""

import csv
import hashlib
from importlib.resources import files

import numpy as np
import pytest
from PIL import Image

from tests.oracles.rendered import PHOTOGRAPHS
from trainer.config_file import shipped
from trainer.run import data
from trainer.train import main

ROWS = list(csv.DictReader((data.LISTS / "firenet-cpu.csv").read_text().splitlines()))


def digest_of(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:16]


def test_no_photograph_of_a_judged_recording_and_none_that_is_held_out_is_trained_on():
    judged = [(files("skimage.data") / f"{name}.png").read_bytes() for name in PHOTOGRAPHS]
    digests = [row["sha256"] for row in ROWS] + [digest_of(each) for each in judged]
    assert len(set(digests)) == len(digests)
    assert {row["file"] for row in ROWS if row["set"] == "held-out"} == {"chelsea.png", "rocket.jpg"}


def test_each_photograph_has_a_free_licence_and_an_author():
    assert {row["licence"] for row in ROWS} <= {"public domain", "CC0", "BSD", "MIT"}
    assert all(row["by"] for row in ROWS)
    assert {path.stem for path in data.LISTS.glob("*.csv")} <= set(shipped())


def test_the_pictures_are_those_of_the_list_and_drawn_ones(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(data, "DRAWN", 1)
    assert main(["data", "firenet-cpu", "--out", str(tmp_path)]) == 0
    assert capsys.readouterr().out == f"{len(ROWS) + 1} pictures in {tmp_path}\n"
    found = {path.name: path for path in tmp_path.glob("*/photographs/*")}
    drawn = np.asarray(Image.open(found.pop("leaves-00.png")))
    assert {name: (path.parts[-3], digest_of(path.read_bytes())) for name, path in found.items()} == {
        row["file"]: (row["set"], row["sha256"]) for row in ROWS
    }
    np.testing.assert_array_equal(drawn, data.dead_leaves(0))


def test_drawn_pictures_differ_by_seed_and_have_the_greys_of_photographs():
    first, second = data.dead_leaves(0), data.dead_leaves(1)
    assert first.shape == (512, 512)
    assert not np.array_equal(first, second)
    assert 40 < first.std() < 90


@pytest.mark.parametrize(
    ("row", "configuration", "said"),
    [
        ("training,astronaut.png,0000000000000000,CC0,me", "listed", "not the listed picture"),
        ("training,absent.png,0000000000000000,CC0,me", "listed", "not the listed picture"),
        ("", "e2vid", "'e2vid' has no list of pictures; give one of: listed"),
    ],
)
def test_other_pictures_and_other_configurations_are_refused(tmp_path, capsys, monkeypatch, row, configuration, said):
    (tmp_path / "listed.csv").write_text(f"set,file,sha256,licence,by\n{row}\n")
    monkeypatch.setattr(data, "LISTS", tmp_path)
    assert data.main([configuration, "--out", str(tmp_path / "out")]) == 2
    assert said in capsys.readouterr().err


def test_a_folder_that_cannot_be_made_is_said(tmp_path, capsys):
    (tmp_path / "out").write_text("a file")
    assert data.main(["firenet-cpu", "--out", str(tmp_path / "out")]) == 2
    assert "give another --out" in capsys.readouterr().err
