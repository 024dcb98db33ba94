"""The dispatcher with fake peers: which peer gets what, what a death changes, and that no peer can stop it."""

from __future__ import annotations

import gc
import math
import weakref
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import hypothesis.strategies as st
import msgpack
import numpy as np
import pytest
from hypothesis import given, settings

from tests.protocol.persisted_values import messages
from tests.server.named_corpus import SMALL, SMALL_SPEC, corpus, video
from tests.server.peers import DEADLINE, IDLE, Peers, answer_to, frames_of, peers, sample_frames, serving
from v2v_protocol import NUMERICS_VERSION, PROTOCOL_VERSION
from v2v_protocol.errors import ProtocolError
from v2v_protocol.messages import (
    LARGEST_HEADER_BYTES,
    LARGEST_REQUEST_BYTES,
    Begun,
    Denied,
    ErrorCode,
    Goodbye,
    Hello,
    LeaseFailed,
    Message,
    Ping,
    Pong,
    Result,
    Stop,
    Want,
    WorkerHello,
    encode,
    encode_sample,
)
from v2v_protocol.sample import Form
from v2v_server.broker import consumers, workers
from v2v_server.broker.admission import MOST_BATCH_SIZE, MOST_TABLES
from v2v_server.broker.assignment import work_seconds
from v2v_server.broker.consumers import MOST_FAULTS
from v2v_server.broker.leases import REST_SECONDS, SILENCE_SECONDS, Cause, Loss, Request
from v2v_server.broker.session import GONE_SECONDS, SILENT_SECONDS
from v2v_server.broker.state import AddToQuarantine, Disconnect, ToConsumer
from v2v_server.broker.workers import check_result
from v2v_server.quarantine import Quarantine, QuarantineEntry
from v2v_server.schedule import MOST_CANDIDATES
from v2v_server.video.frame_index import FrameIndex


def refused(replies: Sequence[Message], code: ErrorCode) -> str:
    """The text of the one reply, which must be a refusal of that kind."""
    (reply,) = replies
    assert isinstance(reply, Denied)
    assert reply.code == code
    return reply.text


# --- the main path ----------------------------------------------------------------------------------------------------


def test_a_sample_goes_from_want_to_answer() -> None:
    at = peers()
    at.join()
    at.hello(seed=2**64 - 1)
    assert at.want(7, epoch=3) == []
    lease = at.begin()
    assert (lease.epoch, lease.indices, lease.seed) == (3, (7,), 2**64 - 1)
    assert (at.asked_by(lease), lease.arrays, lease.candidate) == (b"c", ("voxels",), 0)
    assert (lease.spec, lease.spec_digest) == (SMALL_SPEC.canonical(), SMALL_SPEC.digest)
    assert (lease.refusals, lease.thresholds) == ({"refusals": []}, ())
    assert lease.fingerprint == f"fingerprint of {lease.video}"
    frames = FrameIndex.from_bytes(lease.frame_index)
    assert frames.position(lease.start_frame, SMALL.frames_needed) >= 0
    payload = answer_to(lease)
    at.worker_says(b"w", Result(lease.lease), *payload)
    assert at.samples() == [(3, 7)]
    # The very objects: the header is read, nothing is copied.
    assert [id(frame) for frame in at.frames[b"c"][-1]] == [id(frame) for frame in payload]
    counters = at.broker.counters
    assert (counters.samples, counters.batches, counters.cpu_seconds) == (1, 0.25, 0.1)
    assert counters.bytes == sum(len(frame) for frame in payload[1:])
    assert counters.faults == 0


def test_thresholds_travel_exactly_and_unknown_rates_as_zero() -> None:
    listed = replace(video("v.mp4", rate=math.nan), threshold_pos=0.1, threshold_neg=1 / 3)
    at = peers(corpus(listed))
    at.join()
    at.hello()
    at.want(0)
    lease = at.begin()
    assert lease.thresholds == (0.1, 1 / 3)
    assert lease.frames_per_second == 0.0


