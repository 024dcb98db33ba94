"""Test what a running server and `v2v-top` show of the status."""

from __future__ import annotations

import io
import json
import os
import pty
import signal
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest
import zmq
from rich.console import Console

from tests.clips import panned_luma, write_clip
from tests.server.peers import Peers, peers
from tests.server.status.services import Published, published
from tests.waiting import until
from v2v_client.local_server import LocalServer
from v2v_protocol.errors import ProtocolError
from v2v_protocol.messages import Status, encode
from v2v_server.broker.state import Counters
from v2v_server.commands.top import main
from v2v_server.status.client import StatusClient
from v2v_server.status.snapshot import StatusFields
from v2v_server.status.terminal import StatusView, draw, format_shutdown_summary, line
from v2v_server.system.log import Log


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def said(status: StatusFields) -> str:
    """Return the line of a status in a log."""
    stream = io.StringIO()
    StatusView(Log(), stream).show(0.0, status)
    return stream.getvalue().removesuffix("\n")


def test_the_line_counts_what_happened(at: Peers, service: Published) -> None:
    before = service.status()
    at.join()
    at.hello(batch_size=2)
    at.want(0, 1, 2, 3)
    at.finish()
    at.finish()
    at.now = 10.0
    assert said(before) == (
        "0.00 batches/s  0.0 samples/s  workers 0/0  consumers 0  queue 0  faults 0  total 0 samples"
    )
    assert said(service.status()) == (
        "0.10 batches/s  0.2 samples/s  workers 1/1  consumers 1  queue 0  faults 0  total 2 samples"
    )


def test_a_log_gets_a_line_every_ten_seconds_without_control_sequences(at: Peers, service: Published) -> None:
    out, status = io.StringIO(), service.status()
    view = StatusView(Log(), out)
    assert view.is_due(100.0)
    view.show(100.0, status)
    assert not view.is_due(109.9)
    assert view.is_due(110.0)
    view.interrupt()
    for now in (110.0, 120.0):  # an idle server says so once
        view.show(now, status)
    assert out.getvalue() == said(status) + "\n"
    at.join()
    view.show(130.0, service.status())
    view.close()
    assert out.getvalue() == said(status) + "\n" + said(service.status()) + "\n"


def test_a_line_of_any_thread_stays_above_what_a_terminal_shows(monkeypatch: pytest.MonkeyPatch) -> None:
    out, log, status = Terminal(), Log(), published(peers()).status()
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr("sys.stderr", out)
    view = StatusView(log, out)
    view.show(0.0, status)
    shown = out.getvalue()
    other = threading.Thread(target=log.say, args=("refused a connection of user 7",))
    other.start()
    other.join()
    view.show(1.0, status)
    cleared, line, again = out.getvalue()[len(shown) :].partition("refused a connection of user 7\n")
    assert cleared.startswith(f"\x1b[{shown.count(chr(10))}F\x1b[J")
    assert line
    assert again == shown


def test_programs_get_the_same_as_json(capsys: pytest.CaptureFixture[str]) -> None:
    status = published(peers()).status()
    StatusView(Log(is_json=True), Terminal()).show(0.0, status)
    line: dict[str, Any] = json.loads(capsys.readouterr().err)
    assert line["text"] == status["waiting"]["sentence"]
    assert datetime.fromisoformat(line["time"]).utcoffset() is not None
    names = ("samples_per_second", "batches_per_second", "workers", "consumers", "queue", "faults", "samples")
    assert [line[name] for name in names] == [0] * 7
    assert line["slow_part"] == "no_consumers"
    assert line["is_ready"] is status["is_ready"]
    assert line["totals"] == status["totals"]


def test_workers_that_start_and_those_of_other_hosts_are_counted(at: Peers) -> None:
    for number in range(3):
        at.join(b"remote%d" % number)
    status = published(at).plain()
    assert "workers 3/3" in said(status)
    assert "workers 3/7" in said(status | {"worker_processes": 7})


def test_shared_decodes_shared_memory_and_the_cache_are_named_where_there_are_any(at: Peers) -> None:
    at.broker.counters.samples, at.broker.counters.decodes = 30, 12
    at.broker.counters.in_slots, at.broker.counters.cache_hits, at.broker.counters.cache_misses = 15, 9, 3
    status = published(at).plain()
    assert "2.5 samples per decode  50% by shared memory  cache 75% hits  workers" in said(status)
    cache = {"folder": "/cache", "held_gib": 1.5, "most_gib": 4.0, "hits": 9, "misses": 3, "trouble": "no room"}
    assert "cache 75% hits, 1.50 of 4 GiB (no room)  workers" in said(status | {"cache": cache})


