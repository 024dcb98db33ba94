"""What is asked of Ray, in which order; Ray itself is not started (tests/stream/test_ray.py does)."""

from __future__ import annotations

import signal
from collections.abc import Callable
from typing import Any

import pytest

pytest.importorskip("ray", reason="the extra 'ray' is not installed")

from v2v_server.supervise import ray_host
from v2v_server.supervise.pool import Pool
from v2v_server.supervise.ray_host import WORKER_BYTES, ActorStatus, RayHost, RayWorker

_BUNDLE = {"CPU": 1.0, "memory": float(WORKER_BYTES)}


class _Call:
    """A method of an actor: notes that it was called, and returns itself as the promise of what comes."""

    def __init__(self, done: list[tuple[Any, ...]], name: str) -> None:
        self._done, self._name = done, name

    def remote(self, *arguments: Any) -> _Call:
        self._done.append((self._name, *arguments))
        return self


class _Actor:
    def __init__(self, done: list[tuple[Any, ...]], options: dict[str, Any], arguments: tuple[Any, ...]) -> None:
        self.options, self.arguments = options, arguments
        for name in ("run", "status", "signal"):
            setattr(self, name, _Call(done, name))


@pytest.fixture
def done(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Any, ...]]:
    """All that is asked of Ray, in order."""
    done: list[tuple[Any, ...]] = []

    class Remote:
        def __init__(self, cls: type) -> None:
            assert cls is RayWorker

        def options(self, **options: Any) -> Remote:
            self.asked = options
            return self

        def remote(self, *arguments: Any) -> _Actor:
            actor = _Actor(done, self.asked, arguments)
            done.append(("actor", actor))
            return actor

    def noted(name: str) -> Callable[..., None]:
        return lambda *given, **named: done.append((name, *given, *named.values()))

    monkeypatch.setattr(ray_host.ray, "is_initialized", lambda: True)
    monkeypatch.setattr(ray_host.ray, "remote", Remote)
    monkeypatch.setattr(ray_host.ray, "kill", noted("kill"))
    monkeypatch.setattr(ray_host.ray, "wait", lambda calls, **how: ([], calls))
    monkeypatch.setattr(ray_host, "request_resources", noted("request"))
    return done


def test_an_actor_takes_a_core_comes_back_for_ever_and_goes_where_the_corpus_is(done: list[tuple[Any, ...]]) -> None:
    workers = Pool(RayHost("/videos", "w1", ["--flag"], selector={"corpus": "webvid"}), "w1")
    workers.scale(2)
    actors = [call[1] for call in done if call[0] == "actor"]
    assert [actor.options["name"] for actor in actors] == ["w1-0", "w1-1"]
    assert actors[0].arguments == ("/videos", ["--flag"], None)
    expected = {
        "num_cpus": 1, "memory": WORKER_BYTES, "max_restarts": -1, "scheduling_strategy": "SPREAD",
        "label_selector": {"corpus": "webvid"},
    }  # fmt: skip
    assert expected.items() <= actors[0].options.items()


def test_the_cluster_is_asked_for_room_for_as_many_as_there_shall_be(done: list[tuple[Any, ...]]) -> None:
    workers = Pool(RayHost("/videos", "w1"), "w1")
    for count in (2, 6, 3):
        workers.scale(count)
    workers.stop()
    assert [call[1] for call in done if call[0] == "request"] == [[_BUNDLE] * 2, [_BUNDLE] * 6, [_BUNDLE] * 3, []]


def test_who_is_too_many_is_told_to_leave_and_killed_only_at_the_end(done: list[tuple[Any, ...]]) -> None:
    """ray.kill skips what a worker does when it is told to stop."""
    workers = Pool(RayHost("/videos", "w1"), "w1")
    workers.start("tcp://10.0.0.1:5556")
    workers.scale(2)
    workers.watch(0.0, 0)
    for slot in workers._slots:
        slot.place.seen = ActorStatus("node", slot.name)
    del done[:]
    workers.scale(1)
    assert [call[0] for call in done] == ["signal", "request"]
    assert done[0] == ("signal", "w1-1.1", signal.SIGTERM)
    del done[:]
    workers.stop(0.0, 0.0)
    assert [call[0] for call in done] == ["signal", "signal", "kill", "kill", "request"]
    assert {call[2] for call in done[:2]} == {signal.SIGTERM}