# --- refusals to consumers --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("spec", "arrays", "batch_size", "text"),
    [
        ({"colour": 1}, ("voxels",), 4, "unknown spec key 'colour'"),
        ({"recipe": "papers"}, ("voxels",), 4, "unknown recipe"),
        ({"recipe": {"self": 1}}, ("voxels",), 4, "unknown recipe key 'self'"),
        ({"recipe": {"bins": 1.5}}, ("voxels",), 4, "recipe bins = 1.5"),
        ({}, (), 4, "arrays"),
        ({}, ("depth",), 4, "unknown array 'depth'"),
        ({}, ("voxels",), 0, f"batch_size = 0: give 1 to {MOST_BATCH_SIZE}"),
        ({}, ("voxels",), MOST_BATCH_SIZE + 1, f"batch_size = {MOST_BATCH_SIZE + 1}"),
        ({"recipe": "paper"}, ("voxels",), 4, "none of the 5 videos gives a sequence; v0.mp4: 100 frames"),
        # A sample that no message could carry must not be tried: it would only exhaust the worker's memory.
        (
            {"recipe": {"crop_height_px": 16_384, "crop_width_px": 16_384, "resize_scale": [1, 100], "bins": 9}},
            ("voxels",),
            4,
            "the limit is 2147483648",
        ),
    ],
)
def test_a_refused_hello_names_its_reason(
    spec: dict[str, Any], arrays: tuple[str, ...], batch_size: int, text: str
) -> None:
    at = peers(corpus(*(video(f"v{number}.mp4", height_px=200, width_px=200) for number in range(5))))
    assert text in refused(at.consumer_says(b"c", Hello(spec, arrays, batch_size, 0)), ErrorCode.SPEC)
    assert len(at.broker.sessions) == 0


def test_over_credit_and_out_of_range_take_nothing() -> None:
    at = peers()
    assert at.hello(batch_size=2).credit == 4
    text = "5 more samples asked while 0 are unanswered; the credit is 4"
    assert text in refused(at.want(0, 1, 2, 3, 4), ErrorCode.CREDIT)
    assert "index 50 of an epoch of 50" in refused(at.want(0, 50), ErrorCode.RANGE)
    assert "epoch = 4294967296" in refused(at.want(0, epoch=2**32), ErrorCode.RANGE)
    refused(at.want(0, 2**64 - 1), ErrorCode.RANGE)
    refused(at.want(0, epoch=2**64 - 1), ErrorCode.RANGE)
    at.join()
    assert not at.leases[b"w"]
    at.want(49, epoch=2**32 - 1)
    at.work_off()
    assert at.samples() == [(2**32 - 1, 49)]


def test_credit_counts_workers_that_are_still_starting() -> None:
    """A server is ready with its first worker, and the credit of a consumer that connects then holds for an epoch."""
    at = peers(expected_workers=20)
    assert at.hello(batch_size=12).credit == 40
    for number in range(3):
        at.join(b"w%d" % number)
    assert at.hello(batch_size=12).credit == 40
    for number in range(25):
        at.join(b"elsewhere %d" % number)
    assert at.hello(batch_size=12).credit == 56
    assert peers(expected_workers=4096).hello(batch_size=12).credit == 400


