"""`v2v-top`: what is drawn, and the program beside a real server."""

from __future__ import annotations

import os
import pty
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from tests.clips import panned_luma, write_clip
from tests.server.peers import peers
from tests.server.status.services import published
from tests.waiting import until
from v2v_client.local_server import LocalServer
from v2v_server.commands.top import main
from v2v_server.status.terminal import draw, line

HOSTILE = "[red]x[/red]\x1b[2J<b>.mp4"


def drawn(state: dict[str, Any], note: str = "") -> str:
    console = Console(width=160, force_terminal=False)
    with console.capture() as capture:
        console.print(draw(state, note))
    return capture.get()


def busy() -> dict[str, Any]:
    """A state with a worker, a consumer, and hostile names."""
    at = peers()
    service = published(at)
    at.join(b"w", credit=2)
    at.hello()
    at.want(0, 1, 2)
    service.pass_seconds(3.0)
    state: dict[str, Any] = service.plain()
    state["workers"][0]["clip"] = HOSTILE
    state["refusals"] = [{"time": "t", "video": HOSTILE, "frame": None, "reason": "[bold]cut", "kind": "failed"}]
    return state


def test_workers_consumers_and_the_sentence_are_shown() -> None:
    state = busy()
    text = drawn(state)
    assert state["waiting"]["sentence"] in text
    assert "1 consumers" in text
    assert "1 workers" in text
    assert state["waiting"]["sentence"] in line(state)


def test_names_are_text_and_nothing_else() -> None:
    text = drawn(busy())
    assert "[red]x[/red]" in text
    assert "[bold]cut" in text
    assert "\x1b" not in text


def test_that_a_state_is_old_is_said() -> None:
    assert "no answer for 10 s" in drawn(busy(), "no answer for 10 s")


def test_many_are_counted() -> None:
    state = busy()
    state["workers"] *= 100
    assert "and 70 more" in drawn(state)


def test_an_absent_server_is_an_error(capsys: pytest.CaptureFixture[str], unused_port: int) -> None:
    assert main(["--connect", f"tcp://127.0.0.1:{unused_port}", "--once", "--timeout-seconds", "0.2"]) == 1
    assert "no answer for 0.2 s; is v2v-serve running there?" in capsys.readouterr().err


@pytest.mark.slow
def test_beside_a_server(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_clip(tmp_path / "a.mp4", panned_luma(60, 64, 80))
    small = ("--set", "voxels_per_clip=4", "--set", "crop_height_px=32", "--set", "crop_width_px=40")
    with LocalServer(tmp_path, workers=1, flags=small) as server:
        assert main(["--connect", server.address, "--once"]) == 0
        assert "No consumer is connected" in capsys.readouterr().out

        # On a terminal: again and again, until Ctrl-C.
        ours, theirs = pty.openpty()
        program = subprocess.Popen(
            [sys.executable, "-m", "v2v_protocol.programs", "top", "--connect", server.address],
            stdin=theirs,
            stdout=theirs,
            stderr=theirs,
            env=os.environ | {"TERM": "xterm-256color", "COLUMNS": "120", "LINES": "40"},
            # A shell that runs the tests in the background passes on that SIGINT is ignored.
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        )
        os.close(theirs)
        os.set_blocking(ours, False)
        said = b""

        def seen(times: int) -> bool:
            nonlocal said
            with suppress(BlockingIOError):
                said += os.read(ours, 1 << 16)
            return said.count(b"No consumer is connected") >= times

        try:
            until(lambda: seen(2))
            program.send_signal(signal.SIGINT)
            assert program.wait(60) == 130
        finally:
            program.kill()
            program.wait()
            os.close(ours)
