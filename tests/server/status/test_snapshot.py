"""Test the status: every number is right, plain, and bounded, and the bottleneck follows from them."""

from __future__ import annotations

import json
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.server.named_corpus import SMALL_SPEC
from tests.server.peers import Peers, answer_to, peers
from tests.server.status.services import WALL, Published, View, json_of, published
from v2v_protocol import NUMERICS_VERSION, PROTOCOL_VERSION
from v2v_protocol.messages import GetStatus, Goodbye, Hello, Result, Want, WorkerHello, encode
from v2v_protocol.sample import Refusal
from v2v_server.broker.leases import Stall
from v2v_server.broker.session import RETURN_SECONDS
from v2v_server.broker.state import RefusalPart, SendStatus, ToConsumer, ToWorker
from v2v_server.quarantine import QuarantineEntry
from v2v_server.status.snapshot import ANSWER_SECONDS, MOST_SHOWN, STATUS_VERSION, Shares, find_bottleneck, to_json


def finish(at: Peers, worker: bytes = b"w", **took: float) -> None:
    """The worker's oldest sample is done, and took that long."""
    lease = at.leases[worker].popleft()
    at.worker_says(worker, Result(lease.lease, 0, **took, memory_bytes=1 << 29), *answer_to(lease, cpu_seconds=1.5))  # type: ignore[arg-type]


def hello(at: Peers, identity: bytes = b"c", name: str = "rank 1 of 2", host: str = "gpu-1") -> None:
    at.consumer_says(identity, Hello({}, ("voxels",), 2, 7, name=name, host=host))


# --- the model --------------------------------------------------------------------------------------------------------


def test_a_service_without_peers_says_what_it_serves() -> None:
    state = published(peers(), workers="1:3").view()
    assert (state.version, state.protocol, state.time) == (STATUS_VERSION, PROTOCOL_VERSION, WALL)
    assert (state.video_count, state.unusable_count, state.videos) == (5, 0, "/corpus")
    assert (state.worker_count, state.consumer_count, state.workers_wanted) == (0, 0, (1, 3))
    assert (state.workers, state.consumers, state.refusals, state.verdicts, state.cache) == ([], [], [], [], None)
    assert state.waiting.part == "no_consumers"
    assert not state.is_ready
    assert state.spec["recipe"]["bins"] == 5
    assert set(state.spec) == set(SMALL_SPEC.to_dict())


def test_a_row_says_what_a_worker_makes_and_what_it_took(at: Peers, service: Published) -> None:
    at.worker_says(b"w", WorkerHello("w", NUMERICS_VERSION, 2, "node-7"))
    hello(at)
    at.want(0, 1, 2, 3)
    at.now = 5.0
    lease = at.begin()
    at.now = 8.0
    (worker,) = service.view().workers
    assert (worker.name, worker.host, worker.state) == ("w", "node-7", "working")
    assert (worker.clip, worker.frame, worker.clip_seconds) == (lease.video, lease.start_frame, 3.0)
    assert (worker.leases, worker.samples, worker.restarts, worker.silent_seconds) == (2, 0, None, 3.0)
    finish(at, decode_seconds=2.0, simulate_seconds=1.0, handover_seconds=0.5)
    at.now = 10.0
    state = service.view()
    (worker,) = state.workers
    assert (worker.samples, worker.busy_share, worker.cpu_share, worker.memory_gib) == (1, 0.35, 0.15, 0.5)
    assert (state.totals.decode_seconds, state.totals.simulate_seconds, state.totals.handover_seconds) == (
        2.0,
        1.0,
        0.5,
    )
    assert (state.totals.cpu_seconds, state.totals.samples, state.totals.batches) == (1.5, 1, 0.5)