def test_a_full_server_is_busy_to_newcomers_only(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(consumers, "MOST_SESSIONS", 3)
    at = peers()
    for identity in (b"c1", b"c2", b"c3"):
        at.hello(identity)
    hello = Hello({}, ("voxels",), 4, 0)
    assert "3 consumers" in refused(at.consumer_says(b"c4", hello), ErrorCode.BUSY)
    assert "Hello" in refused(at.want(0, identity=b"c4"), ErrorCode.UNKNOWN_SESSION)
    # Admitted consumers may connect again, and one that leaves makes room, as does one that is gone or silent.
    at.hello(b"c2", seed=1)
    at.consumer_says(b"c3", Goodbye())
    at.hello(b"c4")
    assert len(at.broker.sessions) == 3
    at.now += SILENT_SECONDS
    at.consumer_says(b"c2", Ping())
    at.consumer_says(b"c4", Ping())
    at.dispatcher.consumer_gone(b"c4", at.now)
    at.hello(b"c5")
    assert {session.identity for session in at.broker.sessions} == {b"c2", b"c5"}


# --- workers that die, hang or fail -----------------------------------------------------------------------------------


@pytest.mark.parametrize(("how", "lost"), [("goodbye", 0), ("unreachable", 1), ("other numerics", 0)])
def test_a_worker_that_leaves_gives_its_work_to_others_without_blame(how: str, lost: int) -> None:
    at = serving(0, worker=b"w1")
    at.begin(b"w1")
    at.join(b"w2")
    if how == "goodbye":
        at.worker_says(b"w1", Goodbye())
    elif how == "other numerics":
        at.worker_says(b"w1", WorkerHello("w1", NUMERICS_VERSION + 1, 2))
        text = refused(at.told[b"w1"], ErrorCode.VERSION)
        assert f"version {NUMERICS_VERSION + 1}, the server's is {NUMERICS_VERSION}" in text
    else:
        for _ in range(3):
            at.carry_out(at.dispatcher.worker_gone(b"w1", 0.0))
            at.carry_out(at.dispatcher.worker_gone(b"never there", 0.0))
    assert (at.broker.workers, at.broker.counters.workers_lost) == (1, lost)
    assert at.leases[b"w2"][0].candidate == 0
    at.work_off(b"w2")
    assert at.samples() == [(0, 0)]


def test_a_video_that_only_the_workers_host_lacks_is_made_elsewhere() -> None:
    """Or the bytes behind a name would depend on who was asked. Storage may come back, so the worker only rests."""
    at = peers()
    at.join(b"w1", credit=1)
    at.join(b"w2", credit=1)
    at.hello()
    at.want(3)
    first = at.fail(b"w1", reason="cannot be read: No such file or directory", frame=None, here=True)
    (second,) = at.leases[b"w2"]
    assert (second.video, second.candidate, second.refusals) == (first.video, 0, {"refusals": []})
    at.want(4)
    assert not at.leases[b"w1"]
    at.work_off(b"w2")
    at.tick(REST_SECONDS - 0.1)
    at.want(5, 6)
    assert not at.leases[b"w1"]
    at.tick(0.2)
    assert len(at.leases[b"w1"]) == 1
    for name in (b"w1", b"w2"):
        at.work_off(name)
    assert sorted(at.samples()) == [(0, 3), (0, 4), (0, 5), (0, 6)]
    counters = at.broker.counters
    assert (counters.missing_videos, counters.refused_candidates, counters.faults) == (1, 0, 1)


def trouble(at: Peers) -> str:
    (pong,) = at.consumer_says(b"c", Ping())
    assert isinstance(pong, Pong)
    return pong.trouble


def test_waiting_consumers_learn_that_no_worker_can_make_a_sample() -> None:
    at = peers()
    assert "no worker is connected" in trouble(at)
    at.join(b"w1", credit=1)
    at.hello()
    at.want(3)
    assert not trouble(at)
    at.fail(b"w1", reason="No such file or directory", frame=None, here=True)
    assert "can read its videos" in trouble(at)
    assert "No such file or directory" in trouble(at)
    at.tick(REST_SECONDS)  # it tries again, and there is no news
    assert "No such file or directory" in trouble(at)
    at.join(b"w2", credit=1)
    assert not trouble(at)
    at.die(b"w2")
    at.work_off(b"w1")
    assert not trouble(at)


def test_a_video_that_the_server_lacks_as_well_is_refused() -> None:
    at = serving(3)
    at.gone.add(at.leases[b"w"][0].video)
    at.fail(reason="changed since it was catalogued", frame=None, here=True)
    (second,) = at.leases[b"w"]
    assert (second.candidate, second.refusals["refusals"][0]["reason"]) == (1, "changed since it was catalogued")
    assert at.broker.counters.missing_videos == 0


def test_a_failed_video_is_passed_over_and_the_next_lease_says_so() -> None:
    at = serving(3)
    first = at.fail(reason="no frame", frame=17)
    (second,) = at.leases[b"w"]
    assert (second.candidate, second.indices) == (1, (3,))
    assert second.refusals == {
        "refusals": [{"video": first.video, "frame": 17, "reason": "no frame", "kind": "failed"}]
    }
    at.fail(reason="nor here", frame=None)
    (third,) = at.leases[b"w"]
    assert [refusal["reason"] for refusal in third.refusals["refusals"]] == ["no frame", "nor here"]
    at.work_off()
    assert at.samples() == [(0, 3)]
    assert at.broker.counters.refused_candidates == 2
    at.hello(on_bad_video="raise")
    at.want(4)
    at.fail(reason="no substitute")
    assert "no substitute" in at.unavailable()[0].text
    assert not at.leases[b"w"]


def test_when_every_candidate_fails_the_consumer_hears_the_whole_story_once() -> None:
    at = serving(3, batch_size=1)
    long = "\U0001f600" * 200_000  # reasons of any length still travel
    videos = [at.fail(reason=f"reason {number} {long}").video for number in range(MOST_CANDIDATES)]
    (message,) = at.unavailable()
    assert (message.epoch, message.index) == (0, 3)
    assert len(message.text) < 100_000
    for number, name in enumerate(videos):
        assert f"{name} at frame 7: reason {number}" in message.text
    assert not at.leases[b"w"]
    assert at.samples() == []
    assert at.broker.counters.unavailable == 1
    # The credit is free again.
    assert at.want(0, 1) == []


def test_a_video_whose_index_cannot_be_read_is_passed_over() -> None:
    at = peers(corpus(video("good.mp4"), video("bad.mp4"), unreadable=("bad.mp4",)))
    at.join(credit=8)
    at.hello()
    at.want(*range(8))
    leases = list(at.leases[b"w"])
    assert {lease.video for lease in leases} == {"good.mp4"}
    assert sorted(lease.indices[0] for lease in leases) == list(range(8))
    assert any(lease.candidate for lease in leases)
    at.work_off()
    assert sorted(at.samples()) == [(0, index) for index in range(8)]


def test_an_index_that_another_process_holds_is_no_videos_fault() -> None:
    held = {"a.mp4", "b.mp4"}
    at = peers(corpus(video("a.mp4"), video("b.mp4"), held=held))
    at.join(credit=8)
    at.hello()
    at.want(*range(8))
    assert not at.leases[b"w"]
    at.tick(0.1)
    assert not at.leases[b"w"]
    assert "database is locked" in trouble(at)
    held.clear()
    at.tick(0.1)
    assert [lease.indices[0] for lease in at.leases[b"w"]] == list(range(8))  # again in their order
    assert not any(lease.candidate for lease in at.leases[b"w"])
    assert not trouble(at)
    assert not at.broker.counters.refused_candidates


def test_an_overdue_worker_is_given_up_and_its_work_goes_to_another() -> None:
    at = serving(0, 1, worker=b"w1")
    at.begin(b"w1")
    at.tick(DEADLINE)
    assert at.given_up == []
    at.join(b"w2")
    at.tick(0.5)
    assert at.given_up == [b"w1"]
    assert at.broker.workers == 1
    # Only the lease in work is blamed.
    assert [(lease.indices, lease.candidate) for lease in at.leases[b"w2"]] == [((0,), 1), ((1,), 0)]
    at.tick(1.0)
    assert at.given_up == [b"w1"]
    assert (at.broker.counters.workers_lost, at.broker.counters.returned_leases) == (1, 2)
    # Its answer comes after all: too late.
    at.finish(b"w1")
    assert at.samples() == []
    refused(at.told[b"w1"], ErrorCode.UNKNOWN_SESSION)
    at.work_off(b"w2")
    assert at.samples() == [(0, 0), (0, 1)]


def test_a_worker_that_fell_silent_is_given_up_once_without_blame() -> None:
    at = peers()
    at.join(b"w1")
    at.join(b"w2")
    at.hello()
    at.want(0)
    at.begin(b"w1")
    at.tick(SILENCE_SECONDS - 0.1)
    assert at.given_up == []
    at.tick(0.5)
    assert at.given_up == [b"w2"]
    at.tick(0.5)
    assert (at.given_up, at.broker.workers) == ([b"w2"], 1)
    assert (at.recorded, at.broker.counters.workers_lost) == ([], 1)
    # A worker with a lease may be silent until its deadline; any message counts as a sign of life.
    at.finish(b"w1")
    at.worker_says(b"w1", Ping())
    assert at.told[b"w1"] == [Pong()]
    at.tick(SILENCE_SECONDS - 0.1)
    assert at.given_up == [b"w2"]
    at.carry_out(at.dispatcher.stop_workers())
    assert at.told[b"w1"] == [Pong(), Stop()]


# --- consumers that come and go ---------------------------------------------------------------------------------------


def test_a_consumer_that_pings_is_not_forgotten() -> None:
    at = peers()
    at.hello()
    for _ in range(4):
        at.tick(IDLE - 1)
        at.consumer_says(b"c", Ping())
    assert len(at.broker.sessions) == 1
    at.tick(IDLE + 1)
    assert len(at.broker.sessions) == 0


def test_geometries_requested_once_are_evicted() -> None:
    at = peers()
    alive = []
    for number in range(3 * MOST_TABLES):
        at.hello(max_sequences_per_video=number + 1)
        session = at.broker.sessions.get(b"c")
        assert session is not None
        alive.append(weakref.ref(session.schedule.table))
    del session
    gc.collect()
    assert sum(each() is not None for each in alive) == MOST_TABLES
    # The session's own is not lost, whatever others ask for.
    at.hello(b"other", max_sequences_per_video=100)
    for number in range(2 * MOST_TABLES):
        at.hello(max_sequences_per_video=200 + number)
    at.join()
    at.want(0, identity=b"other")
    at.work_off()
    assert at.samples(b"other") == [(0, 0)]


# --- no peer can stop it ----------------------------------------------------------------------------------------------


def still_serves(at: Peers) -> None:
    """Check that a healthy consumer and worker are served as if they were alone."""
    at.join(b"good worker")
    at.hello(b"good consumer", seed=3)
    at.want(0, 1, identity=b"good consumer")
    for worker in sorted(at.leases):
        at.work_off(worker)
    assert sorted(at.samples(b"good consumer")) == [(0, 0), (0, 1)]


@pytest.mark.parametrize(
    "frames",
    [[b"garbage"], encode(Hello({"x" * 60_000: 1}, ("voxels",), 4, 0))],
    ids=["nonsense", "refused specs"],
)
def test_a_peer_that_sends_only_faults_is_disconnected(frames: list[bytes]) -> None:
    at = peers()
    for _ in range(MOST_FAULTS):
        (answer,) = at.dispatcher.from_consumer(b"bad", frames, 0.0)
        assert isinstance(answer, ToConsumer)
    assert at.dispatcher.from_consumer(b"bad", frames, 0.0) == [Disconnect(b"bad")]
    at.dispatcher.consumer_gone(b"bad", 0.0)
    (answer,) = at.dispatcher.from_consumer(b"bad", frames, 0.0)
    assert isinstance(answer, ToConsumer)
    still_serves(at)


def test_a_consumer_whose_connection_ended_has_a_moment_to_come_back() -> None:
    at = peers()
    at.now = 100.0
    for name in (b"comes back", b"does not"):
        at.hello(name)
        at.dispatcher.consumer_gone(name, at.now)
    at.tick(GONE_SECONDS - 1)
    assert len(at.broker.sessions) == 2
    at.consumer_says(b"comes back", Ping())
    at.tick(2.0)
    assert [session.identity for session in at.broker.sessions] == [b"comes back"]


def test_hello_again_resets_no_credit_and_no_debt() -> None:
    """Repeated ten times a second it took the workers from everybody else."""
    at = peers()
    at.hello(batch_size=1, seed=1)
    session = at.broker.sessions.get(b"c")
    assert session is not None
    credit = session.credit
    at.join(credit=64)
    for _ in range(5):
        at.hello(batch_size=1, seed=1)
        at.want(*range(credit))
    assert len(at.leases[b"w"]) == credit
    for _ in range(credit):
        at.begin()
        at.finish()
    assert at.samples() == []
    at.work_off()
    assert sorted(at.samples()) == [(0, index) for index in range(credit)]


def test_a_slow_spec_gets_the_time_it_needs_and_does_not_count_against_others() -> None:
    at = peers(corpus(video("v.mp4", width_px=3840, height_px=2160)))
    at.hello(b"slow", on_bad_video="raise")
    at.hello(b"quick")
    lone = at.broker.sessions.get(b"slow")
    assert lone is not None
    sequence = lone.schedule.candidate(0, 0, 0, 0)
    plain = work_seconds(lone.spec, ("voxels",), sequence.video)
    assert work_seconds(lone.spec, ("voxels", "flow"), sequence.video) > 10 * max(plain, 1.0)
    divided = replace(lone.spec, recipe=lone.spec.recipe.replace(grids_per_frame=1024, bins=1024))
    assert work_seconds(divided, ("voxels",), sequence.video) > 5 * max(plain, 1.0)
    verdict = QuarantineEntry(
        1, sequence.video.id, sequence.video.fingerprint, sequence.start_frame, "slow", "t", "one spec"
    )
    quarantine = Quarantine([verdict, replace(verdict, snapshot=2)])
    of_video = (2, sequence.video.id, sequence.video.fingerprint, sequence.start_frame)
    assert quarantine.refusal(*of_video, "one spec") is not None
    assert quarantine.refusal(*of_video, "another") is None
    at.want(0, identity=b"slow")
    at.join()
    at.begin()
    at.carry_out(at.dispatcher.worker_lost(b"w", Loss(Cause.HUNG, "was slow", for_all=False), at.now))
    (written,) = at.recorded
    assert written.spec == lone.spec.digest


OTHER_VERSION = [msgpack.packb({"v": PROTOCOL_VERSION + 1, "t": "ping"})]
GARBAGE: list[list[bytes]] = [
    [],
    [b""],
    [b"garbage"],
    [b"", b""],
    [bytes(LARGEST_HEADER_BYTES + 1)],
    [b"\x82\xa1v" + b"\x91" * 1000 + b"\x90" + b"\xa1t\xa4ping"],
    OTHER_VERSION,
    [msgpack.packb({"v": PROTOCOL_VERSION, "t": "x" * 1000})],
    [msgpack.packb({"v": "\0" * 500_000, "t": "ping"})],
    [msgpack.packb({"v": PROTOCOL_VERSION, "t": "ping", "\0" * 500_000: 1})],
]


@pytest.mark.parametrize("frames", GARBAGE, ids=range(len(GARBAGE)))
def test_garbage_is_counted_and_answered(frames: list[bytes]) -> None:
    at = serving()
    at.carry_out(at.dispatcher.from_consumer(b"c", frames, 0.0))
    at.carry_out(at.dispatcher.from_worker(b"w", frames, 0.0))
    at.carry_out(at.dispatcher.from_consumer(b"stranger", frames, 0.0))
    at.carry_out(at.dispatcher.from_worker(b"stranger", frames, 0.0))
    assert at.broker.counters.malformed == 4
    for answer in (at.refusals(b"c")[0], at.refusals(b"stranger")[0], at.told[b"w"][0], at.told[b"stranger"][0]):
        assert isinstance(answer, Denied)
        assert answer.code in (ErrorCode.MALFORMED, ErrorCode.VERSION)
        if frames is OTHER_VERSION:
            assert answer.code == ErrorCode.VERSION
            assert f"this side version {PROTOCOL_VERSION}" in answer.text
    still_serves(at)


@pytest.mark.parametrize("text", ["x" * 60_000, "\0" * 60_000, "\U0001f600" * 15_000])
def test_what_is_quoted_in_a_refusal_never_makes_it_too_large(text: str) -> None:
    """Quoting multiplies: what is refused must not become an answer that no message can carry."""
    at = peers()
    for spec, arrays in (
        ({text: 1}, ("voxels",)),
        ({"recipe": {text: 1}}, ("voxels",)),
        ({"recipe": text}, ("voxels",)),
        ({"recipe": {"gamma": text}}, ("voxels",)),
        ({"voxel_dtype": text}, ("voxels",)),
        ({}, (text,)),
    ):
        hello = Hello(spec, arrays, 4, 0)
        assert len(encode(hello)[0]) <= LARGEST_REQUEST_BYTES
        refused(at.consumer_says(b"c", hello), ErrorCode.SPEC)
    still_serves(at)


@pytest.mark.parametrize("cpu_seconds", [-1e308, -1.0, 0.0, 1e-300, 1e300, 1.7e308])
def test_absurd_costs_neither_stop_nor_unbalance(cpu_seconds: float) -> None:
    at = serving()
    at.hello(b"d")
    for identity in (b"c", b"d"):
        at.want(*range(8), identity=identity)
    at.finish(cpu_seconds=cpu_seconds)
    at.finish(cpu_seconds=cpu_seconds)
    at.work_off()
    assert len(at.samples(b"c")) == len(at.samples(b"d")) == 8
    assert 0.0 <= at.broker.counters.cpu_seconds < 1e6


def _shortened(frames: list[Any]) -> list[Any]:
    return [frames[0], frames[1][:-1]]


NONSENSE: dict[str, Callable[[], list[Any]]] = {
    "nothing": list,
    "another quarantine snapshot": lambda: frames_of({"voxels": ("int8", (2, 2, 8, 8))}, 0, 0, 0, quarantine=1),
    "garbage": lambda: [b"\xc1garbage", *sample_frames(0, 0)[1:]],
    "another message": lambda: [*encode(Ping()), *sample_frames(0, 0)[1:]],
    "header of another sample": lambda: sample_frames(0, 1),
    "header of another epoch": lambda: sample_frames(1, 0),
    "an array too short": lambda: _shortened(sample_frames(0, 0)),
    "an array too many": lambda: [*sample_frames(0, 0), b"x"],
    "no array": lambda: sample_frames(0, 0)[:1],
    "another dtype": lambda: frames_of({"voxels": ("uint8", (2, 2, 8, 8))}, 0, 0, 0),
    "another shape": lambda: frames_of({"voxels": ("int8", (2, 2, 4, 16))}, 0, 0, 0),
    "another name": lambda: frames_of({"frames": ("int8", (2, 2, 8, 8))}, 0, 0, 0),
}


def test_there_is_a_limit_to_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "MOST_WORKERS", 2)
    at = peers()
    for name in (b"a", b"b", b"c"):
        at.join(name)
    assert refused(at.told[b"c"], ErrorCode.BUSY) == "this server has 2 workers, its limit"
    at.join(b"a")  # one that is known says hello again
    assert at.broker.workers == 2


