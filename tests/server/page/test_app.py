"""What is answered to which path, to whom, and how often the server is asked for it."""

from __future__ import annotations

import asyncio
import json
import platform

import pytest

from tests.server.page.asked import Answer, FakeClient, ask, asked
from tests.server.peers import peers
from tests.server.status.services import Published, published
from v2v_server.page.app import FRESH_SECONDS, MOST_EVENT_STREAMS, App, Source, make_app


def app_of(service: Published | None) -> App:
    return make_app(Source(FakeClient(service)), ["watch.example"])


@pytest.fixture
def service() -> Published:
    at = peers()
    at.join()
    at.hello()
    at.want(0, 1, 2)
    at.work_off()
    seen = published(at)
    seen.publisher.is_ready = True
    return seen


# --- paths ------------------------------------------------------------------------------------------------------------


def test_a_service_that_answers_is_healthy_and_with_workers_it_is_ready(service: Published) -> None:
    assert (ask(app_of(service), "/healthz").status, ask(app_of(service), "/readyz").status) == (200, 200)


def test_a_service_without_workers_is_healthy_and_not_ready() -> None:
    service = published(peers())
    service.publisher.is_ready = True
    assert ask(app_of(service), "/healthz").status == 200
    answer = ask(app_of(service), "/readyz")
    assert (answer.status, answer.text) == (503, "no worker is connected\n")


@pytest.mark.parametrize("path", ["/healthz", "/readyz", "/state"])
def test_a_server_that_does_not_answer_is_said(path: str) -> None:
    answer = ask(app_of(None), path)
    assert answer.status == 503
    assert "is v2v-serve running there?" in answer.text


def test_the_state_is_the_servers(service: Published) -> None:
    answer = ask(app_of(service), "/state")
    assert answer.headers["content-type"] == "application/json"
    assert json.loads(answer.body) == service.plain()


def events(answer: Answer) -> list[tuple[str, object]]:
    found = []
    for event in answer.text.split("\n\n")[:-1]:
        kind, data = event.split("\n")
        found.append((kind.removeprefix("event: "), json.loads(data.removeprefix("data: "))))
    return found


def test_events_are_states_as_they_come(service: Published, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("v2v_server.page.app.EVENT_SECONDS", 0.0)
    answer = ask(app_of(service), "/events", most_parts=3)
    assert answer.headers["content-type"].startswith("text/event-stream")
    (first, state), *_ = events(answer)
    assert first == "state"
    assert state == service.plain()


def test_events_say_that_the_server_is_gone() -> None:
    ((kind, said), *_) = events(ask(app_of(None), "/events", most_parts=1))
    assert kind == "trouble"
    assert "no answer" in str(said)


def test_a_crowd_of_browsers_is_sent_away_and_those_that_leave_make_room(service: Published) -> None:
    async def crowd() -> tuple[int, int]:
        app = app_of(service)
        many = [asyncio.create_task(asked(app, "/events", most_parts=10**6)) for _ in range(MOST_EVENT_STREAMS)]
        while (refused := (await asked(app, "/events", most_parts=1)).status) == 200:
            await asyncio.sleep(0)  # they are still coming in
        for one in many:
            one.cancel()
        await asyncio.gather(*many, return_exceptions=True)
        return refused, (await asked(app, "/events", most_parts=1)).status

    assert asyncio.run(crowd()) == (503, 200)


def test_nothing_else_is_there_and_nothing_can_be_changed(service: Published) -> None:
    assert ask(app_of(service), "/../etc/passwd").status == 404
    assert ask(app_of(service), "/state", method="POST").status == 405


# --- who may ask ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "host",
    ["127.0.0.1:5580", "localhost:5580", "LOCALHOST", "[::1]:5580", "10.1.2.3", platform.node(), "watch.example:80"],
)
def test_addresses_and_names_of_this_host_may_be_asked_by(service: Published, host: str) -> None:
    assert ask(app_of(service), "/healthz", {"host": host}).status == 200


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:5580", "127.0.0.1.evil.example", "", "[::1", "[]", "localhost.evil"]
)
def test_a_name_that_others_can_have_is_not_answered(service: Published, host: str) -> None:
    answer = ask(app_of(service), "/state", {"host": host})
    assert answer.status == 421
    assert "--page-names" in answer.text


def test_a_browser_runs_nothing_of_strangers_and_sends_nothing_elsewhere(service: Published) -> None:
    for path in ("/state", "/metrics", "/nowhere"):
        headers = ask(app_of(service), path).headers
        policy = headers["content-security-policy"]
        assert "default-src 'none'" in policy
        assert "unsafe" not in policy
        assert "frame-ancestors 'none'" in policy
        assert headers["x-content-type-options"] == "nosniff"


# --- how often --------------------------------------------------------------------------------------------------------


def test_the_server_is_asked_only_for_somebody_and_a_few_times_a_second_for_all(service: Published) -> None:
    client, now = FakeClient(service), [0.0]
    source = Source(client, lambda: now[0])
    app = make_app(source)
    assert client.requests == 0

    async def many() -> None:
        await asyncio.gather(*(asked(app, "/state") for _ in range(20)))

    asyncio.run(many())
    assert client.requests == 1
    now[0] = FRESH_SECONDS
    ask(make_app(source), "/state")
    assert client.requests == 2


def test_health_does_not_wait_for_a_server_that_is_asked_again(service: Published) -> None:
    now = [0.0]
    source = Source(FakeClient(service), lambda: now[0])

    async def known_while_another_question_is_under_way() -> bool:
        before = await source.latest()
        now[0] = FRESH_SECONDS
        async with source._lock:
            return await source.known() is before

    assert asyncio.run(known_while_another_question_is_under_way())