def test_unusual_events_are_named_once_there_are_any(at: Peers) -> None:
    at.broker.counters.malformed, at.broker.counters.returned_leases = 2, 3
    assert said(published(at).status()).endswith("faults 2  total 0 samples  3 returned leases  2 malformed")


def test_a_terminal_shows_a_few_lines_in_the_place_of_the_previous_ones(at: Peers) -> None:
    out = Terminal()
    view = StatusView(Log(), out)
    service = published(at)
    view.show(0.0, service.status())
    first = out.getvalue()
    assert "No consumer is connected" in first
    assert not view.is_due(0.4)
    assert view.is_due(0.5)
    at.join()
    at.hello(batch_size=2)
    at.want(0, 1)
    at.finish()
    view.show(0.6, service.status())
    second = out.getvalue().removeprefix(first)
    assert second.startswith(f"\x1b[{first.count(chr(10))}F\x1b[J")
    assert "1 consumer" in second
    assert "1/50" in second
    view.interrupt()
    assert out.getvalue().endswith(f"\x1b[{second.count(chr(10))}F\x1b[J")
    view.close()
    view.interrupt()
    assert out.getvalue().count("\x1b[J") == 2


def test_a_hostile_name_does_not_steer_the_terminal() -> None:
    status = published(peers()).plain()
    status["waiting"]["sentence"] = "a\x1b[2Jb"
    out = Terminal()
    StatusView(Log(), out).show(0.0, status)
    assert "\x1b[2J" not in out.getvalue()


def test_faults_are_the_counters_that_say_so() -> None:
    counters = Counters(samples=9, refused_candidates=1, unavailable=2, workers_lost=4, malformed=8, late_results=16)
    assert counters.faults == 15
    assert replace(counters, returned_leases=5).faults == 15


def test_samples_faults_and_rates_are_summed_up(at: Peers) -> None:
    counters = at.broker.counters
    counters.samples, counters.batches, counters.decodes, counters.bytes = 600, 50.0, 200, 3 << 30
    counters.refused_candidates, counters.workers_lost, counters.returned_leases = 2, 1, 4
    counters.waited_seconds = 90.0
    counters.decode_seconds, counters.simulate_seconds, counters.handover_seconds = 200.0, 150.0, 50.0
    status = published(at).plain() | {"uptime_seconds": 3 * 3600.0}
    assert format_shutdown_summary(status) == [
        "in total 600 samples (50.0 batches, 3.00 GiB, from 200 decoded clips) in 3 h 0 min: 0.06 samples/s",
        "faults 3; 2 refused candidates, 4 returned leases, 1 workers lost",
        "workers spent 7 min on them: decoding 50%, simulating 38%, delivering 12%; consumers waited 90.0 s",
    ]


# --- `v2v-top`: what is drawn, and the program beside a real server ---------------------------------------------------


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


def test_the_sentence_is_shown_names_are_text_many_are_counted_and_an_old_state_is_said_to_be_one() -> None:
    state = busy()
    state["workers"] *= 100
    text = drawn(state, "no answer for 10 s")
    assert state["waiting"]["sentence"] in text
    assert state["waiting"]["sentence"] in line(state)
    assert "1 consumer" in text
    assert "1 worker" in text
    assert "and 70 more" in text
    assert "no answer for 10 s" in text
    assert "[red]x[/red]" in text
    assert "[bold]cut" in text
    assert "\x1b" not in text


def test_an_absent_server_is_an_error(capsys: pytest.CaptureFixture[str], unused_port: int) -> None:
    assert main(["--connect", f"tcp://127.0.0.1:{unused_port}", "--once", "--timeout-seconds", "0.2"]) == 1
    assert "no answer for 0.2 s; is v2v-serve running there?" in capsys.readouterr().err


@pytest.mark.parametrize(("text", "why"), [
    (b"no", "that is not JSON"), (b"[]", "without a version"), (b'{"version": "1"}', "without a version"),
])  # fmt: skip
def test_a_status_that_cannot_be_read_is_refused(text: bytes, why: str) -> None:
    with zmq.Context() as context, context.socket(zmq.ROUTER) as server, ThreadPoolExecutor(1) as thread:
        port = server.bind_to_random_port("tcp://127.0.0.1")
        with StatusClient(f"tcp://127.0.0.1:{port}") as client:
            answer = thread.submit(client.get_status, 60.0)
            server.send_multipart([server.recv_multipart()[0], *encode(Status(text))])
            with pytest.raises(ProtocolError, match=f":{port} sent a status {why}$"):
                answer.result()


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
