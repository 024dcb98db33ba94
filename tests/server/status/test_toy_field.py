"""Test that a new counter is two edits: in a copy of the server it reaches every view."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
DECLARED = ("broker/state.py", "    cache_hits: int = 0\n", '    pings: int = counter("Pings of consumers.")\n')
COUNTED = (
    "broker/dispatcher.py",
    "        match message:\n            case Hello():\n",
    "        broker.counters.pings += isinstance(message, Ping)\n",
)
VIEWS = """
import io, json, re
from rich.console import Console
from tests.server.page.asked import FakeClient, ask
from tests.server.peers import peers
from tests.server.status.services import published
from v2v_protocol.messages import Ping
from v2v_server.page.app import make_app
from v2v_server.page.app import Source
from v2v_server.status.terminal import StatusView
from v2v_server.status.terminal import format_shutdown_summary
from v2v_server.status.terminal import draw
from v2v_server.system.log import Log

at = peers()
service = published(at)
for _ in range(7):
    at.consumer_says(b"c", Ping())
app, status, lines = make_app(Source(FakeClient(service))), service.status(), io.StringIO()
StatusView(Log(), lines).show(0.0, status)
with (console := Console(width=300)).capture() as drawn:
    console.print(draw(status))
print(json.dumps({
    "state": json.loads(ask(app, "/state").body)["totals"]["pings"],
    "metrics": "v2v_pings_total 7.0" in ask(app, "/metrics").text,
    "terminal": "7 pings" in drawn.get(),
    "page": [each["help"] for each in json.loads(ask(app, "/fields").body) if each["name"] == "pings"],
    "log": "7 pings" in lines.getvalue(),
    "summary": [line for line in format_shutdown_summary(status) if "7 pings" in line],
}))
"""


@pytest.mark.slow
def test_a_new_counter_reaches_every_view(tmp_path: Path) -> None:
    for package in ("v2v_protocol", "v2v_server"):
        shutil.copytree(ROOT / package, tmp_path / package, ignore=shutil.ignore_patterns("__pycache__"))
    (tmp_path / "tests").symlink_to(ROOT / "tests")
    for name, before, line in (DECLARED, COUNTED):
        path = tmp_path / "v2v_server" / name
        source = path.read_text("utf-8")
        assert source.count(before) == 1
        path.write_text(source.replace(before, line + before), "utf-8")
    done = subprocess.run(
        [sys.executable, "-c", VIEWS], cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(tmp_path)}, text=True,
        capture_output=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == {
        "state": 7,
        "metrics": True,
        "terminal": True,
        "page": ["Pings of consumers."],
        "log": True,
        "summary": ["faults 0; 7 pings"],
    }
