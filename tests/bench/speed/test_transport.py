"""Transport: every route carries samples whole, codecs give back what they took, bars, and one short run for real."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench.speed import transport
from bench.speed.route_process import CODECS
from bench.speed.routes import Route, missing, travel
from tests.bench.small import FLAGS, RECIPE, clips, is_picture, one_line, records
from v2v_protocol.errors import UsageError

HERE = [codec for codec in CODECS if missing(codec) is None]


@given(st.lists(st.integers(-128, 127), min_size=1, max_size=300), st.integers(0, 500))
def test_codecs_give_back_what_they_took(values: list[int], zeros: int) -> None:
    array = np.array([0] * zeros + values, np.int8)
    for codec in HERE:
        compress, decompress = CODECS[codec]()
        assert bytes(decompress(compress(array.data))) == array.tobytes()


def test_a_codec_that_is_not_installed_is_skipped_with_the_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    def absent() -> None:
        raise ImportError("no such package", name="absent")

    monkeypatch.setitem(CODECS, "absent", absent)  # type: ignore[arg-type]
    record = transport.prototype(Route("absent", codec="absent"), [], 3, 0.1)
    assert record == {"name": "absent", "skipped": "Python package absent is not installed"}


@pytest.mark.parametrize(
    ("exact", "fastest", "missed"),
    [(0.05, 0.10, 0), (0.051, 0.10, 1), (0.04, 0.11, 1), (0.06, 0.2, 2), (0.04, None, 0)],
)
def test_bars(exact: float, fastest: float | None, missed: int) -> None:
    records = [{"name": "fast, at work", "preset": "fast", "share": fastest}] if fastest is not None else []
    records += [{"name": "exact, at work", "preset": "exact", "share": exact}, {"name": "message"}]
    assert len(transport.missed_bars(records)) == missed


@pytest.mark.slow
def test_what_arrives_on_each_route(tmp_path: Path) -> None:
    samples = transport.some_samples(clips(tmp_path / "clips"), "full", RECIPE, 3)
    whole = 3 * sum(array.nbytes for array in samples[0].arrays.values())
    for route in transport.ROUTES:
        if route.codec and route.codec not in HERE:
            continue
        travelled = travel(route, samples, batch_size=3, seconds=0.1)
        each = travelled.wire_bytes / travelled.batches
        assert travelled.batches > 0
        assert travelled.cpu_seconds.keys() == {"sender", "broker", "receiver"}
        if route.payload != "message":
            assert each == 0
        elif route.codec:
            assert 0 < each < whole
        else:
            assert each == pytest.approx(whole)


@pytest.mark.slow
def test_a_process_that_dies_is_named(tmp_path: Path) -> None:
    samples = transport.some_samples(clips(tmp_path / "clips"), "full", RECIPE, 1)
    with pytest.raises(UsageError, match="the sender ended with status 1"):
        travel(Route("broken", codec="none of them"), samples, batch_size=3, seconds=0.1)


@pytest.mark.slow
def test_a_short_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(transport, "ROUTES", (Route("message"), Route("shared memory", "shared")))
    out, picture = tmp_path / "transport.json", tmp_path / "transport.png"
    folder = str(clips(tmp_path / "clips"))
    flags = ["--videos", folder, "--rows", "full", "--fast-videos", folder, "--batch-size", "3", "--seconds", "0.2"]
    assert transport.main([*flags, *FLAGS, "--json", str(out), "--plot", str(picture)]) in (0, 1)
    found = records(out)
    assert [record["name"] for record in found] == [
        "exact, at work",
        "fast, at work",
        transport.NULL_SHARED,
        transport.NULL_MESSAGES,
        "message",
        "shared memory",
    ]
    assert all(0 < record["share"] < 1 and record["making_cpu_seconds_per_batch"] > 0 for record in found[:2])
    assert all(record["cpu_seconds_per_batch"] > 0 for record in found)
    assert found[4]["wire_bytes_per_batch"] == 3 * (4 * 5 + 4) * 32 * 40
    assert is_picture(picture)


def test_wrong_usage_is_status_2(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert transport.main(["--videos", str(tmp_path), "--seconds", "0"]) == 2
    assert one_line(capsys, "transport")
