"""Takes POSIX semaphores and shared memory away, as a host without ``/dev/shm`` does: on the PYTHONPATH of a process,
this is run by every Python it starts. ``multiprocessing``'s locks, queues and pools then fail as they do there."""

import _multiprocessing
import _posixshmem
import errno
import os


def _refuse(*arguments: object, **named: object) -> object:
    raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT))


class _SemLock(_multiprocessing.SemLock):
    __new__ = _refuse
    _rebuild = staticmethod(_refuse)


_multiprocessing.SemLock = _SemLock
_posixshmem.shm_open = _refuse
