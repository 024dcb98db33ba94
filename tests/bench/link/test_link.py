"""Two hosts on one machine: what their cable carries, what streams make of a slow one, and of one that is cut."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from bench.chaos.chaos import FAILING
from bench.link import across, curve, slow
from tests.bench.small import FLAGS, clips, records

pytestmark = [pytest.mark.slow, pytest.mark.timeout(180)]

Run = Callable[[Callable[[Sequence[str]], int], Sequence[str]], str]


@pytest.fixture
def run(capfd: pytest.CaptureFixture[str]) -> Run:
    """Runs a benchmark whose bars are kept, or are for quiet machines to say: what it printed."""

    def run(main: Callable[[Sequence[str]], int], arguments: Sequence[str]) -> str:
        status = main(arguments)
        said = capfd.readouterr()
        if status == 2 and re.search(r"no (network namespace|second network) here", said.err):
            # What can be shown without, by a proxy that cuts, delays and swallows: tests/faults/test_network.py.
            pytest.skip(said.err.strip())
        assert status == 0 or "bar missed" in said.err, said
        return said.out

    return run


def test_a_slow_link_carries_more_compressed_samples(tmp_path: Path, run: Run) -> None:
    flags = ["--videos", str(clips(tmp_path / "clips")), *FLAGS, "--mbit", "20", "--seconds", "1.5", "--turns", "1"]
    run(slow.main, [*flags, "--samples", "3", "--batch-size", "4", "--json", str(tmp_path / "out")])
    raw, compressed = records(tmp_path / "out")
    assert 0.5 < raw["link_busy"] < 1.1
    assert raw["batches_per_second"] * 4 * (4 * 5 * 32 * 40 + 5 * 32 * 40) < 1.1 * 20 * 125e3
    assert compressed["wire_bytes_per_batch"] < raw["wire_bytes_per_batch"] / 2
    assert compressed["ratio_to_raw"] > 1.5


def test_nothing_is_lost_on_a_lossy_cable_that_is_pulled_out(tmp_path: Path, run: Run) -> None:
    flags = ["--videos", str(clips(tmp_path / "clips")), "--consumers", "1", "--workers", "1", "--minutes", "0.15"]
    flags += ["--every", "1", "--remakes", "10", "--faults", "consumer-kill,further-add", "--json", str(tmp_path / "o")]
    said = run(across.main, [*flags, "--loss", "0.02"])
    found = re.search(r"the cable: (\d+) packets passed, (\d+) lost, (\d+) cuts", said)
    assert found is not None
    passed, lost, cuts = map(int, found.groups())
    assert passed > 100
    assert lost > 0
    assert cuts > 0
    (record,) = records(tmp_path / "o")
    assert record["samples"] > 20
    assert [record[key] for key in FAILING] == [0] * len(FAILING)


def test_what_keys_cost_is_told(tmp_path: Path) -> None:
    flags = [*FLAGS, "--seconds", "0.3", "--turns", "1", "--batch-size", "4", "--json", str(tmp_path / "out")]
    assert curve.main(flags) in (0, 1)  # what it costs is for quiet machines to say
    assert [each["name"] for each in records(tmp_path / "out")] == [
        "null workers, shared memory",
        "null workers, messages",
    ]
    assert all(each["keyed_batches_per_second"] > 0 for each in records(tmp_path / "out"))
