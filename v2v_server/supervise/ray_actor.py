"""The actor of a worker on a Ray cluster: starts the worker's process on its node, looks at it, and says how it ended.

A decoder that crashes ends the process, never the actor.
"""

from __future__ import annotations

import contextlib
import socket
import subprocess
import threading
from collections.abc import Sequence
from dataclasses import dataclass

import ray

from v2v_protocol.keys import PeerKey
from v2v_server.broker.blame import Loss
from v2v_server.supervise.child import out_of_memory_kills, post_mortem, queued_seconds, start_child, status_of
from v2v_server.worker.logbook import Logbook


@dataclass(frozen=True, slots=True)
class Sight:
    """What an actor sees.

    Attributes:
        node: where it is.
        name: of its worker; empty where none runs.
        status: of the worker's process, in psutil's words.
        queued_seconds: how long that process has waited for a core since it began.
        lease: that the worker is at, 0 for none; None when it never said.
        decodes: whether it decodes a video.
    """

    node: str
    name: str = ""
    status: str = ""
    queued_seconds: float = 0.0
    lease: int | None = None
    decodes: bool = False


class RayWorker:
    """The actor.

    Args:
        root: the corpus, a folder of its node or an address.
        flags: more of them for the worker.
        key: of the worker; None: what ``V2V_KEYS`` names on its node.
    """

    def __init__(self, root: str, flags: Sequence[str], key: PeerKey | None = None) -> None:
        self._key = key
        self._root, self._flags = root, list(flags)
        self._lock = threading.Lock()
        self._child: tuple[str, subprocess.Popen[bytes], Logbook] | None = None
        self._memory_kills = out_of_memory_kills()

    def run(self, name: str, address: str) -> tuple[int, Loss]:
        """One worker, from its start to its end.

        Returns:
            its exit status, and what that means.

        Raises:
            OSError: it cannot be started.
        """
        with self._lock:
            if self._child is not None:
                self._child[1].kill()  # the call that it was started by was lost on the way back
            logbook = Logbook()
            with contextlib.ExitStack() as undo:
                undo.callback(logbook.close)
                process = start_child(address, self._root, name, self._flags, logbook, self._key)
                undo.pop_all()
            self._child = name, process, logbook
        returncode = process.wait()
        with self._lock:
            short = out_of_memory_kills() > self._memory_kills
            said = post_mortem(returncode, short_of_memory=short)
            loss = Loss(said.cause, f"{said.text} on {node()}", logbook.lease())
            logbook.close()
            if self._child is not None and self._child[1] is process:
                self._child = None
        return returncode, loss

    def look(self) -> Sight:
        """What it is at."""
        with self._lock:
            self._memory_kills = out_of_memory_kills()
            if self._child is None:
                return Sight(node())
            name, process, logbook = self._child
            waited = queued_seconds(process.pid)
            return Sight(node(), name, status_of(process.pid), waited, logbook.lease(), logbook.decodes())

    def signal(self, name: str, number: int) -> None:
        """Sends the worker of that name a signal, if it still runs."""
        with self._lock:
            if self._child is not None and self._child[0] == name:
                self._child[1].send_signal(number)


def node() -> str:
    """This node, as logs name it."""
    context = ray.get_runtime_context()
    return f"{socket.gethostname()} ({context.get_node_id()[:6]})"
