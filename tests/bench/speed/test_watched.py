"""What watching costs, for a moment, for real."""

from __future__ import annotations

from pathlib import Path

import pytest

from bench.speed.watched import main
from tests.bench.small import FLAGS, clips, one_line, records


@pytest.mark.slow
def test_a_service_is_measured_with_and_without_a_page_that_is_open(tmp_path: Path) -> None:
    file = tmp_path / "watched.json"
    arguments = ["--videos", str(clips(tmp_path / "clips")), *FLAGS, "--json", str(file)]
    status = main([*arguments, "--workers", "1", "--batch-size", "2", "--turns", "2", "--seconds", "2"])
    (record,) = records(file)
    assert status == (record["kept"] < 0.98)
    assert record["batches_per_second"] > 0.0
    assert record["kept_lowest"] <= record["kept"]
    assert 0.0 < record["page_cpu_share"] < 1.0


def test_too_little_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--videos", "clips", "--turns", "0"]) == 2
    assert one_line(capsys, "watched")
