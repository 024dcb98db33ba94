"""Lets real server workers try what a flaw of a decoder could: on the PYTHONPATH of a server, every Python runs this.

``V2V_ATTEMPTS`` is JSON: {"report": a file, "home": a folder, "pid": a process of the same user}. When a worker has
decoded its first sample, it adds a line to the report: JSON of what each attempt gave, "done" or the error's name.
Nothing in the product knows of this.
"""

import errno
import json
import os
import socket
import threading
from contextlib import suppress
from pathlib import Path


def _tried(what) -> str:
    try:
        what()
    except OSError as error:
        return errno.errorcode[error.errno]
    return "done"


def _attempts(home: Path, pid: int) -> dict[str, str]:
    server = os.getppid()
    found = {
        "read": _tried((home / "notes").read_bytes),
        "write": _tried(lambda: (home / "notes").write_bytes(b"changed")),
        "create": _tried((home / "new").touch),
        "remove": _tried((home / "notes").unlink),
        "program": _tried(lambda: os.execv("/bin/true", ["true"])),
        "pair": _tried(lambda: socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)),
    }
    for family in ("AF_UNIX", "AF_INET", "AF_INET6", "AF_NETLINK"):
        kind = socket.SOCK_RAW if family == "AF_NETLINK" else socket.SOCK_STREAM
        found[family] = _tried(lambda family=family, kind=kind: socket.socket(getattr(socket, family), kind))
    for name, other in (("server", server), ("other", pid)):
        for mode in (os.O_RDONLY, os.O_RDWR):
            found[f"{name} memory {mode}"] = _tried(lambda other=other, mode=mode: os.open(f"/proc/{other}/mem", mode))
        for link in ("fd/0", "exe"):
            found[f"{name} {link}"] = _tried(lambda other=other, link=link: os.readlink(f"/proc/{other}/{link}"))
            found[f"{name} open {link}"] = _tried(
                lambda other=other, link=link: os.open(f"/proc/{other}/{link}", os.O_RDONLY)
            )
        if os.geteuid():  # root may, since Linux 6.16: CAP_PERFMON suffices for this
            found[f"{name} environ"] = _tried(Path(f"/proc/{other}/environ").read_bytes)
    return found


def _install(attempts: dict) -> None:
    from v2v_server.worker import process as worker

    # Opened before the worker confines itself, after which it could not.
    report = os.open(attempts["report"], os.O_WRONLY | os.O_APPEND)
    confine, sample_message, threads = worker.confine, worker.sample_message, []

    def confining(*arguments, **named):
        threads.append(len(os.listdir("/proc/self/task")))
        return confine(*arguments, **named)

    def message(*arguments, **named):
        if not hasattr(_install, "is_done"):
            _install.is_done = True
            found = _attempts(Path(attempts["home"]), attempts["pid"])
            inside = {}
            thread = threading.Thread(target=lambda: inside.update(_attempts(Path(attempts["home"]), attempts["pid"])))
            thread.start()
            thread.join()
            filters = set()
            for task in Path("/proc/self/task").iterdir():
                # A thread that was joined may still be listed, and gone a moment later.
                with suppress(FileNotFoundError, ProcessLookupError):
                    filters.add((task / "status").read_text().partition("Seccomp_filters:")[2].split()[0])
            found |= {"threads": threads[0], "filters": sorted(filters), "in a thread": inside == found}
            os.write(report, json.dumps(found).encode() + b"\n")
        return sample_message(*arguments, **named)

    worker.confine, worker.sample_message = confining, message


if "V2V_ATTEMPTS" in os.environ and b"v2v_server.commands.worker" in Path("/proc/self/cmdline").read_bytes():
    try:
        _install(json.loads(os.environ["V2V_ATTEMPTS"]))
    except (AttributeError, ImportError) as error:
        # Python goes on after any other error here, and the tests would prove nothing.
        raise SystemExit(f"the attempts find no place in the worker: {error}") from error
