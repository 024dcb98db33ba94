"""What a confined process cannot do any more, tried for real in processes of their own."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from v2v_server.system.sandbox import can_confine

pytestmark = pytest.mark.skipif(
    not can_confine().calls or not can_confine().files, reason="this kernel has no seccomp or no Landlock"
)

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
