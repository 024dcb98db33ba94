"""`v2v-serve`: flags, and what it says when it cannot go on."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from v2v_server.commands import serve as command
from v2v_server.config import ServeConfig


@pytest.mark.parametrize(("flags", "port"), [([], 0), (["--page"], 5580), (["--page", "8080"], 8080)])
def test_a_page_has_a_port_of_its_own_or_the_usual_one(
    flags: list[str], port: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[ServeConfig] = []
    monkeypatch.setattr(command, "serve", asked.append)
    assert command.main(["--videos", "a", *flags]) == 0
    assert command.main([*flags, "--videos", "a"]) == 0
    assert [config.page for config in asked] == [port, port]


def test_an_error_that_ends_it_is_an_object_too_where_programs_read(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    missing = str(tmp_path / "missing")
    assert command.main(["--videos", missing, "--log-format", "json"]) == command.main(["--videos", missing])
    as_object, for_people, again = capsys.readouterr().err.splitlines()
    assert (json.loads(as_object)["level"], json.loads(as_object)["text"] in for_people) == ("error", True)
    assert again == for_people
