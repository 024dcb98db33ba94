"""Run the page's process from the server. Needs none of the packages that the page needs.

The server binds the port and passes it on. So a port in use is reported at the start, and requests wait while the
process is restarted. The process reads the status over ZeroMQ from the address for the server's own workers. That
address is private to this host and user (the kernel reports whose process connects). So the page needs no consumer key,
which a person would have to create, store and revoke.
"""

from __future__ import annotations

import errno
import os
import signal
import socket
import subprocess
import sys
from importlib.util import find_spec

from v2v_protocol.errors import UsageError
from v2v_protocol.programs import environment, name_extra

_PACKAGES = ("starlette", "uvicorn", "prometheus_client")
_FIRST_PAUSE_SECONDS, _LONGEST_PAUSE_SECONDS = 1.0, 60.0
_LONG_LIFE_SECONDS = 60.0
"""After running for this long, the delay before a restart starts small again."""
_STOP_SECONDS = 3.0


class PageProcess:
    """A listening port, and the process that answers there.

    Args:
        host, port: where to listen.
        names: host names to accept, separated by commas.
        log_format: of the page's log lines.
        is_insecure: serve every user, not only this process's own and root.

    Raises:
        UsageError: the port cannot be bound, or a package is missing.
    """

    def __init__(
        self, host: str, port: int, names: str = "", log_format: str = "text", *, is_insecure: bool = False
    ) -> None:
        missing = [name for name in _PACKAGES if find_spec(name) is None]
        if missing:
            raise UsageError(name_extra("--page", missing[0], "page"))
        self._socket = _listening(host, port)
        self._flags = ["--names", names, "--log-format", log_format, *["--insecure"] * is_insecure]
        self._address = ""
        self._process: subprocess.Popen[bytes] | None = None
        self._start_at = 0.0
        self._started_at = 0.0
        self._pause = _FIRST_PAUSE_SECONDS

    @property
    def url(self) -> str:
        """URL of the page."""
        host, port = self._socket.getsockname()[:2]
        return f"http://[{host}]:{port}/" if ":" in host else f"http://{host}:{port}/"

    @property
    def pid(self) -> int | None:
        """Process id; None while there is no process."""
        return None if self._process is None else self._process.pid

    def start(self, address: str) -> None:
        """Make :meth:`watch` keep a process running, which reads the status from the server at ``address``."""
        self._address = address

    def watch(self, now: float) -> list[str]:
        """Start the process if it is not running, and return lines that say how it ended. Call a few times a second."""
        if self._process is not None and (status := self._process.poll()) is not None:
            if now - self._started_at >= _LONG_LIFE_SECONDS:
                self._pause = _FIRST_PAUSE_SECONDS
            self._process, self._start_at = None, now + self._pause
            text = f"the page's process {_ended(status)}; samples are not affected; it is restarted in "
            said = [f"{text}{self._pause:g} s"]
            self._pause = min(2 * self._pause, _LONGEST_PAUSE_SECONDS)
            return said
        if self._process is None and self._address and now >= self._start_at:
            try:
                self._process, self._started_at = self._started(), now
            except OSError as error:
                self._start_at = now + _LONGEST_PAUSE_SECONDS
                return [f"the page's process could not be started: {error.strerror or error}"]
        return []

    def _started(self) -> subprocess.Popen[bytes]:
        descriptor = self._socket.fileno()
        return subprocess.Popen(
            [
                *(sys.executable, "-m", "v2v_server.page.app", "--connect", self._address, "--fd", str(descriptor)),
                *("--parent-pid", str(os.getpid()), *self._flags),
            ],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            pass_fds=(descriptor,),
            env=environment(),
            process_group=0,
        )

    def stop(self) -> None:
        """End the process and stop listening."""
        self._address = ""
        process, self._process = self._process, None
        if process is not None:
            process.terminate()
            try:
                process.wait(_STOP_SECONDS)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        self._socket.close()


def _listening(host: str, port: int) -> socket.socket:
    """Bind and return the socket.

    Raises:
        UsageError: it cannot be bound.
    """
    try:
        family, *_, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        return socket.create_server(address[:2], family=family, backlog=64)
    except OSError as error:
        is_port = error.errno in (errno.EADDRINUSE, errno.EACCES) and not isinstance(error, socket.gaierror)
        # Python adds its own text to the system's message.
        text = os.strerror(error.errno) if is_port and error.errno else error.strerror or str(error)
        remedy = "give another port with --page PORT" if is_port else "give an address of this host with --page-host"
        raise UsageError(f"--page {port} at {host}: {text}; {remedy}") from error


def _ended(status: int) -> str:
    if status >= 0:
        return f"ended with status {status}"
    number = -status
    return f"was ended by {signal.Signals(number).name if number in set(signal.Signals) else f'signal {number}'}"
