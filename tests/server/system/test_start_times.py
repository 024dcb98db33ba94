"""The times of a start add up to its whole."""

import time

from v2v_server.system.log import StartTimes


def test_steps_follow_each_other_from_the_creation_of_the_process() -> None:
    times = StartTimes()
    times.mark("imports")
    before = time.time()
    times.mark("corpus")
    assert [step for step, _ in times.steps] == ["imports", "corpus"]
    assert all(seconds >= 0 for _, seconds in times.steps)
    assert times.steps[1][1] <= time.time() - before + times.steps[0][1]
    times.steps[:] = [("imports", 0.5), ("corpus", 1.25)]
    assert str(times) == "start: imports 0.50 s, corpus 1.25 s; 1.75 s in all"
