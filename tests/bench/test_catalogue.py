"""The benchmark of large catalogues, on a small one."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from bench import catalogue
from tests.clips import panned_luma, write_clip


@pytest.mark.slow
def test_a_made_up_corpus_is_opened_and_served(tmp_path: Path) -> None:
    write_clip(tmp_path / "clip.mp4", panned_luma(210, 160, 200), gop=50)
    made, out = tmp_path / "made", tmp_path / "out.json"
    made.mkdir()
    where = ["--folder", str(made), "--json", str(out)]
    asked = ["--clip", str(tmp_path / "clip.mp4"), "--videos", "1200", "--scene", *where]
    assert catalogue.main(asked) == 0
    (record,) = json.loads(out.read_text(encoding="utf-8"))
    assert (record["videos"], record["sequences"]) == (1200, 1200)
    assert record["first_batch_seconds"] > record["open_seconds"] > 0
    assert not list(made.iterdir())


def test_a_clip_that_cannot_be_served_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "clip.mp4").write_bytes(b"nothing")
    assert catalogue.main(["--clip", str(tmp_path / "clip.mp4"), "--videos", "3"]) == 2
    assert "--clip" in capsys.readouterr().err
