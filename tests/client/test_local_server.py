import os
import tempfile
from types import SimpleNamespace

import psutil
import pytest

from tests.waiting import has_ended, until
from v2v_client.local_server import LocalServer
from v2v_protocol.errors import ServerLost, UsageError

BEGIN = """
import pathlib, signal, subprocess, sys
flags = dict(zip(sys.argv[1::2], sys.argv[2::2]))
"""
LISTEN = "pathlib.Path(flags['--port-file']).write_text('tcp://127.0.0.1:' + flags['--workers'])\n"
CHILD = "subprocess.Popen([sys.executable, '-c', 'import signal; signal.pause()'])\n"
POLITE = "signal.pause()\n"
DEAF = "signal.signal(signal.SIGTERM, signal.SIG_IGN)\n"


@pytest.fixture
def program(tmp_path, monkeypatch):
    """Replace ``python -m v2v_server`` by a program of the test."""

    def write(text):
        package = tmp_path / "v2v_server"
        package.mkdir()
        (package / "__init__.py").touch()
        (package / "__main__.py").write_text(BEGIN + text)
        monkeypatch.chdir(tmp_path)
        monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)

    return write


def test_the_server_runs_inside_the_block_and_stops_with_its_children(program):
    program(CHILD + LISTEN + POLITE)
    with LocalServer("videos", workers=7) as server:
        assert server.address == "tcp://127.0.0.1:7"
        tree = [psutil.Process(server.pid), *psutil.Process(server.pid).children(recursive=True)]
        assert len(tree) == 2
        pids = {process.pid for process in tree}
        assert server.cpu_seconds().keys() == pids
        assert server.rss_bytes().keys() == pids
        assert all(size > 0 for size in server.rss_bytes().values())
    assert all(map(has_ended, tree))
    with pytest.raises(UsageError, match="is not running"):
        server.cpu_seconds()
    server.stop()


def test_a_server_that_does_not_stop_is_killed(program):
    program(DEAF + LISTEN + "while True: signal.pause()\n")
    with LocalServer("videos", stop_seconds=0.2) as server:
        process = psutil.Process(server.pid)
    assert not process.is_running()


@pytest.mark.parametrize(("status", "error"), [(2, UsageError), (3, ServerLost)])
def test_the_error_quotes_the_output_of_a_dead_server(program, status, error):
    program(f"sys.stderr.write('v2v-serve: no such folder: ' + flags['--videos'] + '\\n'); sys.exit({status})")
    with pytest.raises(error, match=f"status {status} .*no such folder: videos"), LocalServer("videos"):
        pass


def test_a_server_that_does_not_listen_in_time_is_stopped(program):
    program(POLITE)
    before = len(psutil.Process().children())
    with pytest.raises(ServerLost, match=r"does not listen after 0\.3 s"), LocalServer("videos", start_seconds=0.3):
        pass
    assert len(psutil.Process().children()) == before


def test_a_server_that_reports_progress_gets_more_time(tmp_path, monkeypatch):
    server, port_file = LocalServer("videos", start_seconds=60.0), tmp_path / "port"
    now, steps = 0.0, iter([*[b"probing videos\n"] * 20, b"", b""])

    def sleep(_):
        nonlocal now
        now += 50.0
        server._errors.write(next(steps))
        server._errors.flush()

    monkeypatch.setattr("v2v_client.local_server.time", SimpleNamespace(monotonic=lambda: now, sleep=sleep))
    silent = r"does not listen after 60 s of silence: .*probing videos"
    with tempfile.TemporaryFile() as server._errors, pytest.raises(ServerLost, match=silent):
        server._wait_for(port_file, SimpleNamespace(poll=lambda: None))
    assert now == 22 * 50.0


def test_flags_reach_the_server(program):
    program(LISTEN.replace("flags['--workers']", "flags['--rows']") + POLITE)
    with LocalServer("videos", flags=["--rows", "9"]) as server:
        assert server.address.endswith(":9")


def test_output_written_while_it_is_read_is_not_lost(program):
    program(
        LISTEN
        + "import time\n"
        + "for line in range(600): time.sleep(2e-4); sys.stderr.write(f'line {line:04d}\\n'); sys.stderr.flush()\n"
        + POLITE
    )
    with LocalServer("videos") as server:
        until(lambda: "line 0599" in server.last_lines())
        assert os.fstat(server._errors.fileno()).st_size == 600 * len("line 0000\n")
