"""A short run of the fuzz bench, and the proof that it notices failures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from bench.chaos.fuzz import fuzz_live
from tests.clips import write_panned
from tests.oracles import hostile_frames
from tests.oracles.hostile_frames import failed, fuzz_decoder
from v2v_protocol.messages import decode


def test_twenty_thousand_frames() -> None:
    record = fuzz_decoder(20_000, seed=1)
    assert record["failures"] == []
    assert failed(record) == []
    assert min(record["messages"], record["samples"], record["refused"]) > 200


@pytest.mark.parametrize("wrong", [ValueError("boom"), RecursionError(), "not a message"])
def test_a_decoder_that_gives_way_is_noticed(monkeypatch: pytest.MonkeyPatch, wrong: object) -> None:
    def broken(header: bytes) -> Any:
        if header[:1] == b"\xdf":
            if isinstance(wrong, Exception):
                raise wrong
            return wrong
        return decode(header)

    monkeypatch.setattr(hostile_frames, "decode", broken)
    record = fuzz_decoder(2000, seed=1)
    assert record["failures"]
    assert failed(record)


@pytest.mark.slow
@pytest.mark.parametrize(("keyed", "messages"), [(False, 4000), (True, 1500)])
def test_a_live_server_under_attack(tmp_path: Path, keyed: bool, messages: int) -> None:
    clips = write_panned(tmp_path / "clips", 4, 201, 128, 160)  # large and long enough for the paper's recipe too
    record = fuzz_live(clips, messages, 1, tmp_path / "run", remakes=50, keyed=keyed)
    assert failed(record) == []
    assert record["healthy_batches_under_attack"] > 0
