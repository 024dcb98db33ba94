"""The quarantine: snapshots in memory against a slow model, and the file that several processes write to."""

from __future__ import annotations

import errno
import json
import multiprocessing
import os
import resource
import stat
from collections import Counter
from dataclasses import asdict, replace
from pathlib import Path

import hypothesis.strategies as st
import pytest
from hypothesis import given, settings

from v2v_protocol.errors import CorpusError
from v2v_server.quarantine import (
    Quarantine,
    QuarantineEntry,
    clearing,
    quarantine_path,
    read_quarantine,
    write_entry,
)

TIME = "2024-02-29T12:00:00+00:00"


def verdict(path: str = "v.mp4", frame: int = 0, fingerprint: str = "f", reason: str = "crash") -> QuarantineEntry:
    return QuarantineEntry(0, path, fingerprint, frame, reason, TIME)


def numbered(*verdicts: QuarantineEntry) -> list[QuarantineEntry]:
    return [replace(each, snapshot=number) for number, each in enumerate(verdicts, 1)]


# --- snapshots --------------------------------------------------------------------------------------------------------


def test_snapshot_0_is_empty_and_there_is_no_other_at_first() -> None:
    quarantine = Quarantine()
    for snapshot in (-1, 1):
        with pytest.raises(CorpusError, match=rf"snapshot {snapshot}: there are 0 \.\. 0"):
            quarantine.entries(snapshot)
        with pytest.raises(CorpusError, match=rf"snapshot {snapshot}: there are 0 \.\. 0"):
            quarantine.refusal(snapshot, "v.mp4", "f", 0)


def test_a_verdict_refuses_its_sequence_and_two_the_whole_video() -> None:
    quarantine = Quarantine(numbered(verdict(frame=5, reason="SIGSEGV"), verdict(frame=10, reason="SIGBUS")))
    assert quarantine.refusal(1, "v.mp4", "f", 5) == "sequence in quarantine snapshot 1: SIGSEGV"
    assert quarantine.refusal(2, "v.mp4", "f", 15) == "video in quarantine snapshot 2 (2 verdicts): SIGBUS"


@pytest.mark.parametrize("number", [0, 1, 3, -1])
def test_numbers_go_on_where_they_ended(number: int) -> None:
    quarantine = Quarantine(numbered(verdict()))
    with pytest.raises(CorpusError, match=f"line 2 has snapshot number {number}"):
        quarantine.extend([replace(verdict(), snapshot=number)])
    assert quarantine.latest == 1


_verdicts = st.lists(
    st.builds(verdict, st.sampled_from(("v", "w")), st.integers(0, 2), st.sampled_from("fg")) | st.just(clearing(TIME)),
    max_size=10,
)


@given(_verdicts)
@settings(max_examples=150, deadline=None)
def test_every_snapshot_against_its_definition(verdicts: list[QuarantineEntry]) -> None:
    """Snapshot n + 1 is snapshot n and one verdict more, or nothing."""
    quarantine = Quarantine()
    held: list[QuarantineEntry] = []
    snapshots: list[list[QuarantineEntry]] = [[]]
    for each in numbered(*verdicts):
        quarantine.extend([each])
        held = [*held, each] if each.path else []
        snapshots.append(held)
    assert quarantine.latest == len(verdicts)
    for number, expected in enumerate(snapshots):
        assert quarantine.entries(number) == expected
        counts = Counter((each.path, each.fingerprint) for each in expected)
        for path in "vw":
            for fingerprint in "fg":
                for frame in range(3):
                    hit = any((v.path, v.fingerprint, v.frame) == (path, fingerprint, frame) for v in expected)
                    refused = quarantine.refusal(number, path, fingerprint, frame) is not None
                    assert refused == (hit or counts[path, fingerprint] >= 2)


# --- the file ---------------------------------------------------------------------------------------------------------


def write(file: Path, *verdicts: QuarantineEntry) -> Quarantine:
    """A process of its own that reads, and writes these."""
    quarantine = read_quarantine(file)
    for each in verdicts:
        quarantine.extend(write_entry(file, each, quarantine))
    return quarantine


def test_the_file_lies_beside_the_index(tmp_path: Path) -> None:
    file = quarantine_path(Path("/corpus"), tmp_path)
    assert file.parent == tmp_path
    assert file != quarantine_path(Path("/corpus2"), tmp_path)


@given(
    st.lists(
        st.builds(verdict, st.text(min_size=1), st.integers(0, 2**40), st.text(), st.text()) | st.just(clearing(TIME)),
        max_size=5,
    )
)
@settings(max_examples=40, deadline=None)
def test_what_is_written_is_read(tmp_path_factory: pytest.TempPathFactory, verdicts: list[QuarantineEntry]) -> None:
    file = tmp_path_factory.mktemp("quarantine") / "new folder" / "q.jsonl"
    assert write(file, *verdicts).lines == tuple(numbered(*verdicts)) == read_quarantine(file).lines
    if verdicts:
        lines = file.read_bytes().split(b"\n")
        assert [json.loads(line) for line in lines[:-1]] == [asdict(each) for each in numbered(*verdicts)]
        assert lines[-1] == b""


