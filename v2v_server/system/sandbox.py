"""What a process that decodes strangers' videos gives up, for good: the kernel holds it to that (Linux).

A file that finds a flaw in the decoder can then read what its user can read, and use memory and time, but

    starts no program, looks into no other process, asks for no other rights       seccomp
    opens no connection to a network, where it needs none                          seccomp
    writes, makes and removes no file but below the given folders                  Landlock

Both are the kernel's own, need no rights, and are inherited by whatever the process starts. Calls that are refused fail
with EPERM or EACCES; nothing is killed for them.
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
_ALLOW, _REFUSE = 0x7FFF0000, 0x00050000 | errno.EPERM
_LOAD, _EQUAL, _AT_LEAST, _RETURN = 0x20, 0x15, 0x35, 0x06
_OTHER_ABI = 0x40000000
"""From this number on: calls of x86_64's 32-bit variant, under which every call is there again."""
_UNIX = 1

_LANDLOCK = (444, 445, 446)  # create, add a rule, restrict; the same on all machines
_PATH_BENEATH = 1
_EXECUTE, _READ_FILE, _READ_FOLDER = 1 << 0, 1 << 2, 1 << 3
_LEAST_VERSION = 2  # the first keeps everyone from moving files from one folder to another
_KNOWN_TO = {2: 14, 3: 15, 4: 15}  # version of Landlock -> how many rights over files it knows; later ones 16
_FILE_RIGHTS = 1 << 0 | 1 << 1 | 1 << 2 | 1 << 14 | 1 << 15
"""Rights that a rule may give over something that is no folder: execute, write, read, truncate, control a device."""


_REFUSED = {
    "execve": (59, 221), "execveat": (322, 281), "ptrace": (101, 117), "process_vm_readv": (310, 270),
    "process_vm_writev": (311, 271), "pidfd_getfd": (438, 438), "io_uring_setup": (425, 425), "bpf": (321, 280),
    "perf_event_open": (298, 241), "userfaultfd": (323, 282), "keyctl": (250, 219), "add_key": (248, 217),
    "request_key": (249, 218), "mount": (165, 40), "unshare": (272, 97), "setns": (308, 268),
}  # fmt: skip
"""Calls that are refused, by their numbers on x86_64 and aarch64. io_uring could do the others' work unseen."""


@dataclass(frozen=True, slots=True)
class _Machine:
    architecture: int  # as the kernel tells a filter
    seccomp: int
    socket: int
    refused: tuple[int, ...]


_MACHINES = {
    "x86_64": _Machine(0xC000003E, 317, 41, tuple(number for number, _ in _REFUSED.values())),
    "aarch64": _Machine(0xC00000B7, 277, 198, tuple(number for _, number in _REFUSED.values())),
}


@dataclass(frozen=True, slots=True)
class Confined:
    """What holds a process from now on.

    Attributes:
        calls: no program, no other process, and no network where that was asked.
        files: no writing but below the given folders.
    """

    calls: bool
    files: bool


def can_confine() -> Confined:
    """What :func:`confine` could do here."""
    machine = _MACHINES.get(platform.machine())
    if not sys.platform.startswith("linux") or machine is None:
        return Confined(calls=False, files=False)
    kernel = ctypes.CDLL(None, use_errno=True)
    has_calls = _call(kernel, machine.seccomp, _SECCOMP_GET_ACTION_AVAIL, 0, struct.pack("=I", _REFUSE & 0xFFFF0000))
    return Confined(has_calls == 0, _call(kernel, _LANDLOCK[0], None, 0, 1) >= _LEAST_VERSION)


def confine(writable: Iterable[Path] | None, *, network: bool) -> Confined:
    """Confine this process, all of its threads as to calls, and what it starts from now on. There is no way back.

    Args:
        writable: folders in which it may write; None leaves that as it is. Landlock holds the calling thread, and those
            that it starts from now on. It also keeps a process from opening files in others by ``/proc/PID/fd``, which
            is how a sample gets into its consumer's memory.
        network: whether it may open connections other than to sockets of this host's file system.

    Returns:
        what the system has; where it has nothing of the kind, nothing was changed.
    """
    machine = _MACHINES.get(platform.machine())
    if not sys.platform.startswith("linux") or machine is None:
        return Confined(calls=False, files=False)
    kernel = ctypes.CDLL(None, use_errno=True)
    if kernel.prctl(_PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0) != 0:
        return Confined(calls=False, files=False)
    has_files = writable is not None and _allow_writing(kernel, writable)  # first: seccomp might not allow it
    code = program(machine, network=network)
    buffer = ctypes.create_string_buffer(code, len(code))
    filter_ = struct.pack("@HP", len(code) // 8, ctypes.addressof(buffer))
    flags = _ALL_THREADS | _NO_SLOWDOWN
    has_calls = _call(kernel, machine.seccomp, _SECCOMP_SET_MODE_FILTER, flags, filter_) == 0
    return Confined(has_calls, has_files)


def program(machine: _Machine, *, network: bool) -> bytes:
    """The filter over system calls: for each of them allow, or refuse with EPERM."""
    refuse = _instruction(_RETURN, _REFUSE)
    code = [_instruction(_LOAD, 4), _instruction(_EQUAL, machine.architecture, then=1), refuse, _instruction(_LOAD, 0)]
    code += [_instruction(_AT_LEAST, _OTHER_ABI, otherwise=1), refuse]
    for number in machine.refused:
        code += [_instruction(_EQUAL, number, otherwise=1), refuse]
    if not network:
        code += [_instruction(_EQUAL, machine.socket, otherwise=3), _instruction(_LOAD, 16)]
        code += [_instruction(_EQUAL, _UNIX, then=1), refuse]
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
                continue  # what is not there cannot be written to
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
    """A system call, which returns -1 where it fails."""
    given = (ctypes.c_long(each) if isinstance(each, int) else each for each in arguments)
    return int(kernel.syscall(ctypes.c_long(number), *given))


def _instruction(code: int, value: int, then: int = 0, otherwise: int = 0) -> bytes:
    return struct.pack("=HBBI", code, then, otherwise, value)
