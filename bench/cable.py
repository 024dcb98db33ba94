"""A second host on this machine: a network namespace, and a cable to it with a rate, a delay, losses and a switch.

The cable is a process in the far namespace that forwards packets between two TUN devices. The kernels' own TCP handles
the losses, as on a network; namespaces and /dev/net/tun suffice, without traffic-shaping modules.
"""

from __future__ import annotations

import argparse
import ctypes
import fcntl
import multiprocessing
import os
import random
import select
import struct
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

from v2v_protocol.errors import UsageError
from v2v_server.system.process import die_with_parent

NEAR, FAR = "10.77.0.1", "10.77.0.2"
_INSIDE = "V2V_BENCH_NETWORK"
_SPAWN = multiprocessing.get_context("spawn")
_NETWORK = 0x40000000  # CLONE_NEWNET
_SET_DEVICE, _PACKETS_ONLY = 0x400454CA, 0x1001  # TUNSETIFF; IFF_TUN | IFF_NO_PI
_LONGEST_QUEUE_SECONDS = 0.05
_AT_ONCE = 64


def in_own_network(work: Callable[[argparse.Namespace], int], command: Sequence[str], asked: argparse.Namespace) -> int:
    """Do the work of a bench if this process has its own network, else run its command line again in one.

    Args:
        work: of the bench, on its parsed flags ``asked``.
        command: name and flags of the bench.

    Raises:
        UsageError: this machine does not allow network namespaces.
    """
    if os.environ.get(_INSIDE):
        return work(asked)
    user = [] if os.geteuid() == 0 else ["--user", "--map-root-user"]
    unshare = ["unshare", *user, "--net"]
    try:
        subprocess.run([*unshare, "true"], check=True, capture_output=True, text=True)
    except (OSError, subprocess.CalledProcessError) as error:
        reason = str(getattr(error, "stderr", "") or error).strip()
        raise UsageError(f"no network namespace: {reason}; run the bench where unshare --net is allowed") from error
    with subprocess.Popen(
        [*unshare, sys.executable, "-m", "bench", *command], env=os.environ | {_INSIDE: "1"}
    ) as process:
        try:
            return process.wait()
        except BaseException:
            process.terminate()
            raise


class Cable:
    """A far host and the cable to it, inside ``with``, for a process in its own network (:func:`in_own_network`).

    Args:
        mbit: Mbit/s in each direction; the excess is queued for 50 ms, then dropped.
        delay_ms: of each direction.
        loss: share of packets that are lost.
        mtu: bytes of the largest packet.

    Attributes:
        pid: of the cable's process.
        far: prefix of a command that runs on the far host.

    Entering raises UsageError without a TUN device or without `ip`.
    """

    def __init__(self, mbit: float, delay_ms: float = 0.0, loss: float = 0.0, mtu: int = 1500) -> None:
        self._state = _State(*(_SPAWN.RawValue("q", 0) for _ in _State._fields))
        self._reason, theirs = _SPAWN.Pipe(duplex=False)
        forward = (mbit * 125e3, delay_ms * 1e-3, loss)
        self._process = _SPAWN.Process(target=_run, args=(os.getpid(), mtu, theirs, self._state, forward))

    def __enter__(self) -> Cable:
        self._process.start()
        self.pid = self._process.pid or 0
        self.far = ("nsenter", "--target", str(self.pid), "--net")
        if reason := self._reason.recv():
            raise UsageError(f"no second network: {reason}; a TUN device and `ip` are needed")
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.join()

    def set_cut(self, cut: bool) -> None:
        """Drop all packets from now on, or forward them again."""
        self._state.is_cut.value = int(cut)

    def count(self) -> tuple[int, int]:
        """Return the packets that passed, and those lost to chance or to a cut, so far."""
        return self._state.passed.value, self._state.lost.value

    @contextmanager
    def on_far_host(self) -> Iterator[None]:
        """Create sockets, threads and processes of this thread on the far host, inside ``with``."""
        own = os.open(f"/proc/self/task/{threading.get_native_id()}/ns/net", os.O_RDONLY)
        far = os.open(f"/proc/{self.pid}/ns/net", os.O_RDONLY)
        try:
            _system("setns", far, _NETWORK)
            yield
        finally:
            _system("setns", own, _NETWORK)
            os.close(own)
            os.close(far)

    def bytes_received(self) -> int:
        """Return the bytes that the far host has received, headers included."""
        return int(Path(f"/proc/{self.pid}/net/dev").read_text(encoding="ascii").partition("far:")[2].split()[0])


def _system(name: str, *arguments: int) -> None:
    """Call setns or unshare, which the os module has only from Python 3.12 on."""
    if getattr(ctypes.CDLL(None, use_errno=True), name)(*arguments):
        raise OSError(ctypes.get_errno(), f"{name}: {os.strerror(ctypes.get_errno())}")


@dataclass(slots=True)
class _Way:
    """One direction of the cable."""

    source: int
    sink: int
    queue: deque[tuple[float, bytes]] = field(default_factory=deque)
    free_at: float = 0.0

    def take(self, state: _State, bytes_per_second: float, delay_seconds: float, loss: float) -> None:
        """Queue the packets that have come."""
        for _ in range(_AT_ONCE):
            try:
                packet = os.read(self.source, 65536)
            except OSError:  # no more packets
                return
            now = time.monotonic()
            self.free_at = max(now, self.free_at)
            is_full = self.free_at - now > _LONGEST_QUEUE_SECONDS
            if state.is_cut.value or is_full or random.random() < loss:
                state.lost.value += not is_full
                continue
            self.free_at += len(packet) / bytes_per_second
            self.queue.append((self.free_at + delay_seconds, packet))

    def pass_on(self, state: _State) -> None:
        """Write the packets that are due."""
        now = time.monotonic()
        while self.queue and self.queue[0][0] <= now:
            with suppress(OSError):  # the device is full: the packet is lost
                os.write(self.sink, self.queue.popleft()[1])
                state.passed.value += 1


def _device(name: str, own: str, other: str, mtu: int) -> int:
    """Create a TUN device in this namespace and bring it up; return its file descriptor."""
    device = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
    fcntl.ioctl(device, _SET_DEVICE, struct.pack("16sH22x", name.encode(), _PACKETS_ONLY))
    for words in ("link set lo up", f"addr add {own} peer {other} dev {name}", f"link set {name} mtu {mtu} up"):
        subprocess.run(["ip", *words.split()], check=True)
    return device


class _State(NamedTuple):
    """Numbers that both processes share: whether the cable is cut, and packets."""

    is_cut: Any
    passed: Any
    lost: Any


def _forward(near: int, far: int, state: _State, forward: tuple[float, float, float]) -> NoReturn:
    """Forward packets until the process ends."""
    ways = (_Way(near, far), _Way(far, near))
    while True:
        due = min((way.queue[0][0] for way in ways if way.queue), default=None)
        wait = None if due is None else max(0.0, due - time.monotonic())
        ready, _, _ = select.select((near, far), [], [], wait)
        for way in ways:
            if way.source in ready:
                way.take(state, *forward)
            way.pass_on(state)


def _run(parent_pid: int, mtu: int, reason: Connection, state: _State, forward: tuple[float, float, float]) -> None:
    """Run the cable's process; send why it cannot, or an empty text."""
    die_with_parent(parent_pid)
    try:
        near = _device("near", NEAR, FAR, mtu)
        _system("unshare", _NETWORK)
        far = _device("far", FAR, NEAR, mtu)
    except (OSError, subprocess.CalledProcessError) as error:
        reason.send(str(error))
        return
    reason.send("")
    _forward(near, far, state, forward)
