"""Test what a consumer sends, and when, without a socket, by a clock that jumps to the next timer."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.client.fake_server import SPEC, expected
from v2v_client.conversation import Conversation, Event, ListeningClock, State
from v2v_client.options import Patience
from v2v_client.position import StreamIdentity
from v2v_protocol.arena import Slot
from v2v_protocol.errors import NoWorkers, ServerLost, UsageError
from v2v_protocol.messages import (
    Denied,
    ErrorCode,
    Frames,
    Goodbye,
    Hello,
    Message,
    Ping,
    Pong,
    SampleHeader,
    Want,
    Welcome,
    decode,
    encode_sample,
)
from v2v_protocol.sample import Provenance, SampleId, SampleParams

PATIENCE = Patience(timeout_seconds=60, ping_seconds=2, rewant_seconds=10)
WELCOME = Welcome(SPEC.to_dict(), SPEC.digest, "catalogue", 1, sequences=20, credit=3)
STREAM = StreamIdentity.of(WELCOME)
HELLO = Hello(SPEC.to_dict(), ("voxels", "frames"), 4, 5)
FORGOTTEN = Denied(ErrorCode.UNKNOWN_SESSION, "say Hello")


def begun(*, welcomed: bool = True, patience: Patience = PATIENCE) -> Conversation:
    talk = Conversation("tcp://x:1", HELLO, 0, pinned=STREAM, pinned_by="a test", patience=patience, now=0.0)
    talk.handle_event(Event.OPENED, 0.0)
    if welcomed:
        talk.handle_message(WELCOME, [], 0.0)
        talk.want([0, 1])
        talk.outbox.clear()
    return talk


def said(talk: Conversation) -> list[Message]:
    outbox, talk.outbox = talk.outbox, []
    return outbox


def timeline(
    talk: Conversation, until: float, answer: Callable[[Message], Message | None] = lambda _: None
) -> list[tuple[float, Any]]:
    """Return the actions during a silence, with their times."""
    now, done = 0.0, []
    while now < until:
        now += talk.next_due(now)
        try:
            if talk.tick(now):
                done.append((now, "reconnect"))
        except ServerLost as error:
            return [*done, (now, type(error))]
        messages = said(talk)
        done += [(now, type(message)) for message in messages]
        for message in messages:
            reply = answer(message)
            if reply is not None:
                talk.handle_message(reply, [], now)
                done += [(now, type(message)) for message in said(talk)]
    return done


def pongs(message: Message) -> Message | None:
    return Pong() if isinstance(message, Ping) else None


def at(done: list[tuple[float, Any]], what: Any) -> list[float]:
    return [now for now, kind in done if kind is what or kind == what]


# --- states -----------------------------------------------------------------------------------------------------------


@given(st.lists(st.sampled_from(Event), max_size=20))
def test_requests_wait_for_the_welcome(events: list[Event]) -> None:
    talk = Conversation("tcp://x:1", HELLO, 0, pinned=STREAM, pinned_by="a test", patience=PATIENCE, now=0.0)
    talk.credit = 3
    talk.want([7, 8])
    greeted = False
    for event in events:
        talk.handle_event(event, 0.0)
        for message in said(talk):
            match message:
                case Hello():
                    greeted = talk.state is State.GREETING
                case Want():
                    assert greeted
                    assert talk.state is State.WELCOMED
                    assert message.indices == (7, 8)
                case _:
                    assert isinstance(message, Goodbye)


def test_a_forgotten_session_reopens_once_and_repeats_all_requests() -> None:
    talk = begun()
    for _ in range(2):  # each request is denied
        talk.handle_message(FORGOTTEN, [], 1.0)
    assert [type(message) for message in said(talk)] == [Hello]
    talk.handle_message(WELCOME, [], 1.0)
    assert said(talk) == [Want(0, (0, 1))]


@pytest.mark.parametrize("is_second", [False, True])
def test_a_sample_that_the_server_has_dropped_is_requested_again_in_a_message(is_second: bool) -> None:
    talk = begun()
    talk.want([2], {2: Slot("arena", 5)})
    message = decode(sample(2)[0])
    assert isinstance(message, SampleHeader)
    if is_second:
        assert talk.handle_message(message, sample(2)[1:], 1.0) is not None
    said(talk)
    assert talk.handle_message(replace(message, slot=5, arena="1:2:1:" + "0" * 32), [], 1.0) is None
    assert said(talk) == ([] if is_second else [Want(0, (2,))])
    arrival = talk.handle_message(message, sample(2)[1:], 1.0)
    assert arrival is not None
    assert arrival.slot_is_free


# --- silence ----------------------------------------------------------------------------------------------------------


def test_a_dead_server_is_pinged_then_reconnected_with_backoff_then_lost() -> None:
    done = timeline(begun(), 100.0)
    assert at(done, Ping) == [2, 4, 6, 8]
    assert at(done, "reconnect") == [10, 30]
    assert at(done, Hello)[0] == 10
    assert done[-1] == (60, ServerLost)


def test_requests_to_a_server_that_only_answers_pings_are_repeated_with_backoff() -> None:
    done = timeline(begun(), 200.0, pongs)
    asked = [now for now in at(done, Want) if now % 10 == 0]
    assert {10, 30, 70, 130, 190} <= set(asked)
    assert "reconnect" not in [kind for _, kind in done]
    assert done[-1][0] >= 200


def test_hello_is_repeated_with_backoff() -> None:
    talk = begun(welcomed=False, patience=Patience(60, 2, 1000))
    assert said(talk) == [HELLO]
    assert at(timeline(talk, 60.0), Hello) == [2, 6, 14, 30]


@pytest.mark.parametrize("timeout_seconds", [0.5, 2.0, 3.0])
def test_a_server_is_pinged_before_it_counts_as_lost(timeout_seconds: float) -> None:
    """This holds for any deadline relative to the ping interval, because a busy server sends nothing by itself."""
    assert at(timeline(begun(patience=Patience(timeout_seconds)), 10.0), Ping)[0] < timeout_seconds


# --- no workers ---------------------------------------------------------------------------------------------------


def test_a_server_without_workers_is_logged_and_then_an_error(caplog: pytest.LogCaptureFixture) -> None:
    def troubled(message: Message) -> Message | None:
        return Pong("no worker is connected: start v2v-worker") if isinstance(message, Ping) else None

    with caplog.at_level(logging.WARNING), pytest.raises(NoWorkers, match="no worker is connected: start v2v-worker"):
        timeline(begun(), 100.0, troubled)
    (warning,) = caplog.records
    assert "no sample for 6 s, because no worker is connected" in warning.getMessage()


def test_a_server_whose_workers_return_is_not_an_error() -> None:
    pings = 0

    def sometimes(message: Message) -> Message | None:
        nonlocal pings
        pings += isinstance(message, Ping)
        return Pong("no worker is connected" if pings % 10 else "") if isinstance(message, Ping) else None

    assert timeline(begun(), 200.0, sometimes)[-1][0] >= 200


# --- time -------------------------------------------------------------------------------------------------------------


@given(st.floats(0, 1e6), st.floats(0, 50))
def test_time_spent_elsewhere_does_not_count(away: float, listened: float) -> None:
    clock = ListeningClock(0.0)
    clock.pause(listened)
    clock.listen(listened + away)
    assert clock.time(listened + away) == pytest.approx(listened, abs=1e-6)


def test_a_time_in_which_this_process_was_stopped_does_not_count() -> None:
    clock = ListeningClock(0.0)
    clock.wake(1.5, due=1.0)
    assert clock.time(1.5) == 1.5
    clock.wake(1000.0, due=2.0)
    assert clock.time(1000.0) == 2.0


@pytest.mark.parametrize("name", ["timeout_seconds", "ping_seconds", "rewant_seconds"])
def test_timeouts_must_be_positive(name: str) -> None:
    with pytest.raises(UsageError, match=name):
        Patience(**{name: 0.0})


# --- over queues ------------------------------------------------------------------------------------------------------


def sample(index: int) -> Frames:
    arrays = {name: expected(name, 5, 0, index) for name in HELLO.arrays}
    params = SampleParams(0.2, 0.3, 0.0, 0, 0.0, (), 1.0, 0, 0, False, 0.0, (1, 2, 3, 4))
    identity = SampleId(SPEC.digest, "catalogue", 1, 5, 0, index)
    provenance = Provenance(identity, "a.mp4", "7:00", 0, 0, (), params, 0, 0, "h264 exact", 0)
    return encode_sample(
        epoch=0, index=index, arrays=arrays, provenance=provenance.to_dict(), worker="w", cpu_seconds=0.1
    )


def test_waiting_time_is_reported_once_a_second_and_at_the_end() -> None:
    talk = begun()
    said(talk)
    for tenth in range(1, 35):
        talk.record_wait(0.1, tenth / 10)
    told = [message.waited_seconds for message in said(talk) if isinstance(message, Want)]
    assert 3 <= len(told) <= 4
    assert told == sorted(told)
    talk.handle_event(Event.LEFT, 1010.0)
    assert said(talk) == [Goodbye(pytest.approx(3.4))]


def test_a_reopened_session_restarts_the_waiting_time() -> None:
    talk = begun()
    talk.record_wait(5.0, 5.0)
    talk.handle_message(FORGOTTEN, [], 6.0)
    talk.handle_message(WELCOME, [], 6.0)
    talk.record_wait(0.5, 6.5)
    talk.handle_event(Event.LEFT, 7.0)
    assert said(talk)[-1] == Goodbye(0.5)
