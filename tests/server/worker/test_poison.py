"""Poison: which death refuses which candidate, under which snapshot, and who can tell afterwards."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

import pytest

from tests.server.named_corpus import SMALL_SPEC, corpus, video
from tests.server.peers import DEADLINE, Peers, peers
from v2v_protocol.errors import SampleUnavailable, VideoError
from v2v_protocol.messages import Begun, Goodbye, Lease
from v2v_protocol.sample import Refusal, Sample
from v2v_protocol.spec import StreamSpec
from v2v_server.broker.leases import ALONE_AFTER, Cause
from v2v_server.corpus.catalogue import Catalogue
from v2v_server.quarantine import Quarantine, QuarantineEntry, clearing
from v2v_server.worker.job import ClipJob, SampleJob
from v2v_tools import remake as remake_module
from v2v_tools.remake import remake

TIME = "2024-02-29T12:00:00+00:00"
BLAMING = (Cause.CRASHED, Cause.HUNG)
VIDEOS = corpus(*(video(f"v{number}.mp4") for number in range(5)))


def against(lease: Lease, reason: str = "a worker died over it", snapshot: int = 1) -> QuarantineEntry:
    return QuarantineEntry(snapshot, lease.video, lease.fingerprint, lease.start_frame, reason, TIME)


def asked(*indices: int, at: Peers | None = None, **hello: Any) -> Peers:
    """A server that a consumer asked for these samples of epoch 0; workers are still to join."""
    at = at or peers()
    at.hello(**hello)
    at.want(*indices)
    return at


def poisoned(at: Peers, cause: Cause, index: int = 0, worker: bytes = b"w") -> Lease:
    """The next worker begins the sample and dies of that cause."""
    at.join(worker)
    lease = at.begin(worker)
    assert lease.indices == (index,)
    at.die(worker, cause)
    return lease


# --- which deaths count -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("cause", list(Cause))
def test_a_sample_that_was_not_begun_is_never_refused(cause: Cause) -> None:
    at = asked(0)
    for _ in range(10):
        at.join()
        assert at.leases[b"w"][0].candidate == 0
        at.die(cause=cause)
    assert at.recorded == []


@pytest.mark.parametrize("cause", BLAMING)
def test_a_crash_or_a_hang_refuses_the_begun_candidate_at_once(cause: Cause) -> None:
    at = asked(0, 1)
    lease = poisoned(at, cause)
    assert at.recorded == [against(lease)]
    assert at.quarantine.lines == (against(lease),)
    at.join()
    first, second = at.leases[b"w"]
    assert (first.indices, first.candidate, first.quarantine) == ((0,), 1, 1)
    assert (second.indices, second.candidate, second.quarantine) == ((1,), 0, 1)
    reason = "sequence in quarantine snapshot 1: a worker died over it"
    assert first.refusals == {
        "refusals": [{"video": lease.video, "frame": None, "reason": reason, "kind": "quarantined"}],
    }
    assert first.video != lease.video
    assert second.refusals == {"refusals": []}
    at.work_off()
    assert at.samples() == [(0, 0), (0, 1)]
    # The operator reads the verdict; what the quarantine refuses from then on is no news.
    assert at.passed_over == []
    assert at.broker.counters.refused_candidates == 1


@pytest.mark.parametrize("answered", [True, False])
def test_what_was_begun_along_with_a_result_is_to_blame_like_any_other(answered: bool) -> None:
    """Whether or not anybody waits for that result."""
    at = asked(0)
    at.join()
    if not answered:
        at.consumer_says(b"c", Goodbye())
        at.hello()
    at.want(1)
    _, second = at.leases[b"w"]
    at.begin()
    at.finish(begins=second.lease)
    assert at.samples() == ([(0, 0)] if answered else [])
    at.die(cause=Cause.CRASHED, text="died")
    assert at.recorded == [against(second)]


def test_only_the_worker_that_holds_a_lease_begins_it() -> None:
    at = asked(0, 1)
    at.join(b"other", credit=1)
    at.join(b"w", credit=1)
    (others,) = at.leases[b"other"]
    at.begin(b"w")
    at.finish(b"w", begins=others.lease)
    at.die(b"other", cause=Cause.CRASHED)
    assert at.recorded == []


def test_a_worker_that_hangs_is_blamed_through_its_end() -> None:
    at = asked(0, 1)
    at.join()
    lease = at.begin()
    at.tick(DEADLINE + 1)
    assert at.recorded == [against(lease, f"a worker gave no answer for {DEADLINE:g} s over it")]


def test_a_worker_of_another_host_that_hangs_is_not_blamed_at_once() -> None:
    at = peers()
    at.remote = {b"w"}
    at.hello()
    at.want(0)
    at.join()
    at.begin()
    at.tick(DEADLINE + 1)
    assert (at.given_up, at.recorded) == ([b"w"], [])
    at.join(b"w2")
    assert at.leases[b"w2"][0].candidate == 0


def test_unexplained_deaths_make_it_run_alone_and_one_more_refuses_it() -> None:
    at = asked(0, 1, 2, 3)
    for _ in range(ALONE_AFTER):
        lease = poisoned(at, Cause.UNEXPLAINED)
        assert (lease.candidate, at.recorded) == (0, [])
    at.join()
    # Alone on its worker, though that has room and others wait.
    assert [lease.indices for lease in at.leases[b"w"]] == [(0,)]
    assert at.broker.waiting == 3
    at.join(b"other")
    assert [lease.indices for lease in at.leases[b"other"]] == [(1,), (2,)]
    at.begin()
    # Pre-emption says nothing, not even now.
    at.die(cause=Cause.KILLED)
    assert at.recorded == []
    at.join()
    assert [lease.indices for lease in at.leases[b"w"]] == [(0,)]
    at.begin()
    at.die(cause=Cause.UNEXPLAINED, text="exited with status 1")
    # Memory that its spec took, for instance: no verdict for others.
    assert at.recorded == [replace(against(lease, "a worker exited with status 1 over it"), spec=SMALL_SPEC.digest)]
    at.join()
    # A new candidate has no deaths to its name.
    assert [(lease.indices, lease.candidate) for lease in at.leases[b"w"]] == [((0,), 1), ((3,), 0)]
    at.work_off()
    at.work_off(b"other")
    assert sorted(at.samples()) == [(0, 0), (0, 1), (0, 2), (0, 3)]


def test_deaths_count_separately_for_each_candidate() -> None:
    at = asked(0)
    candidates = [poisoned(at, Cause.UNEXPLAINED).candidate for _ in range(3 * (ALONE_AFTER + 1))]
    assert candidates == [number // (ALONE_AFTER + 1) for number in range(len(candidates))]
    assert len(at.recorded) == 3


def test_a_lone_task_whose_video_fails_runs_in_company_again() -> None:
    at = asked(0, 1)
    for _ in range(ALONE_AFTER):
        poisoned(at, Cause.UNEXPLAINED)
    at.join()
    assert len(at.leases[b"w"]) == 1
    at.fail()
    assert [(lease.indices, lease.candidate) for lease in at.leases[b"w"]] == [((0,), 1), ((1,), 0)]


def test_a_consumer_that_leaves_takes_its_lone_task_along_and_frees_the_worker_kept_for_it() -> None:
    at = asked(0)
    for _ in range(ALONE_AFTER):
        poisoned(at, Cause.UNEXPLAINED)
    at.join(b"w1", credit=3)
    at.begin(b"w1")
    at.hello(b"other", batch_size=8)
    at.want(*range(8), identity=b"other")
    at.join(b"w2", credit=3)
    at.die(b"w1", Cause.KILLED)
    at.finish(b"w2")
    assert (at.broker.waiting, len(at.leases[b"w2"])) == (6, 2)
    at.dispatcher.consumer_lost(b"c")
    assert at.broker.waiting == 5
    at.tick(0.1)
    assert len(at.leases[b"w2"]) == 3
    at.work_off(b"w2")
    assert (at.broker.waiting, len(at.samples(b"other"))) == (0, 8)


# --- the verdict ------------------------------------------------------------------------------------------------------


def test_a_spec_that_substitutes_nothing_hears_of_it_after_the_record() -> None:
    at = asked(3, on_bad_video="raise")
    at.join()
    at.begin()
    at.sent.clear()
    at.die(cause=Cause.CRASHED, text="was ended by SIGSEGV")
    at.join()
    (message,) = at.unavailable()
    assert message.text.endswith("sequence in quarantine snapshot 1: a worker was ended by SIGSEGV over it")
    assert [kind for kind, _ in at.sent] == ["record", "to consumer"]
    assert not at.leases[b"w"]


def test_one_sequence_that_crashes_for_several_consumers_gets_one_verdict() -> None:
    """Two verdicts on one sequence would condemn the whole video without having looked at any other of it."""
    at = peers()
    for identity in (b"c", b"d"):
        at.hello(identity)
        at.want(0, identity=identity)
    for worker in (b"w1", b"w2"):
        at.join(worker, credit=1)
        at.begin(worker)
    held = [*at.leases[b"w1"], *at.leases[b"w2"]]
    assert held[0].start_frame == held[1].start_frame
    at.die(b"w1", Cause.CRASHED)
    at.die(b"w2", Cause.CRASHED)
    assert at.recorded == [against(held[0])]
    at.join()
    assert [(lease.candidate, lease.quarantine) for lease in at.leases[b"w"]] == [(1, 1), (1, 1)]
    at.work_off()
    assert at.samples(b"c") == at.samples(b"d") == [(0, 0)]


def test_the_verdict_of_a_consumer_that_left_is_not_asked_for() -> None:
    at = asked(0)
    at.join()
    at.begin()
    at.dispatcher.consumer_lost(b"c")
    at.die(cause=Cause.CRASHED)
    assert at.recorded == []


def test_when_it_cannot_be_written_there_is_no_snapshot_and_the_sample_says_what_happened() -> None:
    at = peers()
    at.writable = False
    at.hello()
    at.want(0)
    lease = poisoned(at, Cause.CRASHED)
    assert at.quarantine.latest == 0
    at.join()
    (second,) = at.leases[b"w"]
    assert (second.candidate, second.quarantine) == (1, 0)
    refusal = Refusal(lease.video, None, "a worker died over it")
    assert Refusal(**second.refusals["refusals"][0]) == refusal
    assert at.passed_over == [refusal]
    at.work_off()
    # The next to ask meets it again; and the next verdict that can be written has the next number.
    at.writable = True
    at.hello()
    at.want(0)
    poisoned(at, Cause.CRASHED)
    assert at.quarantine.lines == (against(lease),)


# --- snapshots --------------------------------------------------------------------------------------------------------


def in_quarantine(index: int = 0, candidate: int = 0) -> QuarantineEntry:
    """A verdict on what index 0 of epoch 0 is made from."""
    at = asked(index)
    at.join()
    for _ in range(candidate):
        at.fail()
    return against(at.begin())


def test_a_consumer_that_resumes_an_older_snapshot_keeps_it() -> None:
    verdict = in_quarantine()
    at = peers(quarantine=Quarantine([verdict]))
    assert at.hello(quarantine=0).quarantine == 0
    assert at.hello(b"new").quarantine == 1
    for identity in (b"c", b"new"):
        at.want(0, 1, identity=identity)
    at.join(credit=8)
    assert {
        (at.asked_by(lease), lease.indices[0]): (lease.candidate, lease.quarantine) for lease in at.leases[b"w"]
    } == {
        (b"c", 0): (0, 0),
        (b"c", 1): (0, 0),
        (b"new", 0): (1, 1),
        (b"new", 1): (0, 1),
    }
    # A new verdict is for those who go on under the newest.
    crashed = next(lease for lease in at.leases[b"w"] if (at.asked_by(lease), lease.indices) == (b"new", (1,)))
    at.worker_says(b"w", Begun(crashed.lease))
    at.die(cause=Cause.CRASHED)
    assert at.quarantine.latest == 2
    at.join(credit=8)
    assert {
        (at.asked_by(lease), lease.indices[0]): (lease.candidate, lease.quarantine) for lease in at.leases[b"w"]
    } == {
        (b"c", 0): (0, 0),
        (b"c", 1): (0, 0),
        (b"new", 0): (1, 2),
        (b"new", 1): (1, 2),
    }


def test_a_crash_under_an_older_snapshot_moves_only_that_sample() -> None:
    """The verdict is there already, in a snapshot that this consumer does not see."""
    verdict = in_quarantine()
    at = asked(0, at=peers(quarantine=Quarantine([verdict])), quarantine=0)
    poisoned(at, Cause.CRASHED)
    assert at.recorded == []
    at.join()
    (lease,) = at.leases[b"w"]
    assert (lease.candidate, lease.quarantine) == (1, 0)
    assert lease.refusals["refusals"][0]["reason"] == "a worker died over it"
    at.work_off()
    assert at.samples() == [(0, 0)]


def test_lines_that_others_wrote_meanwhile_are_taken_up_with_the_own_verdict() -> None:
    """Another server's verdict and a person's clearing have the numbers before it: the new snapshot is made of all."""
    at = asked(0, 1, at=peers(quarantine=Quarantine([in_quarantine()])))
    at.join()
    assert [lease.candidate for lease in at.leases[b"w"]] == [1, 0]
    crashed = at.leases[b"w"][1]
    at.worker_says(b"w", Begun(crashed.lease))
    foreign = [replace(clearing(TIME), snapshot=2), replace(in_quarantine(2), snapshot=3)]
    at.others = foreign
    at.die(cause=Cause.CRASHED)
    assert at.quarantine.lines[1:] == (*foreign, against(crashed, snapshot=4))
    at.want(2)
    at.join(credit=3)
    # Index 0 starts over from its first candidate, which the clearing admits again.
    found = {lease.indices[0]: (lease.candidate, lease.quarantine) for lease in at.leases[b"w"]}
    assert found == {0: (0, 4), 1: (1, 4), 2: (1, 4)}


# --- made again -------------------------------------------------------------------------------------------------------


def remade(
    monkeypatch: pytest.MonkeyPatch,
    quarantine: Quarantine,
    snapshot: int,
    index: int,
    failing: tuple[str, ...] = (),
    catalogue: Catalogue = VIDEOS,
    spec: StreamSpec = SMALL_SPEC,
) -> SampleJob:
    """The job that remake() works on in the end, when these videos cannot be decoded."""
    jobs: list[SampleJob] = []

    def decode_for(clip: ClipJob, indices: tuple[int, ...], root: object) -> tuple[None]:
        assert indices == (index,)
        if clip.video in failing:
            raise VideoError(clip.video, 7, "cut short")
        return (None,)

    def make_sample(job: SampleJob, decoded: None, sidecars: object) -> Sample:
        jobs.append(job)
        return cast(Sample, job)

    monkeypatch.setattr(remake_module, "decode_for", decode_for)
    monkeypatch.setattr(remake_module, "make_sample", make_sample)
    remake(catalogue, spec, seed=0, epoch=0, index=index, arrays=("voxels",), quarantine=quarantine, snapshot=snapshot)
    (job,) = jobs
    return job


def test_remake_chooses_what_the_dispatcher_chose(monkeypatch: pytest.MonkeyPatch) -> None:
    """Crashes, hangs, decode errors and pinned consumers: every finished lease of a long stream can be made again."""
    at = peers(VIDEOS)
    lethal = {("v1.mp4", frame) for frame in range(0, 20, 4)} | {("v3.mp4", 0)}
    failing = ("v4.mp4",)
    at.hello(batch_size=25)
    at.want(*range(50))
    done: list[Lease] = []
    deaths = 0
    while len(done) < 50:
        at.join(b"w%d" % deaths, credit=3)
        worker = b"w%d" % deaths
        while True:
            if not at.leases[worker]:
                break
            lease = at.begin(worker)
            if (lease.video, lease.start_frame) in lethal:
                at.die(worker, BLAMING[deaths % 2])
                deaths += 1
                break
            if lease.video in failing:
                at.fail(worker)
            else:
                done.append(at.finish(worker))
    assert sorted(at.samples()) == [(0, index) for index in range(50)]
    assert at.quarantine.latest == deaths >= 2
    assert {lease.quarantine for lease in done} > {0}
    assert any(len(lease.refusals["refusals"]) > 1 for lease in done)
    for lease in done:
        again = remade(monkeypatch, at.quarantine, lease.quarantine, lease.indices[0], failing)
        assert again == SampleJob.of(lease)


def test_remake_says_what_the_dispatcher_says_when_nothing_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    at = asked(0, at=peers(corpus(video("bad.mp4", frames=5))))
    poisoned(at, Cause.CRASHED)
    at.join()
    (message,) = at.unavailable()
    assert message.text.count("sequence in quarantine snapshot 1: a worker died over it") == 1
    only = corpus(video("bad.mp4", frames=5))
    with pytest.raises(SampleUnavailable) as raised:
        remade(monkeypatch, at.quarantine, 1, 0, catalogue=only)
    assert raised.value.text == f"sample 0 of epoch 0: {message.text}"
