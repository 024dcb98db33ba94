"""What a confined process cannot do any more, tried for real in processes of their own."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from v2v_server.system.sandbox import can_confine

pytestmark = pytest.mark.skipif(
    not can_confine().calls or not can_confine().files, reason="this kernel has no seccomp or no Landlock"
)

LEGACY = Path("/proc/sys/dev/tty/legacy_tiocsti")
"""Whether this kernel lets users type into their terminal; root always may."""

TRY = """
import errno, os, socket, subprocess, sys, threading
from pathlib import Path
from v2v_server.system.sandbox import confine

def tried(what):
    try:
        what()
    except OSError as error:
        return errno.errorcode[error.errno]
    return "done"

def in_thread(what):
    go, said = threading.Event(), []
    thread = threading.Thread(target=lambda: (go.wait(), said.append(tried(what))))
    thread.start()
    return lambda: (go.set(), thread.join(), said[0])[-1]
"""


def said(program: str, *arguments: str) -> list[str]:
    done = subprocess.run(
        [sys.executable, "-c", TRY + program, *arguments], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


def test_no_program_no_network_no_other_process() -> None:
    program = """
from_before = in_thread(lambda: os.execv("/bin/true", ["true"]))
confined = confine(None, network=False)
print(confined.calls, confined.files)
print(tried(lambda: subprocess.run(["/bin/true"])))
print(tried(lambda: socket.socket(socket.AF_INET, socket.SOCK_STREAM)))
print(tried(lambda: socket.socket(socket.AF_INET6, socket.SOCK_DGRAM)))
print(tried(lambda: socket.socket(socket.AF_UNIX)))
print(tried(lambda: socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)))
print(from_before())
import ctypes
kernel = ctypes.CDLL(None, use_errno=True)
print(kernel.ptrace(16, os.getppid(), None, None), errno.errorcode[ctypes.get_errno()])
print(Path("/proc/self/status").read_text().partition("Seccomp:")[2].split()[0])
"""
    assert said(program) == ["True", "False", *["EPERM"] * 6, "-1", "EPERM", "2"]


CALLS = """
import ctypes, platform, resource, signal, struct
kernel = ctypes.CDLL(None, use_errno=True)
column = ("x86_64", "aarch64").index(platform.machine())

def call(numbers, *arguments):
    if kernel.syscall(numbers[column], *map(ctypes.c_long, arguments)) != -1:
        return "done"
    return errno.errorcode[ctypes.get_errno()]
"""


def test_it_starts_no_process_enters_no_namespace_and_changes_no_other_process() -> None:
    """Each call is refused by the filter, with EPERM: as root most of them would succeed, and the others fail in
    another way.
    """
    program = """
other = int(sys.argv[1])
limit = ctypes.create_string_buffer(16)
affinity = ctypes.create_string_buffer(struct.pack("@128x"), 128)
confine(None, network=True)
print(tried(os.fork))
print(tried(lambda: os.posix_spawn("/bin/true", ["true"], {})))
print(call((435, 435), 0, 0))  # clone3
parameter = ctypes.create_string_buffer(4)
print(call((144, 119), other, os.SCHED_BATCH, ctypes.addressof(parameter)), os.sched_getscheduler(other))
print(call((272, 97), 0x10000000))  # unshare
for flag in (0x20000, 0x02000000, 0x04000000, 0x08000000, 0x10000000, 0x20000000, 0x40000000):
    print(call((56, 220), flag | signal.SIGCHLD, 0, 0, 0, 0))
    print(call((56, 220), flag | 0x10000, 0, 0, 0, 0))  # as a thread
for numbers in ((165, 40), (428, 428), (429, 429), (430, 430), (431, 431), (432, 432), (433, 433), (442, 442)):
    print(call(numbers, 0, 0, 0, 0, 0))  # mount and its newer calls
