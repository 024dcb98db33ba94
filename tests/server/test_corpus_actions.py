"""What the server does with its corpus for the dispatcher."""

from __future__ import annotations

import fcntl
from pathlib import Path
from typing import Any

from v2v_server.broker.actions import Action, AddToQuarantine
from v2v_server.broker.leases import Request
from v2v_server.corpus_actions import CorpusActions
from v2v_server.quarantine.file import read_quarantine
from v2v_server.quarantine.snapshots import Quarantine, QuarantineEntry


class Recorder:
    """Stands for the dispatcher: adds what was written to the quarantine."""

    def __init__(self, quarantine: Quarantine) -> None:
        self.quarantine = quarantine
        self.recorded: list[AddToQuarantine] = []

    def quarantine_recorded(self, record: AddToQuarantine, written: list[QuarantineEntry], now: float) -> list[Action]:
        self.quarantine.extend(written)
        self.recorded.append(record)
        return []


def test_a_sequence_that_ends_two_workers_while_the_file_is_locked_is_written_once(tmp_path: Path) -> None:
    """A second entry would refuse the whole video."""
    quarantine, file = Quarantine(), tmp_path / "quarantine.jsonl"
    dispatcher: Any = Recorder(quarantine)
    catalogue: Any = None
    corpus = CorpusActions(catalogue, dispatcher, quarantine, file, lambda: 0.0, lambda *text, **about: None)
    entry = QuarantineEntry(0, "a.mp4", "1-2", 5, "a worker was ended by SIGSEGV over it", "2026-11-25T00:00:00+00:00")
    both = [AddToQuarantine(entry, Request(session, 0, 1)) for session in (b"one", b"other")]
    with file.open("a+b") as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        for each in both:
            assert corpus.record(each) == []
        assert corpus.retry() == []
        assert dispatcher.recorded == []
    corpus.retry()
    assert dispatcher.recorded == both
    assert [each.frame for each in read_quarantine(file).lines] == [5]
