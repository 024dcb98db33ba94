"""What processes ask of the operating system. Each in a process of its own: these settings last."""

from __future__ import annotations

import platform
import subprocess
import sys

import pytest

from v2v_server import process

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="Linux only")


def _in_a_process(code: str) -> list[str]:
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    return done.stdout.split()


def _kernel() -> tuple[int, ...]:
    return tuple(int(part) for part in platform.release().split("-")[0].split(".")[:2])


def test_long_turns_leave_niceness_and_policy_alone() -> None:
    said = _in_a_process(
        "import os\n"
        "from v2v_server.process import take_long_turns\n"
        "os.nice(5)\n"
        "print(take_long_turns(), os.nice(0), os.sched_getscheduler(0) == os.SCHED_OTHER)\n"
    )
    assert said[1:] == ["5", "True"]


@pytest.mark.skipif(platform.machine() != "x86_64", reason="the call's number is that of x86-64")
@pytest.mark.skipif(_kernel() < (6, 12), reason="the kernel grants long turns from 6.12 on")
def test_the_kernel_grants_the_long_turns() -> None:
    said = _in_a_process(
        "import ctypes, struct\n"
        "from v2v_server.process import take_long_turns\n"
        "def turn_ns():\n"
        "    attributes = ctypes.create_string_buffer(48)\n"
        "    assert ctypes.CDLL(None).syscall(315, 0, attributes, 48, 0) == 0\n"
        "    return struct.unpack('=IIQiIQQQ', attributes.raw)[5]\n"
        "before = turn_ns()\n"
        "print(take_long_turns(), before < 10**8, turn_ns())\n"
    )
    assert said == ["True", "True", "100000000"]


def test_who_was_put_to_run_when_nobody_else_does_keeps_to_that() -> None:
    said = _in_a_process(
        "import os\n"
        "from v2v_server.process import take_long_turns\n"
        "os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))\n"
        "print(take_long_turns(), os.sched_getscheduler(0) == os.SCHED_IDLE)\n"
    )
    assert said == ["False", "True"]


def test_a_machine_whose_calls_are_not_known_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(platform, "machine", lambda: "riscv64")
    assert not process.take_long_turns()
