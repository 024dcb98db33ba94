"""Confined processes have no terminal, and none of them outlasts the process that started them. Tried on a real one."""

from __future__ import annotations

import os
import pty
import re
import signal
import subprocess
import sys
import termios
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from fcntl import ioctl
from pathlib import Path

import psutil
import pytest

from tests.clips import panned_luma, write_clip
from tests.waiting import has_ended, until

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="Linux only")

PARENT = """
import os, sys, time
from v2v_server.supervise.local_host import WorkerProcess
from v2v_server.system.isolate import run_isolated

def report(job: int) -> int:
    try:
        os.close(os.open("/dev/tty", os.O_RDONLY))
        found = "a terminal"
    except OSError:
        found = "no terminal"
    streams = [os.isatty(number) for number in range(3)]
    print("found", found, streams, repr(sys.stdin.read()), os.getsid(0) == os.getpid())
    print("a name\\x1b[31m of\\u202e a file", file=sys.stderr)
    os.write(1, b"\\xff\\n")
    return job

def last(job: int) -> int:
    print("waiting", flush=True)
    time.sleep(600)
    return job

if __name__ == "__main__":
    from parent import last, report

    list(run_isolated(report, [1], 1, writable=[]))
    standby = WorkerProcess()
    list(run_isolated(last, [1], 1, writable=[]))
"""


class Terminal:
    """A terminal with a program in its foreground.

    Attributes:
        child: the program.
        text: what it has shown.
    """

    def __init__(self, child: subprocess.Popen[bytes], ours: int) -> None:
        self.child, self._ours, self.text = child, ours, ""

    def read(self) -> str:
        with suppress(OSError):  # nothing new, or the last process that had it open has ended
            self.text += os.read(self._ours, 1 << 16).decode()
        return self.text

    def type(self, text: bytes) -> None:
        os.write(self._ours, text)

    def close(self) -> None:
        ours, self._ours = self._ours, -1
        os.close(ours)

    def processes(self) -> list[psutil.Process]:
        return [psutil.Process(self.child.pid), *psutil.Process(self.child.pid).children(recursive=True)]


def _take_terminal() -> None:
    # A shell that runs the tests in the background passes on that SIGINT is ignored.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    ioctl(0, termios.TIOCSCTTY, 0)


@contextmanager
def on_a_terminal(*command: str) -> Iterator[Terminal]:
    """Run a program in a session with a terminal of its own."""
    ours, theirs = pty.openpty()
    os.set_blocking(ours, False)
    child = subprocess.Popen(
        [sys.executable, *command],
        stdin=theirs,
        stdout=theirs,
        stderr=theirs,
        start_new_session=True,
        preexec_fn=_take_terminal,
    )
    os.close(theirs)
    terminal = Terminal(child, ours)
    found = []
    try:
        yield terminal
        found = terminal.processes() if child.poll() is None else []
    finally:
        child.kill()
        child.wait()
        with suppress(OSError):
            terminal.close()
        until(lambda: all(map(has_ended, found)))


@pytest.fixture
def script(tmp_path: Path) -> str:
    (tmp_path / "parent.py").write_text(PARENT)
    return str(tmp_path / "parent.py")


def interrupt(terminal: Terminal) -> None:
    terminal.type(b"\x03")


def hang_up(terminal: Terminal) -> None:
    terminal.close()


def kill(terminal: Terminal) -> None:
    os.kill(terminal.child.pid, signal.SIGKILL)


def terminate(terminal: Terminal) -> None:
    os.kill(terminal.child.pid, signal.SIGTERM)


@pytest.mark.parametrize("end", [interrupt, hang_up, kill, terminate])
def test_no_process_outlasts_its_parent_and_none_has_a_terminal(script: str, end: Callable[[Terminal], None]) -> None:
    with on_a_terminal(script) as terminal:
        until(lambda: "waiting" in terminal.read())
        assert "found no terminal [False, False, False] '' True\r\n" in terminal.text
        assert "a name\\x1b[31m of\\u202e a file\r\n" in terminal.text
        assert "\\xff\r\n" in terminal.text
        assert not re.search("[\x1b\u202e]", terminal.text)
        processes = terminal.processes()
        apart = [each for each in processes if os.getsid(each.pid) != terminal.child.pid]
        assert len(apart) >= 2  # a process that reads, and a worker
        end(terminal)
        until(lambda: terminal.child.poll() is not None)
        until(lambda: all(map(has_ended, processes)))


def test_what_is_printed_last_arrives() -> None:
    program = (
        "import subprocess, sys\n"
        "from v2v_server.system.process import relayed_output\n"
        'print_ = \'import sys; [print(number) for number in range(20_000)]; print("end", end="")\'\n'
        "subprocess.call([sys.executable, '-c', print_], stdout=relayed_output().fileno())\n"
    )
    done = subprocess.run([sys.executable, "-c", program], stderr=subprocess.PIPE, text=True, check=True)
    assert done.stderr.split() == [*map(str, range(20_000)), "end"]


@pytest.mark.slow
def test_a_worker_that_a_person_starts_leaves_the_terminal_and_ends_with_ctrl_c(tmp_path: Path) -> None:
    write_clip(tmp_path / "clips" / "a.mp4", panned_luma(8))
    command = (
        "-m",
        "v2v_server.commands.worker",
        "--connect",
        "tcp://127.0.0.1:9",
        "--videos",
        str(tmp_path / "clips"),
    )
    with on_a_terminal(*command) as terminal:
        until(lambda: len(terminal.processes()) > 1)
        processes = terminal.processes()
        for stream in range(3):
            until(lambda stream=stream: "/dev/pts" not in os.readlink(f"/proc/{processes[1].pid}/fd/{stream}"))  # type: ignore[misc]
        assert os.getsid(processes[1].pid) == processes[1].pid
        terminal.type(b"\x03")
        assert terminal.child.wait(60) == 130
        until(lambda: all(map(has_ended, processes)))


def test_a_worker_says_wrong_usage_with_its_status() -> None:
    with on_a_terminal("-m", "v2v_server.commands.worker", "--connect", "x", "--videos", "/none/such") as terminal:
        assert terminal.child.wait(120) == 2
        assert "v2v-worker: " in terminal.read()
