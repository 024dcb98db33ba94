"""The page as a person sees it: a real browser, a real server, a real stream."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest

from bench.processes import free_ports
from tests.clips import panned_luma, write_clip
from tests.server.page.browser import CHROMIUM, Browser
from tests.server.page.test_child import SMALL, got
from tests.waiting import until
from v2v_client import V2VStreamDataset
from v2v_client.local_server import LocalServer

pytestmark = [
    pytest.mark.slow,
    pytest.mark.alone,  # it is asked how soon things are seen
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here"),
]

HOSTILE = "<img src=x onerror=document.title='taken'>.mp4"
CUT = "<b>cut<b>.mp4"
SENT = "document.querySelector('#tiles dd small').textContent"


class Consumer:
    """Takes batches in a thread, as long as it is told to; a context manager."""

    def __init__(self, address: str) -> None:
        self.batches = 0
        self._stop = threading.Event()
        self._dataset = V2VStreamDataset(address, 2, rank=0, world_size=1, timeout_seconds=120.0)
        self._thread = threading.Thread(target=self._take, daemon=True)

    def _take(self) -> None:
        while not self._stop.is_set():
            for _ in self._dataset:
                self.batches += 1
                if self._stop.wait(0.02):
                    return

    def __enter__(self) -> Consumer:
        self._thread.start()
        return self

    def __exit__(self, *_error: object) -> None:
        self._stop.set()
        self._thread.join()


@pytest.fixture(scope="module")
def clips(compiled: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("page-clips")
    for number in range(8):
        write_clip(folder / f"{number}.mp4", panned_luma(120, 64, 80))
    (folder / "0.mp4").rename(folder / HOSTILE)
    (folder / CUT).write_bytes((folder / "1.mp4").read_bytes()[:3000])
    return folder


@pytest.fixture
def port() -> int:
    return free_ports(1)[0]


@pytest.fixture
def served(clips: Path, port: int) -> Iterator[LocalServer]:
    flags = ["--page", str(port), *SMALL]
    with LocalServer(clips, workers=2, flags=flags) as server:
        yield server


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with Browser() as started:
        yield started


def states(port: int) -> dict[str, Any]:
    status, text = got(port, "/state")
    assert status == 200
    found: dict[str, Any] = json.loads(text)
    return found


def test_a_stream_is_seen_and_a_killed_worker_soon(served: LocalServer, port: int, browser: Browser) -> None:
    with Consumer(served.address):
        browser.open(f"http://127.0.0.1:{port}/")
        browser.until("document.querySelectorAll('#workers tbody tr').length === 2")
        browser.until("document.querySelectorAll('#consumers .taking, #consumers .stalled').length === 1")
        browser.value(f"window.before = {SENT}")
        browser.until(f"{SENT} !== window.before")
        browser.until("charts.speed.data[0].length > 3")

        # A name that is markup stays a name.
        said = set()

        def named() -> bool:
            said.update(browser.value("[...document.querySelectorAll('#workers td.wide')].map((at) => at.textContent)"))
            return any(text.startswith(HOSTILE) for text in said)

        until(named)
        assert browser.value("document.images.length") == 0
        assert browser.value("document.title").endswith("v2v-serve")

        # A worker that is killed shows.
        assert served.pid is not None
        workers = [
            child for child in psutil.Process(served.pid).children() if "v2v_server.commands.worker" in child.cmdline()
        ]
        workers[0].kill()
        restarts = "[...document.querySelectorAll('#workers tbody tr')].map((row) => row.lastChild.textContent)"
        browser.until(f"{restarts}.includes('1') || document.querySelectorAll('#workers tbody tr').length < 2")
        browser.until(f"{restarts}.includes('1')")
        assert browser.complaints == []


def test_a_server_that_is_gone_is_said_and_one_that_comes_back_is_shown(
    clips: Path, port: int, browser: Browser
) -> None:
    flags = ["--page", str(port), *SMALL]
    with LocalServer(clips, workers=1, flags=flags) as server:
        browser.open(f"http://127.0.0.1:{port}/")
        browser.until("document.querySelectorAll('#workers tbody tr').length === 1")
        assert browser.value("document.getElementById('lost').hidden")
        browser.value("fields = []")  # as if they had not arrived
        assert server.pid is not None
        psutil.Process(server.pid).kill()
        browser.until("!document.getElementById('lost').hidden")
        assert "does not answer" in browser.value("document.getElementById('lost').textContent")
    with LocalServer(clips, workers=1, flags=flags):
        browser.until("document.getElementById('lost').hidden")
        browser.until("document.querySelectorAll('#shares .bar').length > 1")


def test_a_page_that_is_left_open_does_not_grow(served: LocalServer, port: int, browser: Browser) -> None:
    """Two hours of states in one go."""
    browser.open(f"http://127.0.0.1:{port}/")
    browser.until("document.querySelectorAll('#workers tbody tr').length === 2")
    state = states(port)
    state["consumers"] = [consumer_state(number) for number in range(250)]
    elements = "document.querySelectorAll('*').length"
    first, rows, last, points = browser.value(  # in one go, or the server's own states come between
        f"""(() => {{
            const state = {json.dumps(state)};
            for (let i = 0; i < 10; i++) show(state);
            const first = {elements}, rows = document.querySelectorAll('#consumers tbody tr').length;
            for (let i = 0; i < 14400; i++) i % 100 ? remember('speed', [i, 1, 1]) : show(state);
            return [first, rows, {elements}, Math.max(...Object.values(past).flat().map((each) => each.length))];
        }})()"""
    )
    assert (rows, last, points) == (201, first, 1200)


def consumer_state(number: int) -> dict[str, Any]:
    texts = {"id": f"{number:032x}", "name": f"rank {number}", "host": "h", "state": "taking", "spec": "s"}
    figures = ("epoch", "position", "batch_size", "credit", "in_flight", "waiting", "served", "samples_per_second")
    return {
        **texts,
        **dict.fromkeys(figures, 1),
        "sequences": 2,
        "eta_seconds": None,
        "batches_per_second": 1.0,
        "waiting_share": 0.5,
    }