@pytest.mark.parametrize("cut", range(1, 30))
def test_a_last_line_that_was_cut_off_is_left_out_and_written_over(tmp_path: Path, cut: int) -> None:
    file = tmp_path / "q.jsonl"
    first, second = write(file, verdict("v.mp4"), verdict("w.mp4", reason="x" * 100)).lines
    file.write_bytes(file.read_bytes()[:-cut])
    assert read_quarantine(file).lines == (first,)
    again = write(file, verdict("u.mp4"))
    assert read_quarantine(file).lines == again.lines == (first, replace(verdict("u.mp4"), snapshot=2))
    assert second not in again.lines


@pytest.mark.parametrize(
    "line",
    [
        b"",
        b"garbage",
        b"\xff\xfe",
        b"\0\0\0\0",
        b"[]",
        b"{}",
        b"1",
        b'{"snapshot": 2}',
        b'{"snapshot": 2, "path": "v", "fingerprint": "f", "frame": 0, "reason": "r", "time": "t", "more": 1}',
        b'{"snapshot": 2, "path": "v", "fingerprint": "f", "frame": "0", "reason": "r", "time": "t"}',
        b'{"snapshot": 2, "path": "v", "fingerprint": "f", "frame": -1, "reason": "r", "time": "t"}',
        b'{"snapshot": 2, "path": null, "fingerprint": "f", "frame": 0, "reason": "r", "time": "t"}',
        b'{"snapshot": 3, "path": "v", "fingerprint": "f", "frame": 0, "reason": "r", "time": "t"}',
        b'{"snapshot": 1, "path": "v", "fingerprint": "f", "frame": 0, "reason": "r", "time": "t"}',
        b'{"snapshot": true, "path": "v", "fingerprint": "f", "frame": 0, "reason": "r", "time": "t"}',
    ],
)
def test_any_other_damaged_line_is_named_and_left_alone(tmp_path: Path, line: bytes) -> None:
    file = tmp_path / "q.jsonl"
    known = write(file, verdict())
    damaged = file.read_bytes() + line + b"\n"
    file.write_bytes(damaged)
    with pytest.raises(CorpusError, match=r"q\.jsonl, line 2 is damaged .*; correct or delete the line"):
        read_quarantine(file)
    with pytest.raises(CorpusError, match=r"line 2 is damaged"):
        write_entry(file, verdict(), known)
    assert file.read_bytes() == damaged


def test_what_is_no_file_can_neither_be_read_nor_written(tmp_path: Path) -> None:
    with pytest.raises(CorpusError, match="cannot be read"):
        read_quarantine(tmp_path)
    with pytest.raises(OSError, match="directory"):
        write_entry(tmp_path, verdict(), Quarantine())
    (tmp_path / "file").touch()
    with pytest.raises(OSError, match="exists"):
        write_entry(tmp_path / "file" / "q.jsonl", verdict(), Quarantine())


def test_a_full_disk_leaves_what_was_there(tmp_path: Path) -> None:
    """A limit on the size of files stands in for the disk. Python ignores the signal that comes with it."""
    file = tmp_path / "q.jsonl"
    known = write(file, verdict())
    before, limits = file.read_bytes(), resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (len(before) + 20, limits[1]))
    try:
        with pytest.raises(OSError, match=f"{os.strerror(errno.ENOSPC)}|{os.strerror(errno.EFBIG)}"):
            write_entry(file, verdict("w.mp4"), known)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert file.read_bytes() == before
    assert read_quarantine(file).lines == known.lines


# --- several writers --------------------------------------------------------------------------------------------------


def test_two_servers_and_a_clearing_share_one_numbering(tmp_path: Path) -> None:
    file = tmp_path / "q.jsonl"
    here, there = read_quarantine(file), read_quarantine(file)
    here.extend(write_entry(file, verdict("a.mp4"), here))
    write(file, clearing(TIME))
    written = write_entry(file, verdict("b.mp4"), there)
    # A writer learns of everything written since its last reading, its own line last.
    assert written == numbered(verdict("a.mp4"), clearing(TIME), verdict("b.mp4"))
    there.extend(written)
    here.extend(write_entry(file, verdict("c.mp4"), here))
    assert here.lines[:3] == there.lines
    assert here.lines == read_quarantine(file).lines
    assert [each.snapshot for each in here.lines] == [1, 2, 3, 4]


@pytest.mark.parametrize("keep", [0, 1])
def test_a_file_that_was_replaced_gives_no_number_twice(tmp_path: Path, keep: int) -> None:
    file = tmp_path / "q.jsonl"
    known = write(file, verdict("a.mp4"), verdict("b.mp4"))
    file.unlink()
    write(file, *[verdict("a.mp4")][:keep], verdict("other.mp4"))
    before = file.read_bytes()
    with pytest.raises(CorpusError, match=rf"it has {keep + 1} lines, which do not start with the 2 lines read before"):
        write_entry(file, verdict("c.mp4"), known)
    assert file.read_bytes() == before


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_many_processes_at_once_lose_nothing(tmp_path: Path) -> None:
    file = tmp_path / "q.jsonl"
    each = [[verdict(name, frame) for frame in range(20)] for name in "ab"]
    writers = [multiprocessing.get_context("fork").Process(target=write, args=(file, *verdicts)) for verdicts in each]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()
    assert [writer.exitcode for writer in writers] == [0, 0]
    lines = read_quarantine(file).lines
    assert [each.snapshot for each in lines] == list(range(1, 41))
    for name in "ab":
        assert [each.frame for each in lines if each.path == name] == list(range(20))


def test_other_users_cannot_lock_the_file(tmp_path: Path) -> None:
    file = tmp_path / "q.jsonl"
    file.touch(0o644)
    write(file, verdict("a.mp4"))
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