def test_a_worker_rests_is_idle_or_lost(at: Peers, service: Published) -> None:
    for name in (b"idle", b"resting", b"lost"):
        at.join(name)
    at.broker.registry.rest(b"resting", at.now, "v0.mp4: no such file")
    at.now = 31.0
    for name in (b"idle", b"resting"):
        at.broker.registry.mark_heard(name, at.now)
    at.broker.registry.vanished(at.now)
    states = {worker.name: worker for worker in service.view().workers}
    assert {name: worker.state for name, worker in states.items()} == {
        "idle": "idle", "resting": "resting", "lost": "lost",
    }  # fmt: skip
    assert states["resting"].unreadable == "v0.mp4: no such file"
    assert states["lost"].silent_seconds == 31.0


def test_the_servers_own_workers_have_a_number_of_restarts(at: Peers, service: Published) -> None:
    service.pool.scale(2)
    service.pool.watch(0.0, 0)
    at.join(b"toy1")
    at.join(b"elsewhere")
    state = service.view()
    assert {worker.name: worker.restarts for worker in state.workers} == {"toy1": 0, "elsewhere": None}
    assert (state.worker_processes, state.worker_count) == (2, 2)


def test_a_consumer_is_stalled_that_waits_most_of_its_time(at: Peers, service: Published) -> None:
    hello(at)
    at.consumer_says(b"c", Want(3, (10,), waited_seconds=0.0))
    service.pass_seconds(10.0)
    at.consumer_says(b"c", Want(3, (), waited_seconds=8.0))
    service.pass_seconds(1.0)
    (consumer,) = service.view().consumers
    assert consumer.waiting_share > 0.6
    assert consumer.state == "stalled"


def test_a_row_says_where_a_consumer_is_in_its_epoch(at: Peers, service: Published) -> None:
    hello(at)
    at.consumer_says(b"c", Want(3, (10, 11, 12, 13), waited_seconds=0.0))
    at.join()
    at.work_off()
    service.pass_seconds(5.0)
    at.consumer_says(b"c", Want(3, (20, 21, 22), waited_seconds=2.0))
    at.finish()
    service.pass_seconds(5.0)
    (consumer,) = service.view().consumers
    assert (consumer.name, consumer.host) == ("rank 1 of 2", "gpu-1")
    assert b"c".hex() != consumer.id
    assert (consumer.epoch, consumer.position, consumer.sequences) == (3, 21, 50)
    assert (consumer.in_flight, consumer.waiting, consumer.served, consumer.batch_size) == (2, 0, 5, 2)
    assert consumer.waiting_share == pytest.approx(0.2)
    assert (consumer.state, consumer.waited_seconds, consumer.seed) == ("taking", 2.0, 7)
    assert consumer.eta_seconds == pytest.approx((50 - 21) / 1.1, rel=0.01)  # it began at 10
    assert service.view().specs[consumer.spec] == at.broker.sessions.get(b"c").spec.to_dict()  # type: ignore[union-attr]


def test_a_new_epoch_begins_at_its_beginning(at: Peers, service: Published) -> None:
    hello(at)
    at.join()
    at.want(40, 41)
    at.work_off()
    assert service.view().consumers[0].position == 42
    at.want(0, epoch=1)
    at.work_off()
    consumer = service.view().consumers[0]
    assert (consumer.epoch, consumer.position) == (1, 1)


def run_epochs(at: Peers, service: Published, epochs: int) -> list[View]:
    """Let a trainer take epochs of 1.2 s: each in a new session, ten samples of five batches, a fifth of it waiting."""
    rows = []
    for epoch in range(epochs):
        identity = b"c%d" % epoch
        hello(at, identity)
        for batch in range(5):
            at.consumer_says(identity, Want(epoch, (2 * batch, 2 * batch + 1), waited_seconds=0.048 * batch))
            at.work_off()
            service.pass_seconds(0.2)
        rows.append(service.view().consumers[0])
        at.consumer_says(identity, Goodbye(0.24))
        service.pass_seconds(0.2)
    return rows


def test_a_row_counts_over_short_epochs(at: Peers, service: Published) -> None:
    at.join()
    *_, before, last = run_epochs(at, service, 20)
    assert (last.id, last.epoch, last.served) == (before.id, 19, 200)
    assert last.samples_per_second == pytest.approx(10 / 1.2, rel=0.1)
    assert last.batches_per_second == pytest.approx(5 / 1.2, rel=0.1)
    assert last.waiting_share == pytest.approx(0.2, abs=0.02)
    assert last.waited_seconds == pytest.approx(20 * 0.24, abs=0.1)
    assert last.eta_seconds == pytest.approx((50 - 10) / (10 / 1.2), rel=0.1)


