"""Do the jobs of commands called in this process here; programs that tests start use other processes."""

import pytest

from v2v_server.commands import prepare


@pytest.fixture(autouse=True)
def _jobs_in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("open_catalogue", "prepare"):
        step = getattr(prepare, name)
        monkeypatch.setattr(prepare, name, lambda *given, step=step, **named: step(*given, **named | {"processes": 0}))
