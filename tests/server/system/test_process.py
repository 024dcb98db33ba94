"""What processes ask of the operating system. Settings that last are made in a process of their own."""

from __future__ import annotations

import math
import os
import platform
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from v2v_protocol.errors import CorpusError
from v2v_server.commands import prepare as prepare_cli
from v2v_server.config import ServeConfig
from v2v_server.corpus.catalogue import Catalogue
from v2v_server.quarantine import Quarantine, QuarantineEntry, read_quarantine, write_entry
from v2v_server.serve import load_catalogue, serve
from v2v_server.store.quota import QuotaFolder
from v2v_server.system import process
from v2v_server.system.process import locked
from v2v_server.system.sandbox import can_confine

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="Linux only")


def _in_a_process(code: str) -> list[str]:
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return done.stdout.split()


def _kernel() -> tuple[int, ...]:
    return tuple(int(part) for part in platform.release().split("-")[0].split(".")[:2])


def test_cores_are_those_that_this_process_was_given(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)  # it may be written to
    said = _in_a_process(
        "import os\n"
        "from v2v_server.system.process import usable_cores\n"
        "os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})\n"
        "print(usable_cores())\n"
    )
    assert said == ["1"]
    monkeypatch.setattr(process, "_granted_cores", lambda: math.inf)
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {4, 5, 9})
    monkeypatch.setattr(os, "cpu_count", lambda: 64)
    processes = []

    def refuse(*_: object, **asked: object) -> None:
        processes.append(asked["processes"])
        raise CorpusError("seen enough")

    monkeypatch.setattr("v2v_server.serve.open_catalogue", refuse)
    monkeypatch.setattr("v2v_server.commands.prepare.open_catalogue", refuse)
    with pytest.raises(CorpusError):
        load_catalogue(ServeConfig(videos="videos", workers=16))
    with pytest.raises(CorpusError):
        load_catalogue(ServeConfig(videos="videos", workers=0))
    assert prepare_cli.main(["videos", "prepared"]) == 2
    assert processes == [3, 3, 3]
    monkeypatch.delattr(os, "sched_getaffinity")
    assert process.usable_cores() == 64
    monkeypatch.setattr(os, "cpu_count", lambda: None)
    assert process.usable_cores() == 1


def test_a_container_is_given_processor_time_instead_of_cores(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    own, groups = tmp_path / "own", tmp_path / "groups"
    (groups / "pods" / "mine").mkdir(parents=True)
    assert process._granted_cores(groups, own) == math.inf
    for file, text, granted in (
        (own, "1:name=systemd:/", math.inf),  # version 1
        (own, "0::/pods/mine", math.inf),
        (groups / "pods" / "mine" / "cpu.max", "max 100000", math.inf),
        (groups / "pods" / "cpu.max", "250000 100000", 2.5),
        (groups / "pods" / "mine" / "cpu.max", "50000 100000", 0.5),
        (groups / "cpu.max", "150000 100000", 0.5),
        (own, "0::/", 1.5),  # as in a container's own namespace
        (own, "0::/../elsewhere", 1.5),  # moved there from outside
    ):
        file.write_text(f"{text}\n")
        assert process._granted_cores(groups, own) == granted, (file, text)
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(64)))
    for granted, cores in ((0.5, 1), (1.5, 2), (4.0, 4), (100.0, 64), (math.inf, 64)):
        monkeypatch.setattr(process, "_granted_cores", lambda granted=granted: granted)
        assert process.usable_cores() == cores


@pytest.mark.parametrize("mount", ["cpu", "cpu,cpuacct", "cpuacct,cpu"])
def test_version_1_of_control_groups_limits_processor_time_too(mount: str, tmp_path: Path) -> None:
    own, top, hidden = tmp_path / "own", tmp_path / "groups" / mount, "docker/of the host"
    (top / "pod" / "mine").mkdir(parents=True)
    controllers = "cpu,cpuacct" if mount == "cpu" else mount  # cpu is a link there
    for folder, quota, path, granted in (
        (top, -1, hidden, math.inf),
        (top / "pod" / "mine", 400000, hidden, math.inf),
        (top / "pod" / "mine", 400000, "pod/mine", 4.0),
        (top / "pod", 150000, "pod/mine", 1.5),
        (top / "pod", 0, "pod/mine", 4.0),
        (top, 50000, hidden, 0.5),  # a container sees its own group as the topmost
    ):
        (folder / "cpu.cfs_quota_us").write_text(f"{quota}\n")
        (folder / "cpu.cfs_period_us").write_text("100000\n")
        own.write_text(f"4:memory:/\n3:{controllers}:/{path}\n2:name=systemd:/\n0::/\n")
        assert process._granted_cores(tmp_path / "groups", own) == granted, (folder, quota, path)