def test_a_reconnect_continues_the_row_and_a_later_run_begins_one(at: Peers, service: Published) -> None:
    at.join()
    (first,) = run_epochs(at, service, 1)
    service.pass_seconds(RETURN_SECONDS - 1.0)
    hello(at, b"again")
    at.consumer_says(b"again", Want(1, (0, 1), waited_seconds=0.0))
    at.work_off()
    service.pass_seconds(2.0)
    again = service.view().consumers[0]
    assert (again.id, again.served) == (first.id, 12)
    assert again.samples_per_second == pytest.approx(1.0)  # over the time since it returned
    at.consumer_says(b"again", Goodbye(0.0))
    at.now += RETURN_SECONDS
    hello(at, b"later")
    (later,) = service.view().consumers
    assert later.id != first.id
    assert later.served == 0


@pytest.mark.slow
@given(
    epochs=st.lists(
        st.tuples(
            st.sampled_from((b"a", b"b")),
            st.integers(0, 4),
            st.sampled_from((0.0, 0.3, 1.9, 2.0, 5.0, 15.0, 70.0)),
            st.booleans(),
        ),
        max_size=8,
    )
)
def test_rows_add_up_to_the_totals(epochs: list[tuple[bytes, int, float, bool]]) -> None:
    """However consumers leave and return: with a Goodbye, or by a new Hello alone."""
    at = peers()
    service = published(at)
    at.join()
    for number, (name, batches, pause, leaves) in enumerate(epochs):
        identity = name + b"%d" % number
        hello(at, identity, name=name.decode())
        for batch in range(batches):
            service.pass_seconds(0.5)
            at.consumer_says(identity, Want(number, (2 * batch, 2 * batch + 1), waited_seconds=0.1 * batch))
            at.work_off()
        if leaves:
            at.consumer_says(identity, Goodbye(0.1 * batches))
        service.pass_seconds(pause)
        totals = list(at.broker.sessions.totals())
        assert len({each.number for each in totals}) == len(totals)
        assert sum(each.served for each in totals) == at.broker.counters.samples
        assert sum(each.waited_seconds for each in totals) == pytest.approx(at.broker.counters.waited_seconds)
        for row in service.view().consumers:
            assert 0.0 <= row.waiting_share <= 1.0
            assert 0.0 <= row.epoch_share <= 1.0
            # Two in half a second: w seconds hold at most 2 w + 1 such pairs, so 4 + 2 / w, and w is at least 1.
            assert 0.0 <= row.samples_per_second <= 4.0 + 2.0 + 1e-6


def test_consumers_of_one_name_keep_rows_of_their_own(at: Peers, service: Published) -> None:
    at.join()
    for identity in (b"a", b"b"):
        hello(at, identity)
    at.want(0, 1, identity=b"a")
    at.work_off()
    before = {consumer.id for consumer in service.view().consumers}
    for identity in (b"a", b"b"):
        at.consumer_says(identity, Goodbye(0.0))
    for identity in (b"d", b"e", b"f"):
        hello(at, identity)
    rows = {consumer.id: consumer.served for consumer in service.view().consumers}
    assert before < set(rows)
    assert sorted(rows.values()) == [0, 0, 2]


def test_a_consumer_whose_connection_has_ended_is_not_counted(at: Peers, service: Published) -> None:
    hello(at, b"stays")
    hello(at, b"goes")
    at.want(0, identity=b"goes")
    assert service.view().queued_share == 0.5
    at.dispatcher.consumer_gone(b"goes", at.now)
    state = service.view()
    assert (state.consumer_count, state.queued_share) == (1, 0.0)
    assert [consumer.state for consumer in state.consumers] == ["idle", "gone"]
    at.now = 11.0
    at.tick(0.0)
    assert [consumer.id for consumer in service.view().consumers] == [state.consumers[0].id]


