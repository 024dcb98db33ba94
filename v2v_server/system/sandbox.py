"""Restrict a process that decodes untrusted videos, permanently: the kernel enforces it (Linux).

A file that exploits a flaw in the decoder can then read what its user can read, and use memory and time. But it

    starts no process and no program, traces no other process, gains no other rights              seccomp
    types nothing into a terminal, changes neither limits nor priority of other processes         seccomp
    makes no socket, unless the process needs a network                                           seccomp
    writes, creates and removes no file except below the given folders                            Landlock

Both are part of the kernel, and need no rights. Refused calls fail with EPERM or EACCES; no process is killed for them.
"""

from __future__ import annotations

import ctypes
import errno
import os
import platform
import struct
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

_PR_SET_NO_NEW_PRIVS = 38
_SECCOMP_SET_MODE_FILTER, _SECCOMP_GET_ACTION_AVAIL = 1, 2
_ALL_THREADS, _NO_SLOWDOWN = 1, 4  # flags; the second: without the mitigation that made old kernels' filters expensive
_ALLOW, _SKIP, _REFUSE, _MISSING = 0x7FFF0000, 0x00050000, 0x00050000 | errno.EPERM, 0x00050000 | errno.ENOSYS
_LOAD, _EQUAL, _AT_LEAST, _ANY_BIT, _RETURN = 0x20, 0x15, 0x35, 0x45, 0x06
_OTHER_ABI = 0x40000000
"""Calls from this number on belong to x86_64's 32-bit variant, which repeats every call."""

_LANDLOCK = (444, 445, 446)  # create, add a rule, restrict; the same on all machines
_PATH_BENEATH = 1
_EXECUTE, _READ_FILE, _READ_FOLDER = 1 << 0, 1 << 2, 1 << 3
_LEAST_VERSION = 2  # version 1 forbids moving files between folders
_KNOWN_TO = {2: 14, 3: 15, 4: 15}  # version of Landlock -> how many rights over files it knows; later ones 16
_FILE_RIGHTS = 1 << 0 | 1 << 1 | 1 << 2 | 1 << 14 | 1 << 15
"""Rights that a rule may give over a file: execute, write, read, truncate, control a device."""


_REFUSED = {
    "execve": (59, 221), "execveat": (322, 281), "fork": (57, 221), "vfork": (58, 221), "ptrace": (101, 117),
    "process_vm_readv": (310, 270), "process_vm_writev": (311, 271), "process_madvise": (440, 440),
    "pidfd_getfd": (438, 438), "kcmp": (312, 272), "io_uring_setup": (425, 425), "bpf": (321, 280),
    "perf_event_open": (298, 241), "userfaultfd": (323, 282), "keyctl": (250, 219), "add_key": (248, 217),
    "request_key": (249, 218), "unshare": (272, 97), "setns": (308, 268), "chroot": (161, 51), "pivot_root": (155, 41),
    "mount": (165, 40), "umount2": (166, 39), "open_tree": (428, 428), "move_mount": (429, 429), "fsopen": (430, 430),
    "fsconfig": (431, 431), "fsmount": (432, 432), "fspick": (433, 433), "mount_setattr": (442, 442),
    "open_tree_attr": (467, 467), "open_by_handle_at": (304, 265), "setpriority": (141, 140), "ioprio_set": (251, 30),
}  # fmt: skip
"""Refused calls, by their numbers on x86_64 and aarch64, which has no fork. io_uring could perform the others without
the filter.
"""

_REFUSED_IF = (
    ((16, 29), 1, _EQUAL, 0x5412, True, _REFUSE),  # ioctl TIOCSTI, which types into a terminal
    ((16, 29), 1, _EQUAL, 0x541C, True, _REFUSE),  # ioctl TIOCLINUX, which pastes into a console
    ((56, 220), 0, _ANY_BIT, 0x7E020000, True, _REFUSE),  # clone into any new namespace
    ((56, 220), 0, _ANY_BIT, 0x00010000, False, _REFUSE),  # clone without CLONE_THREAD: a process
    # prlimit64, sched_setaffinity, sched_setattr: 0 is the caller itself
    *((numbers, 0, _AT_LEAST, 1, True, _REFUSE) for numbers in ((302, 261), (203, 122), (314, 274))),
    # sched_setscheduler, sched_setparam: skipped, as ZeroMQ calls them for its own threads and insists on success
    *((numbers, 0, _AT_LEAST, 1, True, _SKIP) for numbers in ((144, 119), (142, 118))),
)
"""Calls that are refused for an argument: their numbers, which argument, how its lower half is compared with which
value, the outcome at which the call is refused, and the answer. The kernel reads no more than this half of them.
"""


@dataclass(frozen=True, slots=True)
class _Machine:
    architecture: int  # as the kernel reports it to a filter
    seccomp: int
    sockets: tuple[int, ...]  # socket and socketpair
    column: int  # of the tables above


_MACHINES = {"x86_64": _Machine(0xC000003E, 317, (41, 53), 0), "aarch64": _Machine(0xC00000B7, 277, (198, 199), 1)}


