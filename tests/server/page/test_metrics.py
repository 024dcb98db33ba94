"""Test the metrics: in the form of Prometheus, by its conventions, with the numbers of the status."""

from __future__ import annotations

from typing import Any

import pytest
from prometheus_client.parser import text_string_to_metric_families

from tests.server.peers import peers
from tests.server.status.services import published
from v2v_protocol.messages import Hello
from v2v_server.page.app import exposition
from v2v_server.status.snapshot import meanings_at


def values(state: dict[str, Any] | None) -> dict[tuple[str, tuple[tuple[str, str], ...]], float]:
    """Every sample by its name and labels."""
    content, content_type = exposition(state)
    assert content_type.startswith("text/plain")
    return {
        (sample.name, tuple(sorted(sample.labels.items()))): sample.value
        for family in text_string_to_metric_families(content.decode())
        for sample in family.samples
    }


@pytest.fixture
def state() -> dict[str, Any]:
    at = peers()
    service = published(at, cache="/nowhere", cache_gib=2.0)
    for name in (b"a", b"b"):
        at.consumer_says(name, Hello({}, ("voxels",), 2, 0, name='rank "0" of 1', host="gpu\\1"))
    at.join()
    at.want(0, 1, 2, identity=b"a")
    at.want(9, identity=b"b")
    at.finish()
    at.finish()
    loaded: dict[str, Any] = service.plain()
    return loaded


def test_they_are_the_numbers_of_the_state(state: dict[str, Any]) -> None:
    found = values(state)
    expected = {
        ("v2v_up", ()): 1.0,
        ("v2v_samples_total", ()): 2.0,
        ("v2v_batches_total", ()): 1.0,
        ("v2v_waiting_share", ()): state["queued_share"],
        ("v2v_workers", (("state", "working"),)): 1.0,
        ("v2v_workers", (("state", "idle"),)): 0.0,
        ("v2v_consumers", (("state", "taking"),)): 2.0,
        ("v2v_cache_limit_bytes", ()): 2 * (1 << 30),
        ("v2v_worker_samples_total", (("host", ""), ("worker", "w"))): 2.0,
        ("v2v_worker_seconds_total", (("part", "decode"),)): 0.0,
    }
    assert {name: found.get(name) for name in expected} == expected
    assert sum(value for (name, _), value in found.items() if name == "v2v_slow_part") == 1.0


def test_consumers_of_one_name_are_added_up_and_hostile_names_are_escaped(state: dict[str, Any]) -> None:
    found = values(state)
    label = (("consumer", 'rank "0" of 1'), ("host", "gpu\\1"))
    assert found["v2v_consumer_samples_total", label] == 2.0
    assert found["v2v_consumer_in_flight_samples", label] + found["v2v_consumer_queued_samples", label] == 2.0


def test_a_server_that_does_not_answer_is_down() -> None:
    assert values(None) == {("v2v_up", ()): 0.0}


def test_every_verdict_of_the_sentence_has_its_sample() -> None:
    from tests.server.status.test_snapshot import CASES

    assert {case[1] for case in CASES} == set(meanings_at("waiting")["part"].states)


def test_the_form_that_is_asked_for_is_given(state: dict[str, Any]) -> None:
    content, content_type = exposition(state, "application/openmetrics-text; version=1.0.0")
    assert content_type.startswith("application/openmetrics-text")
    assert content.endswith(b"# EOF\n")