def test_refusals_and_verdicts_are_listed_newest_first(at: Peers, service: Published) -> None:
    hello(at)
    at.join()
    at.want(0)
    at.begin()
    at.fail(reason="cut short", frame=7)
    at.begin()
    at.fail(reason="<b>gone</b>", frame=None)
    at.quarantine.extend([QuarantineEntry(1, "v3.mp4", "f", 12, "crash", WALL)])
    state = service.view()
    assert [(each.reason, each.frame, each.kind, each.time) for each in state.refusals] == [
        ("<b>gone</b>", None, "failed", WALL), ("cut short", 7, "failed", WALL),
    ]  # fmt: skip
    assert (state.quarantine_snapshot, state.quarantined) == (1, 1)
    assert [(each.video, each.frame, each.reason) for each in state.verdicts] == [("v3.mp4", 12, "crash")]
    assert state.totals.refused_candidates == 2


def test_of_many_refusals_and_verdicts_with_long_texts_the_last_few_are_listed(at: Peers) -> None:
    for number in range(100):
        at.broker.refusals.append(RefusalPart.of(Refusal("\x01" * 4000, None, "x" * 4000), str(number)))
    at.quarantine.extend(
        [QuarantineEntry(number + 1, "\x03" * 4000, "f", 0, "\x04" * 4000, WALL) for number in range(100)]
    )
    service = published(at, cache="/not-utf8-\udcff")
    encoded, state = to_json(service.status()), service.view()
    assert len(encoded) < 1 << 18
    assert json.loads(encoded)["cache"]["folder"] == "/not-utf8-?"
    assert (len(state.refusals), state.refusals[0].time, len(state.refusals[0].reason)) == (20, "99", 200)
    assert (len(state.verdicts), state.quarantined, state.verdicts[0].snapshot) == (20, 100, 100)


def test_what_peers_call_themselves_is_short_and_printable(at: Peers) -> None:
    hello(at, name="\x1b[2J" + "n" * 1000, host="\n<script>")
    (consumer,) = published(at).view().consumers
    assert len(consumer.name) <= 100
    assert consumer.name.startswith("[2Jnnn")
    assert consumer.host == "<script>"


# --- its form ---------------------------------------------------------------------------------------------------------


def test_thousands_of_peers_fit_into_one_message_after_a_few_encodings(
    at: Peers, service: Published, monkeypatch: pytest.MonkeyPatch
) -> None:
    for number in range(MOST_SHOWN + 50):
        at.join(b"w%04d" % number)
    for number in range(MOST_SHOWN + 50):
        hello(at, b"c%04d" % number, name="\\" * 100, host='"' * 100)
        at.want(0, 1, identity=b"c%04d" % number)
    for worker in range(0, MOST_SHOWN, 2):
        at.begin(b"w%04d" % worker)
    service.pass_seconds(1.0)
    encodings, dumps = [], json.dumps
    monkeypatch.setattr(json, "dumps", lambda *values, **form: encodings.append(0) or dumps(*values, **form))
    encoded = to_json(service.status())
    state = service.view()
    assert (state.worker_count, state.consumer_count) == (MOST_SHOWN + 50, MOST_SHOWN + 50)
    assert len(encoded) < 1 << 20
    values = json.loads(encoded)
    assert 0 < len(values["workers"]) <= MOST_SHOWN
    assert 1 < len(encodings) <= 3  # lists that do not fit are halved, not shortened one by one


# --- requests ---------------------------------------------------------------------------------------------------------


def test_a_client_on_either_side_gets_the_next_status_without_a_session(at: Peers, service: Published) -> None:
    for speak, side in ((at.dispatcher.from_consumer, ToConsumer), (at.dispatcher.from_worker, ToWorker)):
        service.ask(speak(b"page", encode(GetStatus()), at.now))
        (answer,) = service.answers()
        assert (type(answer), answer.identity) == (side, b"page")
        state = json.loads(json_of(answer))
        assert (state["version"], state["consumer_count"], state["worker_count"]) == (STATUS_VERSION, 0, 0)
        at.now += ANSWER_SECONDS