def test_memory_and_kills_are_those_of_all_control_groups_of_both_versions(tmp_path: Path) -> None:
    own, groups = tmp_path / "own", tmp_path / "groups"
    where = groups, own
    host = process.memory_limit(tmp_path / "none", own)
    assert host == os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    own.write_text("4:cpu,memory:/pod/container\n1:name=systemd:/\n0::/pod/container\n")
    for folder in ("pod/container", "memory/pod/container"):
        (groups / folder).mkdir(parents=True)
    assert process.out_of_memory_kills(*where, host=tmp_path / "none") == 0
    for file, text, limits, kills in (
        ("pod/memory.current", "2500", [], 0),
        ("pod/memory.max", "3000", [(3000, 500)], 0),
        ("pod/memory.max", "max", [], 0),
        ("pod/container/memory.current", "100", [], 0),
        ("pod/container/memory.max", "2000", [(2000, 1900)], 0),
        ("memory/pod/memory.usage_in_bytes", "400", [(2000, 1900)], 0),
        ("memory/pod/memory.limit_in_bytes", "9223372036854771712", [(2000, 1900)], 0),  # as version 1 says "none"
        ("memory/pod/memory.limit_in_bytes", "1500", [(1500, 1100), (2000, 1900)], 0),
        ("pod/container/memory.events", "low 0\noom 7\noom_kill 2\n", [(1500, 1100), (2000, 1900)], 2),
        ("memory/pod/memory.oom_control", "under_oom 0\noom_kill 3\n", [(1500, 1100), (2000, 1900)], 5),
    ):
        (groups / file).write_text(f"{text}\n")
        assert process.control_group_memory(*where) == limits, file
        assert process.memory_limit(*where) == min([host, *(limit for limit, _ in limits)]), file
        assert process.out_of_memory_kills(*where, host=tmp_path / "none") == kills, file
    (tmp_path / "vmstat").write_text("pgfault 9\noom_kill 10\n")
    assert process.out_of_memory_kills(*where, host=tmp_path / "vmstat") == 15


def test_a_limit_of_memory_only_ever_becomes_lower() -> None:
    said = _in_a_process(
        "import resource\n"
        "from v2v_server.system.process import limit_memory\n"
        "resource.setrlimit(resource.RLIMIT_DATA, (1 << 30, 1 << 30))\n"
        "limit_memory(2 << 30)\n"
        "print(resource.getrlimit(resource.RLIMIT_DATA)[0])\n"
        "limit_memory(1 << 29)\n"
        "print(resource.getrlimit(resource.RLIMIT_DATA)[0])\n"
        "try: bytearray(1 << 29)\n"
        "except MemoryError: print('refused')\n"
    )
    assert said == [str(1 << 30), str(1 << 29), "refused"]


