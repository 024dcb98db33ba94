"""The checker's rules: whatever is wrong with a log is found, and nothing is found in a right one."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.oracles.stream_log import (
    BatchLine,
    Kill,
    LifeLine,
    Line,
    LogWriter,
    Sighting,
    Sightings,
    check_order,
    read_log,
    recovery_seconds,
)
from v2v_protocol.errors import UsageError
from v2v_protocol.sample import Refusal

SEQUENCES, BATCH_SIZE = 11, 3
PER_EPOCH = 3


def batch(number: int) -> BatchLine:
    """Batch ``number`` of the schedule of a rank of one, from epoch 0 on."""
    epoch, place = divmod(number, PER_EPOCH)
    first = place * BATCH_SIZE
    samples = tuple(Sighting(index, f"{epoch}:{index}", "v.mp4", 0, 0) for index in range(first, first + BATCH_SIZE))
    return BatchLine(number, epoch, float(number), 0.1, samples)


def log(*lives: tuple[int, int]) -> list[Line]:
    """Lives as (batches that the state covers, number of the batch before which it ends)."""
    lines: list[Line] = []
    for committed, end in lives:
        lines.append(LifeLine(committed, 0.0))
        lines += [batch(number) for number in range(committed, end)]
    return lines


@st.composite
def honest_lives(draw: st.DrawFn) -> list[tuple[int, int]]:
    """Any number of deaths; each life goes on from any batch that the one before reached."""
    lives, reached = [], 0
    for _ in range(draw(st.integers(1, 6))):
        committed = draw(st.integers(0, reached))
        reached = committed + draw(st.integers(0, 9))
        lives.append((committed, reached))
    return lives


@given(honest_lives())
def test_an_honest_log_has_no_fault_whatever_died(lives: list[tuple[int, int]]) -> None:
    verdict = check_order(log(*lives), sequences=SEQUENCES, batch_size=BATCH_SIZE)
    assert verdict.faultless
    assert verdict.samples == lives[-1][1] * BATCH_SIZE
    logged = sum(end - committed for committed, end in lives)
    assert verdict.samples + verdict.repeated == logged * BATCH_SIZE
    assert verdict.lives == len(lives)


@pytest.mark.parametrize("ahead", [-1, 1, 5])
def test_a_state_that_is_not_where_it_says_is_found(ahead: int) -> None:
    """The state was after 4 batches; the stream goes on a batch too early (twice) or too late (lost)."""
    lines = log((0, 5))
    lines.append(LifeLine(4, 0.0))
    lines += [dataclasses.replace(batch(number + ahead), number=number) for number in range(4, 8)]
    verdict = check_order(lines, sequences=SEQUENCES, batch_size=BATCH_SIZE)
    assert verdict.duplicated == BATCH_SIZE * max(0, -ahead)
    assert verdict.lost == BATCH_SIZE * max(0, ahead)
    assert not verdict.faultless


def test_a_life_that_skips_its_own_numbers_is_found() -> None:
    lines = log((0, 5))
    lines.append(LifeLine(7, 0.0))
    assert check_order(lines, sequences=SEQUENCES, batch_size=BATCH_SIZE).broken_lives == 1


def test_other_bytes_of_the_same_sample_contradict() -> None:
    seen = Sightings()
    seen.add("a", batch(0))
    seen.add("a", batch(0))
    assert (seen.samples, seen.contradictions) == (6, 0)
    flipped = dataclasses.replace(batch(0).samples[1], digest="other")
    seen.add("a", dataclasses.replace(batch(0), samples=(flipped,)))
    assert seen.contradictions == 1
    seen.add("b", dataclasses.replace(batch(0), samples=(flipped,)))
    assert seen.contradictions == 1, "another stream has other bytes"
    moved = dataclasses.replace(flipped, candidate=1, refusals=(Refusal("v.mp4", None, "crash"),))
    seen.add("a", dataclasses.replace(batch(0), samples=(moved,)))
    assert seen.contradictions == 1, "another candidate has other bytes"


# --- the file ---------------------------------------------------------------------------------------------------------


def write(path: Path, lines: list[Line]) -> None:
    writer = LogWriter(path)
    for line in lines:
        writer.append(line)
    writer.close()


@given(lives=honest_lives(), refusals=st.booleans())
def test_lines_come_back_as_they_were(
    tmp_path_factory: pytest.TempPathFactory, lives: list[tuple[int, int]], refusals: bool
) -> None:
    path = tmp_path_factory.mktemp("log") / "log.jsonl"
    lines = log(*lives)
    if refusals:
        moved = Sighting(1, "d", "w.mp4", 20, 1, (Refusal("v.mp4", 3, "no frame"),), 2)
        lines.append(BatchLine(99, 1, 0.5, 0.25, (moved,)))
    write(path, lines)
    assert list(read_log(path)) == lines


@pytest.mark.parametrize("cut", [1, 10, 100])
def test_a_torn_line_counts_as_not_written(tmp_path: Path, cut: int) -> None:
    path = tmp_path / "log.jsonl"
    write(path, log((0, 3)))
    path.write_bytes(path.read_bytes()[:-cut])
    assert list(read_log(path)) == log((0, 2))
    write(path, [LifeLine(2, 0.0)])
    assert list(read_log(path)) == [*log((0, 2)), LifeLine(2, 0.0)]


@pytest.mark.parametrize("text", [b"{}", b"not json", b'{"kind": "batch", "number": 1}'])
def test_a_damaged_line_is_an_error(tmp_path: Path, text: bytes) -> None:
    path = tmp_path / "log.jsonl"
    write(path, log((0, 3)))
    path.write_bytes(text + b"\n" + path.read_bytes())
    with pytest.raises(UsageError, match="line 1"):
        list(read_log(path))


# --- recovery ---------------------------------------------------------------------------------------------------------


def test_recovery_waits_for_the_last_consumer() -> None:
    batches = [[1.0, 2.0, 3.0], [0.5, 7.0]]
    assert recovery_seconds(Kill("worker-kill", 2.5, None, 2.5), batches) == 4.5
    assert recovery_seconds(Kill("consumer-kill", 1.5, 0, 1.5), batches) == 0.5
    assert recovery_seconds(Kill("consumer-kill", 2.0, 0, 2.0), batches) == 1.0, "the next one, not that of the moment"


def test_batches_in_hand_do_not_count_as_recovery_of_the_server() -> None:
    assert recovery_seconds(Kill("server-kill", 1.0, None, 4.0), [[1.1, 1.2, 6.0]]) == 5.0
    assert recovery_seconds(Kill("server-kill", 1.0, None, math.inf), [[1.1, 1.2, 6.0]]) is None


def test_who_never_gets_another_batch_has_not_recovered() -> None:
    assert recovery_seconds(Kill("worker-kill", 3.0, None, 3.0), [[4.0], [2.0]]) is None