def test_a_status_is_built_a_few_times_a_second_at_any_number_of_requests(at: Peers, service: Published) -> None:
    made = 0
    for _ in range(20):
        for _ in range(50):
            service.ask(at.dispatcher.from_consumer(b"page", encode(GetStatus()), at.now))
        answers = service.answers()
        assert len(answers) <= 1
        made += len(answers)
        at.now += 0.1
    assert made == 2.0 / ANSWER_SECONDS


def test_a_status_that_takes_long_is_built_less_often(at: Peers, service: Published) -> None:
    worked = iter(range(1000))
    service.publisher._processor_clock = lambda: float(next(worked)) / 10.0
    made = []
    for _ in range(200):
        service.ask(at.dispatcher.from_consumer(b"page", encode(GetStatus()), at.now))
        made += [at.now] * len(service.answers())
        at.now += 0.1
    # A tenth of a second of work each.
    assert made == pytest.approx([0.0, 5.0, 10.0, 15.0], abs=0.5)


def test_every_client_gets_the_same_status_and_the_page_too(at: Peers, service: Published) -> None:
    """90 clients that asked at the port left no place for the page, which then called the server down."""
    for number in range(500):
        service.publisher.ask(SendStatus(b"%d" % number))
        service.publisher.ask(SendStatus(b"%d" % number))
    service.publisher.ask(SendStatus(b"page", is_worker_side=True))
    answers = service.answers()
    assert len(answers) == 501
    assert [type(each) for each in answers[-1:]] == [ToWorker]
    assert len({id(each.frames) for each in answers}) == 1


def test_a_consumer_cannot_have_waited_longer_than_it_was_there(at: Peers, service: Published) -> None:
    at.now = 10.0
    hello(at)
    at.now = 14.0
    at.consumer_says(b"c", Want(0, (), waited_seconds=1e300))
    at.consumer_says(b"c", Want(0, (), waited_seconds=3.0))
    assert service.view().consumers[0].waited_seconds == 4.0
    at.consumer_says(b"c", Goodbye(4.0))
    assert service.view().totals.waited_seconds == 4.0
    assert service.view().consumers == []


# --- who waits for whom: each verdict from its shares, and the shares from what was noted -----------------------------


FULL = {"seconds": 10.0, "consumers": 0.8, "idle": 0.02, "broker": 0.2}
CASES: list[tuple[dict[str, Any], str, str, str]] = [
    ({"there": {"is_attended": False}}, "no_consumers", "No consumer is connected", ""),
    ({"seconds": 1.0}, "start", "too early", ""),
    ({"there": {"workers": 0, "trouble": "no worker is there", "starting": 0}}, "workers", "no worker is there", ""),
    ({"there": {"workers": 0, "trouble": "no worker is there", "starting": 3}}, "workers", "3 are starting", ""),
    ({"consumers": 0.03, "idle": 0.6}, "consumers", "Workers wait for consumers", "fewer workers would do"),
    ({"consumers": 0.03, "idle": 0.4}, "consumers", "idle 40% of theirs", ""),
    ({"consumers": 0.03, "idle": 0.1}, "even", "Hardly any waiting", ""),
    ({"decode": 0.7, "simulate": 0.2, "handover": 0.05}, "decode", "which decode 70% of theirs", "--cache"),
    ({"decode": 0.2, "simulate": 0.7, "handover": 0.05}, "simulate", "which simulate 70% of theirs", "fewer effects"),
    ({"decode": 0.2, "simulate": 0.2, "handover": 0.5}, "handover", "which deliver samples 50%", "shared memory"),
    ({"broker": 0.95, "idle": 0.5, "decode": 0.4}, "broker", "busy 95% of its time", "two servers"),
    ({"broker": 0.95, "idle": 0.0, "decode": 0.4}, "broker", "busy 95% of its time", "two servers"),
    ({"decode": 0.9, "queued": 0.75, "cores": 0.15}, "cores", "75% of theirs for a core and get 0.15 of a core each",
     "more workers on this host would not help"),
    ({"decode": 0.9, "queued": 0.3, "cores": 0.6}, "decode", "which decode 90% of theirs", "start more workers"),
    ({"idle": 0.5, "decode": 0.4}, "transit", "although workers are idle 50%", "network"),
]  # fmt: skip