@pytest.mark.parametrize("wrong", NONSENSE)
def test_a_worker_that_answers_nonsense_is_dropped_at_once_and_its_work_keeps_its_order(wrong: str) -> None:
    at = serving(0, 1, 2)
    lease = at.begin()
    at.worker_says(b"w", Result(lease.lease), *NONSENSE[wrong]())
    assert at.samples() == []
    counters = at.broker.counters
    assert (counters.malformed, counters.workers_lost, at.broker.workers) == (1, 1, 0)
    refused(at.told[b"w"], ErrorCode.MALFORMED)
    # Whatever else it says, the server does not know it any more.
    at.worker_says(b"w", Result(lease.lease + 1), *sample_frames(0, 1))
    assert at.samples() == []
    at.join(b"w2", credit=3)
    assert [(lease.indices[0], lease.candidate) for lease in at.leases[b"w2"]] == [(0, 0), (1, 0), (2, 0)]
    at.work_off(b"w2")
    assert at.samples() == [(0, 0), (0, 1), (0, 2)]
    assert at.recorded == []


_frames = st.lists(st.binary(max_size=30), max_size=3) | messages.map(encode)
_hellos = st.builds(
    Hello,
    spec=st.dictionaries(
        st.sampled_from(("recipe", "voxel_dtype", "shuffle", "max_sequences_per_video", "self")),
        st.sampled_from((None, "paper", "int16", True, 1, 2.5, [1], {"gamma": 2}, {"bins": 1000}, {"": {}}, b"x")),
        max_size=3,
    ),
    arrays=st.lists(st.sampled_from(("voxels", "frames", "depth")), max_size=3).map(tuple),
    batch_size=st.integers(0, 2**64 - 1),
    seed=st.integers(0, 2**64 - 1),
)
_near = st.one_of(
    _hellos,
    st.builds(
        Want, epoch=st.integers(0, 3) | st.integers(0, 2**64 - 1), indices=st.lists(st.integers(0, 60)).map(tuple)
    ),
    st.builds(Begun, lease=st.integers(0, 20)),
    st.builds(Result, lease=st.integers(0, 20), begins=st.integers(0, 20)),
    st.builds(LeaseFailed, lease=st.integers(0, 20), frame=st.none(), reason=st.text(), here=st.booleans()),
    st.builds(
        WorkerHello,
        name=st.text(),
        numerics_version=st.sampled_from((NUMERICS_VERSION, 0)),
        credit=st.integers(0, 2**64 - 1),
    ),
    st.sampled_from((Ping(), Goodbye(), Stop(), Pong())),
).map(encode)


