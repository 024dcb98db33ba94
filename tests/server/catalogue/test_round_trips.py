"""Many questions at a time, and their answers in order."""

from __future__ import annotations

import threading
import time

import pytest

from v2v_server.catalogue.round_trips import answers


@pytest.mark.parametrize("files", [0, 1, 63, 64, 65, 1000])
def test_each_is_asked_once_and_answered_in_its_place(files: int) -> None:
    asked: list[int] = []

    def question(file: int) -> int:
        asked.append(file)
        return file * file

    assert list(answers(question, range(files))) == [(file, file * file) for file in range(files)]
    assert sorted(asked) == list(range(files))


def test_what_comes_late_holds_up_no_other_question_and_keeps_its_place() -> None:
    others = threading.Event()

    def question(file: int) -> bool:
        if file == 999:
            others.set()
        return others.wait(10) if file == 0 else True

    assert [file for file, in_time in answers(question, range(1000)) if in_time] == list(range(1000))


@pytest.mark.parametrize("room", [0, 3])
def test_without_room_for_threads_they_are_asked_one_after_the_other(
    monkeypatch: pytest.MonkeyPatch, room: int
) -> None:
    start, started = threading.Thread.start, []

    def limited(thread: threading.Thread) -> None:
        if len(started) == room:
            raise RuntimeError("can't start new thread")
        started.append(thread)
        start(thread)

    monkeypatch.setattr(threading.Thread, "start", limited)
    assert list(answers(lambda file: -file, range(1000))) == [(file, -file) for file in range(1000)]


def test_who_hears_no_more_asks_no_more() -> None:
    threads, asked = threading.active_count(), []

    def question(file: int) -> None:
        asked.append(file)
        time.sleep(0.001)

    heard = answers(question, range(20_000))
    next(heard)
    heard.close()
    assert len(asked) < 20_000
    assert threading.active_count() == threads