print(call((302, 261), other, resource.RLIMIT_NOFILE, 0, ctypes.addressof(limit)))
print(call((203, 122), other, 8, ctypes.addressof(affinity)))
print(tried(lambda: os.setpriority(os.PRIO_PROCESS, other, 1)))
print(tried(lambda: os.setpriority(os.PRIO_PROCESS, 0, 1)))
"""
    with subprocess.Popen([sys.executable, "-c", "import signal; signal.pause()"]) as other:
        try:
            found = said(CALLS + program, str(other.pid))
        finally:
            other.kill()
    assert found == ["EPERM", "EPERM", "ENOSYS", "done", str(os.SCHED_OTHER), *["EPERM"] * (len(found) - 5)]


def test_zeromq_starts_its_threads() -> None:
    assert said('confine(None, network=True); import zmq; zmq.Context().socket(zmq.DEALER).close(); print("done")') == [
        "done"
    ]


def test_its_own_limits_threads_and_affinity_are_left() -> None:
    program = """
confine(None, network=False)
resource.setrlimit(resource.RLIMIT_NOFILE, resource.getrlimit(resource.RLIMIT_NOFILE))
os.sched_setaffinity(0, os.sched_getaffinity(0))
ended = []
thread = threading.Thread(target=lambda: ended.append("done"))
thread.start()
thread.join()
print(*ended)
"""
    assert said(CALLS + program) == ["done"]


@pytest.mark.parametrize("is_confined", [True, False])
def test_it_types_nothing_into_a_terminal(is_confined: bool) -> None:
    """Its own terminal, which this test makes. Without the filter the typed letter arrives, if the kernel allows it."""
    program = """
import fcntl, pty, select, termios
ours, terminal = pty.openpty()
os.setsid()
fcntl.ioctl(terminal, termios.TIOCSCTTY, 0)
if sys.argv[1] == "True":
    confine(None, network=False)
for command in (termios.TIOCSTI, 0x541C, termios.TIOCSTI | 1 << 32):
    argument = ctypes.create_string_buffer(b"x")
    failed = kernel.ioctl(terminal, ctypes.c_ulong(command), argument) == -1
    print(errno.errorcode[ctypes.get_errno()] if failed else "typed")
"""
    found = said(CALLS + program, str(is_confined))
    if is_confined:
        assert found == ["EPERM"] * 3
    elif os.geteuid() == 0 or (LEGACY.exists() and LEGACY.read_text().strip() == "1"):
        assert found[0] == found[2] == "typed"


def test_with_a_network_only_the_network_is_left() -> None:
    program = """
confine(None, network=True)
print(tried(lambda: socket.socket(socket.AF_INET, socket.SOCK_STREAM)))
print(tried(lambda: subprocess.run(["/bin/true"])))
"""
    assert said(program) == ["done", "EPERM"]


def test_nothing_is_written_but_where_it_may_be(tmp_path: Path) -> None:
    allowed, elsewhere = tmp_path / "allowed", tmp_path / "elsewhere"
    for folder in (allowed, elsewhere):
        folder.mkdir()
        (folder / "there").write_text("before")
    program = """
allowed, elsewhere = map(Path, sys.argv[1:])
print(confine([allowed, Path("/none/such")], network=False).files)
for folder in (allowed, elsewhere):
    print(tried((folder / "new").touch))
    print(tried(lambda: (folder / "there").write_text("after")))
    print(tried(lambda: os.truncate(folder / "there", 0)))
    print(tried((folder / "there").unlink))
    print(tried((folder / "folder").mkdir))
    print(tried(lambda: (folder / "link").symlink_to("x")))
print(tried(lambda: Path(os.devnull).write_text("x")))
print(tried((elsewhere / "there").read_text))
print(tried(lambda: os.listdir("/")))
print(os.memfd_create("memory") > 0)
"""
    assert said(program, str(allowed), str(elsewhere)) == [
        "True", *["done"] * 6, *["EACCES"] * 6, "done", "done", "done", "True"
    ]  # fmt: skip
    assert (elsewhere / "there").read_text() == "before"


def test_without_the_kernels_help_nothing_happens() -> None:
    program = """
import platform
platform.machine = lambda: "a vacuum tube"
confined = confine([], network=False)
print(confined.calls, confined.files)
print(tried(lambda: subprocess.run(["/bin/true"])))
"""
    assert said(program) == ["False", "False", "done"]
