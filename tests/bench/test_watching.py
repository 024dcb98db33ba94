"""The bench of being watched: it runs for real, and its bar."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.clips import panned_luma, write_clip
from v2v_bench import watching
from v2v_bench.usage import Consumed


def consumed(batches: int, page: float = 0.1) -> Consumed:
    return Consumed(batches, 1, 1.0, {"workers": 0.9, "page": page})


def test_what_is_kept_is_the_median_over_turns() -> None:
    record = watching.compare([(consumed(10), consumed(other)) for other in (5, 9, 10)])
    assert (record["kept"], record["kept_lowest"], record["kept_highest"]) == (0.9, 0.5, 1.0)
    assert record["page_cpu_share"] == pytest.approx(0.1)
    assert watching.missed(record) == ["0.900 of the rate kept, 0.98 was asked"]
    assert not watching.missed(record | {"kept": 0.98})


@pytest.mark.slow
def test_it_runs(tmp_path: Path) -> None:
    write_clip(tmp_path / "a.mp4", panned_luma(240, 160, 210))
    out = tmp_path / "watching.json"
    flags = ["--videos", str(tmp_path), "--workers", "1", "--batch-size", "1", "--seconds", "1.5", "--turns", "1"]
    assert watching.main([*flags, "--json", str(out)]) in (0, 1)
    (record,) = json.loads(out.read_text(encoding="utf-8"))
    assert record["alone"] > 0
    assert record["watched"] > 0
    assert 0 < record["page_cpu_share"] < 1
