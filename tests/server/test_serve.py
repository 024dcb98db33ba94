"""The loop carries actions out in their order, and reports back what it alone can know."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from tests.server.named_corpus import SMALL_SPEC
from tests.server.peers import peers
from tests.server.queues import Queues, ToyPool
from v2v_protocol import NUMERICS_VERSION
from v2v_protocol.errors import IndexUnreadable, ProtocolError, V2VError, VideoChanged
from v2v_protocol.messages import Lease, Pong, Stop, WorkerHello, encode
from v2v_protocol.sample import Refusal
from v2v_protocol.spec import StreamSpec
from v2v_server import serve as serve_module
from v2v_server.broker.dispatcher import Dispatcher
from v2v_server.broker.leases import Cause, Loss, Request
from v2v_server.broker.state import (
    Action,
    AddToQuarantine,
    CheckVideo,
    Counters,
    GiveUp,
    Grant,
    ReportRefusal,
    ToConsumer,
    ToWorker,
)
from v2v_server.config import ServeConfig
from v2v_server.corpus.catalogue import Catalogue, CorpusPart
from v2v_server.corpus.sources.folder import Folder
from v2v_server.quarantine import QuarantineEntry, read_quarantine
from v2v_server.serve import Server
from v2v_server.supervise.pool import question_workers
from v2v_server.system.process import locked

VERDICT = QuarantineEntry(0, "v.mp4", "f", 0, "crash", "t")
RECORD = AddToQuarantine(VERDICT, Request(b"c", 0, 0))


class Scripted:
    """A dispatcher whose first tick says what the test says, and which writes down what it is told. It is its own
    broker."""

    def __init__(
        self, first: Sequence[Action] = (), after_record: Sequence[Action] = (), workers: Sequence[bytes] = ()
    ) -> None:
        self.first: list[Action] = list(first)
        self.after_record = after_record
        self.told: list[tuple[Any, ...]] = []
        self.times: list[float] = []
        self.blocked_reason = ""
        self.counters = Counters()
        self._there, self.broker = peers().broker, self
        for worker in workers:
            self._there.registry.add(worker, WorkerHello(worker.decode(), NUMERICS_VERSION, 2), 0.0)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._there, name)  # what there is to look at

    def tick(self, now: float) -> list[Action]:
        self.times.append(now)
        said, self.first = self.first, []
        return said

    def quarantine_recorded(self, record: AddToQuarantine, written: list[QuarantineEntry], now: float) -> list[Action]:
        self.told.append(("recorded", record, written))
        return list(self.after_record)

    def video_checked(self, missing: CheckVideo, found: bool, now: float) -> list[Action]:
        self.told.append(("looked for", missing, found))
        return []

    def not_granted(self, grants: Sequence[Grant], error: V2VError, now: float) -> list[Action]:
        self.told.append(("not granted", [grant.identity for grant in grants], str(error)))
        return []

    def worker_lost(self, identity: bytes, loss: Loss, now: float) -> list[Action]:
        self.told.append(("lost", identity, loss))
        return []

    def worker_gone(self, identity: bytes, now: float) -> list[Action]:
        self.told.append(("unreachable", identity))
        return []

    def consumer_lost(self, identity: bytes) -> None:
        self.told.append(("consumer lost", identity))

    def stop_workers(self) -> list[ToWorker]:
        return [ToWorker(b"w", encode(Stop()))]


def toys(workers: int) -> ToyPool:
    """A pool of workers toy1, toy2 and so on."""
    pool = ToyPool(lambda name, address: None)
    pool.scale(workers)
    pool.watch(0.0, 0)
    return pool


def served(
    dispatcher: Scripted,
    folder: Path,
    supervisor: ToyPool | None = None,
    transport: Queues | None = None,
    clock: Callable[[], float] | None = None,
    check: Callable[[str, str], None] | None = None,
    **settings: Any,
) -> Server:
    """A server that has made one turn."""
    stale: list[str] = []
    catalogue = SimpleNamespace(
        check=check, stale=stale, mark_stale=stale.append, source=Folder(folder), part=lambda: CorpusPart("", 0, 0)
    )
    server = Server(
        ServeConfig.load(None, {"videos": "videos", "workers": 0, "worker_bind": "tcp://127.0.0.1:*"} | settings),
        cast(Catalogue, catalogue),
        cast(Dispatcher, dispatcher),
        transport or Queues(),
        supervisor or toys(0),
        folder / "quarantine.jsonl",
        clock,
    )
    server.turn(0.0)
    return server


def test_a_record_is_written_and_reported_before_what_follows(tmp_path: Path) -> None:
    dispatcher = Scripted(
        [RECORD, ToConsumer(b"gone", encode(Pong()))], after_record=[ToConsumer(b"first", encode(Pong()))]
    )
    served(dispatcher, tmp_path)
    written = replace(VERDICT, snapshot=1)
    assert dispatcher.told == [("recorded", RECORD, [written]), ("consumer lost", b"first"), ("consumer lost", b"gone")]
    assert read_quarantine(tmp_path / "quarantine.jsonl").lines == (written,)


def test_a_record_that_cannot_be_written_is_said_and_the_server_goes_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "quarantine.jsonl").mkdir()
    dispatcher = Scripted([RECORD])
    served(dispatcher, tmp_path)
    assert dispatcher.told == [("recorded", RECORD, [])]
    assert "v.mp4 from frame 0: crash; the sequence is skipped once and will be tried again" in capsys.readouterr().err


@pytest.mark.parametrize("is_freed", [True, False])
def test_a_record_waits_for_another_writer_and_the_server_does_not(is_freed: bool, tmp_path: Path) -> None:
    file, times = tmp_path / "quarantine.jsonl", [0.0]
    dispatcher = Scripted([RECORD])
    with locked(file.with_suffix(".lock")):
        server = served(dispatcher, tmp_path, clock=lambda: times[0])
        times[0] = 1.0
        server.turn(0.0)
        assert dispatcher.told == []
        if not is_freed:
            times[0] = 2.0
            server.turn(0.0)
    times[0] = 3.0
    server.turn(0.0)
    assert dispatcher.told == [("recorded", RECORD, [replace(VERDICT, snapshot=1)] if is_freed else [])]


GRANTS = [Grant(name, (), SMALL_SPEC, True) for name in (b"1", b"2", b"3")]


@pytest.mark.parametrize("is_locked", [True, False])
def test_leases_that_cannot_be_completed_are_reported(
    is_locked: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """While the index is locked only one is tried: each attempt may wait for a disk."""
    tried: list[StreamSpec] = []

    def refuse(lease: Lease, catalogue: Catalogue, spec: StreamSpec) -> Lease:
        tried.append(spec)
        raise IndexUnreadable("locked") if is_locked else ProtocolError("damaged")

    monkeypatch.setattr(serve_module, "complete_lease", refuse)
    leases = [replace(grant, leases=(cast(Lease, number),)) for number, grant in enumerate(GRANTS)]
    dispatcher = Scripted([*leases[:1], ToConsumer(b"gone", encode(Pong())), *leases[1:]])
    served(dispatcher, tmp_path)
    assert len(tried) == (1 if is_locked else 3)
    assert [told for told in dispatcher.told if told[0] == "not granted"] == (
        [("not granted", [b"1", b"2", b"3"], "locked")]
        if is_locked
        else [("not granted", [name], "damaged") for name in (b"1", b"2", b"3")]
    )
    assert ("consumer lost", b"gone") in dispatcher.told  # all else is still carried out


@pytest.mark.parametrize("found", [True, False])
def test_what_is_looked_for_is_reported(found: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def check(id: str, fingerprint: str, sidecar: str) -> None:
        if not found:
            raise VideoChanged("a.mp4", None, "another file")

    missing = CheckVideo("a.mp4", "f", b"w", None, "cannot be read", Request(b"c", 0, 0))
    dispatcher = Scripted([missing, missing], workers=[b"w"])
    server = served(dispatcher, tmp_path, check=check)
    assert dispatcher.told == [("looked for", missing, found)] * 2
    assert cast(Any, server)._catalogue.stale == ([] if found else ["a.mp4"] * 2)
    said = capsys.readouterr().err
    assert said.count("worker w failed on a.mp4, which is on this host as catalogued: cannot be read") == found


def test_the_loop_reads_no_sidecar_for_a_worker_of_this_host(tmp_path: Path) -> None:
    """What that worker has read lies here too: a folder of masks would stop the loop for seconds."""
    supervisor = toys(1)
    asked: list[str] = []
    missing = CheckVideo("a.mp4", "f", b"toy1", None, "changed", Request(b"c", 0, 0), ".masks/")
    elsewhere = replace(missing, identity=b"elsewhere")
    dispatcher = Scripted([missing, elsewhere], workers=[b"toy1", b"elsewhere"])
    served(dispatcher, tmp_path, supervisor, check=lambda id, mark, ending: asked.append(ending))
    assert dispatcher.told == [("looked for", missing, False), ("looked for", elsewhere, True)]
    assert asked == [".masks/"]


def test_what_holds_everybody_up_is_said_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    dispatcher = Scripted([])
    now = [0.0]
    server = served(dispatcher, tmp_path, clock=lambda: now[0])
    for reason, seconds in (("locked", 1.0), ("", 1.0), ("locked", 1.0), ("locked", 6.0), ("locked", 60.0)):
        dispatcher.blocked_reason = reason
        now[0] += seconds
        server.turn(0.0)
    assert capsys.readouterr().err.count("no samples are started: locked") == 1


def test_a_worker_given_up_is_reported_with_what_its_loss_means(tmp_path: Path) -> None:
    supervisor = toys(1)
    dispatcher = Scripted([GiveUp(b"toy1", "slept"), GiveUp(b"elsewhere", "slept")], workers=[b"toy1", b"elsewhere"])
    served(dispatcher, tmp_path, supervisor)
    assert dispatcher.told == [
        ("lost", b"toy1", Loss(Cause.HUNG, "slept")),
        ("lost", b"elsewhere", Loss(Cause.UNEXPLAINED, "slept", for_all=False)),
    ]


def test_a_death_is_reported_with_its_cause(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    supervisor = toys(2)
    supervisor.kill(b"toy1", Cause.CRASHED)
    dispatcher = Scripted(workers=[b"toy1"])
    served(dispatcher, tmp_path, supervisor)
    assert dispatcher.told == [("lost", b"toy1", Loss(Cause.CRASHED, "died"))]
    assert supervisor.workers == [b"toy2", b"toy3"]
    assert "worker toy1 died; its leases go to other workers" in capsys.readouterr().err


@pytest.mark.parametrize("watched", [True, False])
def test_who_cannot_be_reached_is_reported_unless_its_end_will_be(watched: bool, tmp_path: Path) -> None:
    """How a process of ours ended says whether the sample is to blame; that it is not there any more does not."""
    supervisor = toys(int(watched))
    dispatcher = Scripted([ToWorker(b"toy1", encode(Stop()))], workers=[b"toy1"])
    served(dispatcher, tmp_path, supervisor)
    assert dispatcher.told == ([] if watched else [("unreachable", b"toy1")])


def test_a_time_in_which_the_server_was_stopped_is_no_silence_of_others(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """No deadline may run out: its workers were stopped too, or their answers were not read."""
    dispatcher = Scripted()
    monkeypatch.setattr(serve_module, "time", SimpleNamespace(monotonic=lambda: 50.0 + 100.0 * len(dispatcher.times)))
    server = served(dispatcher, tmp_path)
    server.turn(0.0)
    server.turn(0.0)
    assert dispatcher.times == [50.0, 51.0, 52.0]


def test_more_workers_than_can_be_of_use_are_questioned() -> None:
    assert "--workers 500 on 2 cores" in question_workers(500, 2)
    assert question_workers(8, 2) == ""


def test_more_workers_come_while_consumers_wait_and_leave_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    dispatcher, supervisor = Scripted(), toys(0)
    now = [0.0]
    monkeypatch.setattr(serve_module, "Clock", lambda: lambda: now[0])
    dispatcher.workers, dispatcher.waiting_share, dispatcher.idle_share = 2, 1.0, 0.0  # type: ignore[attr-defined]
    server = served(dispatcher, tmp_path, supervisor, workers="2:6", scale_seconds=6.0)
    supervisor.scale(2)

    def seconds(count: int) -> None:
        for _ in range(10 * count):
            now[0] += 0.11
            server.turn(0.0)
            dispatcher.workers = len(supervisor.workers)

    seconds(8)
    assert supervisor.wanted == 6
    dispatcher.waiting_share, dispatcher.idle_share = 0.0, 0.9  # type: ignore[attr-defined]
    seconds(20)
    assert supervisor.wanted == 2
    said = capsys.readouterr().err
    assert "workers: 3 from now on, because 100% of consumers waited and 0% of workers were idle in 1 s" in said
    assert "workers: 2 from now on, because at the busiest 0% of consumers waited and 90%" in said


def test_with_json_every_line_is_an_object_and_one_on_a_sample_has_its_identity(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    at = peers()
    at.hello(b"c", seed=5)
    request = Request(b"c", 2, 7)
    dispatcher = Scripted([ReportRefusal(Refusal("a.mp4", 7, "cut short"), request), AddToQuarantine(VERDICT, request)])
    dispatcher._there = at.broker
    server = served(dispatcher, tmp_path, log_format="json")
    server.close()
    lines: list[dict[str, Any]] = [json.loads(line) for line in capsys.readouterr().err.splitlines()]
    assert all({"time", "level", "text"} <= line.keys() for line in lines)
    passed_over, condemned = (next(line for line in lines if word in line["text"]) for word in ("passed", "quarantine"))
    session = at.broker.sessions.get(b"c")
    assert session is not None
    assert passed_over["sample"] == {
        "spec_digest": session.spec.digest, "catalogue_digest": "c" * 32, "numerics_version": NUMERICS_VERSION,
        "seed": 5, "epoch": 2, "index": 7,
    }  # fmt: skip
    assert passed_over["text"].startswith("passed over a.mp4 at frame 7: cut short")
    assert (passed_over["level"], passed_over["video"]) == ("warning", "a.mp4")
    assert (condemned["sample"], condemned["video"]) == (passed_over["sample"], "v.mp4")
    status = next(line for line in lines if "slow_part" in line)
    assert status["workers"] == 0
    assert lines[-1]["totals"]["samples"] == 0


@pytest.mark.parametrize(("workers", "is_ready"), [(0, True), (1, False)])
def test_the_end_is_summed_up_unless_the_server_was_never_ready(
    workers: int, is_ready: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    supervisor = toys(2)
    served(Scripted(), tmp_path, supervisor, workers=workers).close()  # it tells a worker that is not there
    assert supervisor.running == 0
    said = capsys.readouterr().err
    assert ("in total 0 samples" in said, "\nfaults 0\n" in said) == (is_ready, is_ready)


class Recording(Scripted):
    """Adds what was written to the quarantine, as the dispatcher does."""

    def quarantine_recorded(self, record: AddToQuarantine, written: list[QuarantineEntry], now: float) -> list[Action]:
        self.quarantine.extend(written)
        return super().quarantine_recorded(record, written, now)


def test_a_sequence_that_ends_two_workers_while_the_file_is_locked_is_written_once(tmp_path: Path) -> None:
    """A second entry would refuse the whole video."""
    file, times = tmp_path / "quarantine.jsonl", [0.0]
    both = [AddToQuarantine(VERDICT, Request(session, 0, 1)) for session in (b"one", b"other")]
    dispatcher = Recording(both)
    with locked(file.with_suffix(".lock")):
        server = served(dispatcher, tmp_path, clock=lambda: times[0])
        times[0] = 1.0
        server.turn(0.0)
        assert dispatcher.told == []
    times[0] = 1.5
    server.turn(0.0)
    assert [record for _, record, _ in dispatcher.told] == both
    assert [each.frame for each in read_quarantine(file).lines] == [VERDICT.frame]