@pytest.mark.parametrize(("case", "part", "sentence", "remedy"), CASES)
def test_each_verdict_follows_from_the_shares(case: dict[str, Any], part: str, sentence: str, remedy: str) -> None:
    there = {"is_attended": True, "workers": 4} | case.get("there", {})
    shares = Shares(**{**FULL, **{name: value for name, value in case.items() if name != "there"}})
    said = find_bottleneck(shares, **there)
    assert said.part == part
    assert sentence in said.sentence
    assert remedy in said.remedy
    assert "\n" not in said.sentence


def test_a_cache_that_is_there_is_no_remedy() -> None:
    shares = Shares(**FULL, decode=0.9)
    assert "--cache" in find_bottleneck(shares, is_attended=True, workers=1).remedy
    assert "--cache" not in find_bottleneck(shares, is_attended=True, workers=1, has_cache=True).remedy


def test_the_shares_are_of_the_time_that_was_noted(at: Peers, service: Published) -> None:
    at.join(b"busy")
    at.join(b"idle")
    at.hello(b"waits")
    at.hello(b"does not")
    service.pass_seconds(2.0)
    at.want(0, identity=b"waits")
    for _ in range(8):
        service.pass_seconds(1.0, busy_share=0.5)
        lease = at.leases[b"busy"].popleft()
        result = Result(lease.lease, 0, decode_seconds=0.25, simulate_seconds=0.5, handover_seconds=0.125)
        at.worker_says(b"busy", result, *answer_to(lease))
        at.dispatcher.worker_stalled(b"busy", Stall(queued_seconds=0.5))
        waited = at.broker.sessions.get(b"waits").waited_seconds + 0.5  # type: ignore[union-attr]
        at.consumer_says(b"waits", Want(0, (lease.indices[0] + 1,), waited_seconds=waited))
    shares = service.view().waiting.shares
    assert shares.seconds == pytest.approx(10.0)
    assert shares.consumers == pytest.approx(4.0 / 20.0)
    assert shares.broker == pytest.approx(0.4, abs=0.01)
    assert (shares.decode, shares.simulate, shares.handover) == pytest.approx((0.1, 0.2, 0.05))
    assert shares.idle == pytest.approx((20.0 - 8.0) / 20.0)
    assert (shares.queued, shares.cores) == pytest.approx((0.2, 0.04))


def test_what_was_long_ago_counts_no_more(at: Peers, service: Published) -> None:
    at.join()
    at.hello()
    at.consumer_says(b"c", Want(0, (), waited_seconds=50.0))
    service.pass_seconds(1.0, busy_share=1.0)
    service.pass_seconds(30.0)
    shares = service.view().waiting.shares
    assert (shares.consumers, shares.broker) == (0.0, pytest.approx(0.0))
    assert shares.seconds == pytest.approx(10.0, abs=1.1)


def test_the_time_before_the_first_consumer_does_not_count(at: Peers, service: Published) -> None:
    at.join()
    service.pass_seconds(9.0)
    at.hello()
    at.want(0, 1)
    service.pass_seconds(1.0, busy_share=0.5)
    assert service.view().waiting.part == "start"
    service.pass_seconds(2.0, busy_share=0.5)
    shares = service.view().waiting.shares
    assert shares.seconds == pytest.approx(3.0, abs=0.2)
    assert (shares.idle, shares.broker) == pytest.approx((0.0, 0.5), abs=0.05)


def test_a_consumer_that_comes_again_for_the_next_epoch_was_not_away(at: Peers, service: Published) -> None:
    at.join()
    at.hello(b"c1")
    service.pass_seconds(5.0)
    at.consumer_says(b"c1", Goodbye())
    service.pass_seconds(1.0)
    assert service.view().waiting.part != "no_consumers"
    service.pass_seconds(1.5)
    assert service.view().waiting.part == "no_consumers"
