"""The limits: how work is counted, and one short run for real."""

from __future__ import annotations

from pathlib import Path

import pytest

from bench import limits
from tests.bench.small import FLAGS, clips, is_picture, one_line, records


def test_work_is_repeated_until_the_time_is_over_and_at_least_once() -> None:
    done: list[int] = []
    times, seconds, cpu = limits.repeated(lambda: done.append(1), 0.0)
    assert times == len(done) == 1
    assert seconds >= 0
    assert cpu >= 0
    times, seconds, _ = limits.repeated(iter(range(10**9)), 0.01)
    assert times > 1
    assert seconds >= 0.01


def test_a_copy_is_counted_in_bytes_of_a_batch() -> None:
    record = limits.copied(1 << 20, 0.01)
    assert record["bytes_per_cpu_second"] == pytest.approx((1 << 20) / record["cpu_seconds_per_batch"])
    assert record["batches_per_cpu_second"] == pytest.approx(1 / record["cpu_seconds_per_batch"])


@pytest.mark.slow
def test_a_short_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, picture = tmp_path / "limits.json", tmp_path / "limits.png"
    flags = ["--videos", str(clips(tmp_path / "clips")), "--rows", "full", "--batch-size", "3", "--seconds", "0.3"]
    assert limits.main([*flags, *FLAGS, "--json", str(out), "--plot", str(picture)]) == 0
    found = {record["part"]: record for record in records(out)}
    assert list(found) == ["decode", "kernel", "sample", "wire", "broker", "copy"]
    assert {record["bytes_per_batch"] for record in found.values()} == {3 * (4 * 5 + 4) * 32 * 40}
    assert found["sample"]["cpu_seconds_per_batch"] > found["kernel"]["cpu_seconds_per_batch"]
    assert is_picture(picture)
    assert "of a sample: decode" in capsys.readouterr().out


@pytest.mark.parametrize("flags", [["--seconds", "0"], ["--set", "gama=1"], ["--seconds", "nan"]])
def test_wrong_usage_is_status_2(tmp_path: Path, flags: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert limits.main(["--videos", str(tmp_path), *flags]) == 2
    assert one_line(capsys, "limits")


def test_a_corpus_without_sequences_is_status_2(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert limits.main(["--videos", str(tmp_path), "--seconds", "0.1"]) == 2
    assert one_line(capsys, "limits")
