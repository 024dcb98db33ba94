"""The actor of a worker on a Ray cluster: it starts the worker's process on its node, observes it, and reports its end.

A decoder that crashes ends the process, never the actor.
"""

from __future__ import annotations

import contextlib
import socket
import subprocess
import threading
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import ray

from v2v_protocol.keys import PeerKey
from v2v_server.broker.blame import Loss
from v2v_server.supervise.child import out_of_memory_kills, post_mortem, queued_seconds, start_child, status_of
from v2v_server.supervise.host import ProcessStatus
from v2v_server.worker.logbook import Logbook


@dataclass(frozen=True, slots=True)
class ActorStatus:
    """What an actor observes.

    Attributes:
        node: its node.
        name: name of its worker; empty if none runs.
        process: the worker's process.
    """

    node: str
    name: str = ""
    process: ProcessStatus = field(default_factory=ProcessStatus)


class RayWorker:
    """The actor.

    Args:
        root: the corpus, a folder of its node or an address.
        flags: further flags of the worker.
        key: key of the worker; None: the key that ``V2V_KEYS`` names on its node.
    """

    def __init__(self, root: str, flags: Sequence[str], key: PeerKey | None = None) -> None:
        self._key = key
        self._root, self._flags = root, list(flags)
        self._lock = threading.Lock()
        self._child: tuple[str, subprocess.Popen[bytes], Logbook] | None = None
        self._memory_kills = out_of_memory_kills()

    def run(self, name: str, address: str) -> tuple[int, Loss]:
        """Run one worker from its start to its end.

        Returns:
            its exit status, and what that means.

        Raises:
            OSError: it cannot be started.
        """
        with self._lock:
            if self._child is not None:
                self._child[1].kill()  # the result of the call that started it was lost on its way
            logbook = Logbook()
            with contextlib.ExitStack() as undo:
                undo.callback(logbook.close)
                process = start_child(address, self._root, name, self._flags, logbook, self._key)
                undo.pop_all()
            self._child = name, process, logbook
        returncode = process.wait()
        with self._lock:
            short = out_of_memory_kills() > self._memory_kills
            loss = post_mortem(returncode, logbook, short_of_memory=short)
            loss = replace(loss, text=f"{loss.text} on {node()}")
            logbook.close()
            if self._child is not None and self._child[1] is process:
                self._child = None
        return returncode, loss

    def status(self) -> ActorStatus:
        """Observe the worker's process."""
        with self._lock:
            self._memory_kills = out_of_memory_kills()
            if self._child is None:
                return ActorStatus(node())
            name, process, logbook = self._child
            seen = ProcessStatus(
                status_of(process.pid), queued_seconds(process.pid), logbook.lease(), logbook.decodes()
            )
            return ActorStatus(node(), name, seen)

    def signal(self, name: str, number: int) -> None:
        """Send a worker a signal, if it still runs."""
        with self._lock:
            if self._child is not None and self._child[0] == name:
                self._child[1].send_signal(number)


def node() -> str:
    """Return the name of this node for logs."""
    context = ray.get_runtime_context()
    return f"{socket.gethostname()} ({context.get_node_id()[:6]})"