def test_a_piece_of_work_that_takes_too_much_processor_time_ends_its_process() -> None:
    program = (
        "import resource, time\n"
        "from v2v_server.system.process import limit_processor_time\n"
        "so_far = time.process_time\n"
        "for spent in (7.2, 9.5):\n"
        "    time.process_time = lambda: spent\n"
        "    limit_processor_time(1.0)\n"
        "    print(resource.getrlimit(resource.RLIMIT_CPU)[0])\n"
        "time.process_time = so_far\n"
        "limit_processor_time(0.5)\n"
        "print('again', flush=True)\n"
        "while True: pass\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert (done.stdout, done.returncode) == ("9\n11\nagain\n", -signal.SIGXCPU)


def test_a_server_may_have_more_connections_than_the_thousand_of_a_service(monkeypatch: pytest.MonkeyPatch) -> None:
    said = _in_a_process(
        "import resource\n"
        "from v2v_server.system.process import open_many_files\n"
        "hard = min(resource.getrlimit(resource.RLIMIT_NOFILE)[1], 5000)\n"
        "resource.setrlimit(resource.RLIMIT_NOFILE, (64, hard))\n"
        "open_many_files()\n"
        "print(hard, *resource.getrlimit(resource.RLIMIT_NOFILE))\n"
    )
    assert len(said) == 3
    assert len(set(said)) == 1
    done: list[str] = []

    def load(config: ServeConfig) -> Catalogue:
        raise CorpusError("seen enough")

    monkeypatch.setattr("v2v_server.serve.keep_freed_memory", lambda: done.append("memory"))
    monkeypatch.setattr("v2v_server.serve.open_many_files", lambda: done.append("files"))
    monkeypatch.setattr("v2v_server.serve.load_catalogue", load)
    with pytest.raises(CorpusError):
        serve(ServeConfig(videos="videos", bind="tcp://127.0.0.1:*"))
    assert done == ["memory", "files"]


def test_long_turns_leave_niceness_and_policy_alone() -> None:
    said = _in_a_process(
        "import os\n"
        "from v2v_server.system.process import take_long_turns\n"
        "before = os.nice(5)\n"  # added to that of the test process
        "print(take_long_turns(), 0 < os.nice(0) == before, os.sched_getscheduler(0) == os.SCHED_OTHER)\n"
    )
    assert said[1:] == ["True", "True"]


@pytest.mark.skipif(platform.machine() != "x86_64", reason="the call's number is that of x86-64")
@pytest.mark.skipif(_kernel() < (6, 12), reason="the kernel grants long turns from 6.12 on")
def test_the_kernel_grants_the_long_turns() -> None:
    said = _in_a_process(
        "import ctypes, struct\n"
        "from v2v_server.system.process import take_long_turns\n"
        "def turn_ns():\n"
        "    attributes = ctypes.create_string_buffer(48)\n"
        "    assert ctypes.CDLL(None).syscall(315, 0, attributes, 48, 0) == 0\n"
        "    return struct.unpack('=IIQiIQQQ', attributes.raw)[5]\n"
        "before = turn_ns()\n"
        "print(take_long_turns(), before < 10**8, turn_ns())\n"
    )
    assert said == ["True", "True", "100000000"]


def test_a_thread_with_another_scheduling_class_keeps_it() -> None:
    said = _in_a_process(
        "import os\n"
        "from v2v_server.system.process import take_long_turns\n"
        "os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))\n"
        "print(take_long_turns(), os.sched_getscheduler(0) == os.SCHED_IDLE)\n"
    )
    assert said == ["False", "True"]


def test_a_machine_whose_calls_are_not_known_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(platform, "machine", lambda: "riscv64")
    assert not process.take_long_turns()


def test_what_cataloguing_frees_is_handed_back(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a million videos it would be a third of what a server then has."""
    told: list[str] = []
    monkeypatch.setattr("v2v_server.serve.open_catalogue", lambda *_, **__: told.append("catalogued"))
    monkeypatch.setattr("v2v_server.serve.give_back_freed_memory", lambda: told.append("handed back"))
    load_catalogue(ServeConfig(videos="videos"))
    assert told == ["catalogued", "handed back"]


# --- locks between processes ------------------------------------------------------------------------------------------


def test_one_holder_at_a_time(tmp_path: Path) -> None:
    path = tmp_path / "lock"
    with locked(path):
        with (
            pytest.raises(BlockingIOError, match="another process keeps it locked; end that process") as raised,
            locked(path),
        ):
            pass
        assert raised.value.filename == str(path)
    with locked(path):
        pass


def test_a_lock_that_is_released_in_time_is_waited_for(tmp_path: Path) -> None:
    def wait() -> None:
        with locked(tmp_path / "lock", 60.0):
            pass

    with locked(tmp_path / "lock"):
        waiter = threading.Thread(target=wait)
        waiter.start()
    waiter.join(60.0)
    assert not waiter.is_alive()


READER = """
import fcntl, os, sys
from pathlib import Path
from v2v_server.system.sandbox import confine

os.chdir(sys.argv[1])
if os.geteuid() == 0:  # which may open any file
    os.setgroups([])
    os.setgid(12345)
    os.setuid(12345)
confine([], network=False)
for path in sorted(Path(".").iterdir()):
    for flags in (os.O_RDONLY, os.O_WRONLY, os.O_RDWR):
        try:
            fcntl.flock(os.open(path, flags), fcntl.LOCK_EX | fcntl.LOCK_NB)
            print(path, end=" ")
        except (PermissionError, IsADirectoryError, BlockingIOError):
            pass
print(flush=True)
sys.stdin.read()
"""


@pytest.mark.skipif(not can_confine().files, reason="this kernel has no Landlock")
@pytest.mark.parametrize("is_earlier", [False, True], ids=["new", "of an earlier version"])
def test_a_process_that_may_only_read_blocks_no_writer(tmp_path: Path, is_earlier: bool) -> None:
    """A confined process of the same user locks every file that it can open, and each writer still gets its turn."""
    folder = tmp_path / "cache"
    file, entry = folder / "quarantine.jsonl", QuarantineEntry(0, "a.mp4", "", 0, "crash", "")
    quota = QuotaFolder(folder, 1 << 20, 0.0)
    quota.make()
    write_entry(file, entry, Quarantine())
    locks = [folder / "quarantine.lock", folder / "used.lock", folder / ".v2v-prepare.lock", folder / "key.lock"]
    for path in locks:
        with locked(path):
            pass
        assert path.stat().st_mode & 0o777 == 0o200
        if is_earlier:
            path.chmod(0o644)
            with locked(path):  # of this version, at its start
                pass
    if os.geteuid() == 0:
        for path in (folder, *folder.iterdir()):
            os.chown(path, 12345, 12345)
    command = [sys.executable, "-c", READER, str(folder)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as reader:
        assert reader.stdout is not None
        assert reader.stdout.readline().split() == ["partial", "quarantine.jsonl", "used"]
        for path in locks:
            with locked(path):
                pass
        with quota.locked():
            pass
        write_entry(file, entry, read_quarantine(file), 0.0)
