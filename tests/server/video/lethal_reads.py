"""Readers that die over a file. The processes that call them import this module, so it imports little."""

from __future__ import annotations

import os
import signal
import stat

from v2v_server.corpus.probe import probe_file
from v2v_server.corpus.sources.source import VideoSource
from v2v_server.corpus.videos import IndexRow


def lethal(source: VideoSource, id: str) -> IndexRow:
    """Dies over files of that name, as over a bug of the decoder."""
    if "lethal" in id:
        os.kill(os.getpid(), signal.SIGSEGV)
    return probe_file(source, id)


def killed_once(source: VideoSource, id: str) -> IndexRow:
    """Is killed from outside over each file, the first time."""
    file = source.folder / id
    if not file.stat().st_mode & stat.S_ISVTX:  # such a process may write no file, but change a mode
        file.chmod(file.stat().st_mode | stat.S_ISVTX)
        os.kill(os.getpid(), signal.SIGKILL)
    return probe_file(source, id)


def always_killed(source: VideoSource, id: str) -> IndexRow:
    """Is killed from outside over every file."""
    os.kill(os.getpid(), signal.SIGKILL)
    return probe_file(source, id)


def waiting(source: VideoSource, id: str) -> IndexRow:
    """Waits for ever over files of that name, as over storage that does not answer."""
    if "waiting" in id:
        signal.pause()
    return probe_file(source, id)
