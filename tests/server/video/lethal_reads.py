"""Readers that die over a file. The processes that call them import this module, so it imports little."""

from __future__ import annotations

import os
import signal
import stat

from v2v_server.corpus.probe import ProbeJob, probe_file
from v2v_server.corpus.sources.source import VideoSource
from v2v_server.corpus.videos import IndexRow


def lethal(source: VideoSource, job: ProbeJob) -> IndexRow:
    """Dies over files of that name, as over a bug of the decoder."""
    if "lethal" in job[0]:
        os.kill(os.getpid(), signal.SIGSEGV)
    return probe_file(source, job)


def killed_once(source: VideoSource, job: ProbeJob) -> IndexRow:
    """Is killed from outside over each file, the first time."""
    file = source.folder / job[0]
    if not file.stat().st_mode & stat.S_ISVTX:  # such a process may write no file, but change a mode
        file.chmod(file.stat().st_mode | stat.S_ISVTX)
        os.kill(os.getpid(), signal.SIGKILL)
    return probe_file(source, job)


def always_killed(source: VideoSource, job: ProbeJob) -> IndexRow:
    """Is killed from outside over every file."""
    os.kill(os.getpid(), signal.SIGKILL)
    return probe_file(source, job)


def waiting(source: VideoSource, job: ProbeJob) -> IndexRow:
    """Waits for ever over files of that name, as over storage that does not answer."""
    if "waiting" in job[0]:
        signal.pause()
    return probe_file(source, job)