@given(
    st.lists(
        st.tuples(st.booleans(), st.sampled_from((b"c", b"d", b"w", b"")), _near | _frames, st.floats(0.0, 100.0)),
        max_size=25,
    )
)
@settings(max_examples=80, deadline=None)
def test_any_conversation_leaves_it_serving(said: list[tuple[bool, bytes, list[Any], float]]) -> None:
    at = peers()
    for by_worker, identity, frames, seconds in said:
        speak = at.dispatcher.from_worker if by_worker else at.dispatcher.from_consumer
        for instruction in speak(identity, [*frames, b"payload"] if by_worker else frames, at.now):
            assert not isinstance(instruction, AddToQuarantine)
            assert instruction.identity in (b"c", b"d", b"w", b"")
        at.tick(seconds)
    for identity in (b"c", b"d", b"w", b""):
        at.consumer_says(identity, Goodbye())
        at.die(identity)
    still_serves(at)


SIZE = 1000
FORM = Form.of({"voxels": ("int8", (SIZE,))})


@pytest.mark.parametrize(
    ("length", "passes"),
    [(1, True), (SIZE, True), (SIZE + SIZE // 256 + 64, True), (SIZE + SIZE // 256 + 65, False), (0, False)],
)
def test_a_packed_array_is_bounded_by_what_incompressible_bytes_take(length: int, passes: bool) -> None:
    payload = encode_sample(
        epoch=0,
        index=0,
        arrays={"voxels": np.zeros(SIZE, np.int8)},
        provenance={},
        worker="w",
        cpu_seconds=0.0,
        pack=lambda _: bytes(length),
    )
    request = Request(b"consumer", 0, 0)
    if passes:
        assert check_result(payload, request, FORM).packed
    else:
        with pytest.raises(ProtocolError, match="sizes"):
            check_result(payload, request, FORM)