@dataclass(frozen=True, slots=True)
class Confined:
    """Restrictions in force.

    Attributes:
        calls: whether programs, other processes, and (if requested) networks are blocked.
        files: whether writing outside the given folders is blocked.
    """

    calls: bool
    files: bool


def can_confine() -> Confined:
    """Return which restrictions :func:`confine` could apply here."""
    machine = _MACHINES.get(platform.machine())
    if not sys.platform.startswith("linux") or machine is None:
        return Confined(calls=False, files=False)
    kernel = ctypes.CDLL(None, use_errno=True)
    has_calls = _call(kernel, machine.seccomp, _SECCOMP_GET_ACTION_AVAIL, 0, struct.pack("=I", _REFUSE & 0xFFFF0000))
    return Confined(has_calls == 0, _call(kernel, _LANDLOCK[0], None, 0, 1) >= _LEAST_VERSION)


def confine(writable: Iterable[Path] | None, *, network: bool) -> Confined:
    """Confine this process and its future children; system calls in all of its threads. This cannot be undone.

    Args:
        writable: folders in which it may write; None does not restrict writing. Landlock holds for the calling thread,
            and threads that it starts from now on. It also closes memory and open files of other processes
            (``/proc/PID/mem``, ``/proc/PID/fd``).
        network: whether it may make sockets. Those that it has stay open.

    Returns:
        the restrictions that the system supports; the others were not applied.
    """
    machine = _MACHINES.get(platform.machine())
    if not sys.platform.startswith("linux") or machine is None:
        return Confined(calls=False, files=False)
    kernel = ctypes.CDLL(None, use_errno=True)
    if kernel.prctl(_PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0) != 0:
        return Confined(calls=False, files=False)
    has_files = writable is not None and _allow_writing(kernel, writable)  # before seccomp, whose filter might block it
    code = program(machine, network=network)
    buffer = ctypes.create_string_buffer(code, len(code))
    filter_ = struct.pack("@HP", len(code) // 8, ctypes.addressof(buffer))
    flags = _ALL_THREADS | _NO_SLOWDOWN
    has_calls = _call(kernel, machine.seccomp, _SECCOMP_SET_MODE_FILTER, flags, filter_) == 0
    return Confined(has_calls, has_files)


def program(machine: _Machine, *, network: bool) -> bytes:
    """Build the filter over system calls, which allows each call or refuses it."""
    refuse, load = _instruction(_RETURN, _REFUSE), _instruction(_LOAD, 0)
    code = [
        *(_instruction(_LOAD, 4), _instruction(_EQUAL, machine.architecture, then=1), refuse, load),
        *(_instruction(_AT_LEAST, _OTHER_ABI, otherwise=1), refuse),
        # clone3, whose flags a filter does not see; without it, threads are made with clone
        *(_instruction(_EQUAL, 435, otherwise=1), _instruction(_RETURN, _MISSING)),
    ]
    for number in (*(each[machine.column] for each in _REFUSED.values()), *(() if network else machine.sockets)):
        code += [_instruction(_EQUAL, number, otherwise=1), refuse]
    for calls, argument, comparison, value, at, answer in _REFUSED_IF:
        # A filter sees arguments from byte 16 on, 8 bytes each, the lower half first.
        code += [_instruction(_EQUAL, calls[machine.column], otherwise=4), _instruction(_LOAD, 16 + 8 * argument)]
        code += [_instruction(comparison, value, then=not at, otherwise=at), _instruction(_RETURN, answer), load]
    return b"".join([*code, _instruction(_RETURN, _ALLOW)])


def _allow_writing(kernel: ctypes.CDLL, folders: Iterable[Path]) -> bool:
    version = _call(kernel, _LANDLOCK[0], None, 0, 1)
    if version < _LEAST_VERSION:
        return False
    every = (1 << _KNOWN_TO.get(version, 16)) - 1
    handled = every & ~(_READ_FILE | _READ_FOLDER | _EXECUTE)
    rules = _call(kernel, _LANDLOCK[0], struct.pack("=Q", handled), 8, 0)
    if rules < 0:
        return False
    try:
        for folder in (*folders, Path(os.devnull)):
            try:
                beneath = os.open(folder, os.O_PATH | os.O_CLOEXEC)
            except OSError:
                continue  # a missing folder cannot be written to
            try:
                rights = handled if folder.is_dir() else handled & _FILE_RIGHTS
                if _call(kernel, _LANDLOCK[1], rules, _PATH_BENEATH, struct.pack("=Qi", rights, beneath), 0) != 0:
                    return False
            finally:
                os.close(beneath)
        return _call(kernel, _LANDLOCK[2], rules, 0) == 0
    finally:
        os.close(rules)


def _call(kernel: ctypes.CDLL, number: int, *arguments: int | bytes | None) -> int:
    """Make a system call; return -1 if it fails."""
    given = (ctypes.c_long(each) if isinstance(each, int) else each for each in arguments)
    return int(kernel.syscall(ctypes.c_long(number), *given))


def _instruction(code: int, value: int, then: int = 0, otherwise: int = 0) -> bytes:
    return struct.pack("=HBBI", code, then, otherwise, value)
