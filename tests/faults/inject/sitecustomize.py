"""Puts a fault into real server workers: on the PYTHONPATH of a server, this is run by every Python it starts.

``V2V_FAULT`` is JSON: {"stage": decode | simulate | send, "action": a signal's name, "exit", "memory", "hang" or
"disconnect", "video": only at this video (any when missing), "once": a file that is created by the one worker that does
it}.
Nothing in the product knows of this.
"""

import contextlib
import json
import os
import signal
import socket
import sys
import threading
from pathlib import Path


def _is_worker() -> bool:
    arguments = Path("/proc/self/cmdline").read_bytes().split(b"\0")
    return b"v2v_server.commands.worker" in arguments


def _act(fault: dict, video: str) -> None:
    if fault.get("video", video) != video:
        return
    if "once" in fault:
        try:
            os.close(os.open(fault["once"], os.O_CREAT | os.O_EXCL))
        except FileExistsError:
            return
    action = fault["action"]
    if action == "exit":
        os._exit(3)
    if action == "memory":
        raise MemoryError("injected")
    if action == "hang":
        threading.Event().wait()
    if action == "disconnect":
        _disconnect()
        return
    os.kill(os.getpid(), getattr(signal, action))


def _disconnect() -> None:
    """Cuts the connection to the server, whose address has a name; the process itself is unharmed."""
    for descriptor in map(int, os.listdir("/proc/self/fd")):
        with contextlib.suppress(OSError), socket.socket(fileno=os.dup(descriptor)) as link:
            if b"v2v-" in os.fsencode(link.getpeername()):
                link.shutdown(socket.SHUT_RDWR)


def _install(fault: dict) -> None:
    from v2v_server.store.recording import RecordedPixels
    from v2v_server.store.video_file import VideoFile
    from v2v_server.worker import process as worker
    from v2v_server.worker.making import make, read

    at = {"video": ""}
    decode_for, simulate_clip = read.decode_for, make.simulate_clip
    sample_message, confine = worker.sample_message, worker.confine
    folder = Path(fault.get("once", "/nowhere")).parent
    # A confined worker may write to no folder but its cache.
    worker.confine = lambda written, **more: confine(written and [*written, folder], **more)

    def decoding(clip, *rest):
        at["video"] = clip.video
        return decode_for(clip, *rest)

    def before(stage, function):
        def call(*arguments, **named):
            if fault["stage"] == stage:
                _act(fault, at["video"])
            return function(*arguments, **named)

        return call

    read.decode_for = decoding
    for pixels in (VideoFile, RecordedPixels):
        pixels.clips = before("decode", pixels.clips)
    make.simulate_clip = before("simulate", simulate_clip)
    worker.sample_message = before("send", sample_message)


if "V2V_FAULT" in os.environ and sys.platform.startswith("linux") and _is_worker():
    try:
        _install(json.loads(os.environ["V2V_FAULT"]))
    except (AttributeError, ImportError) as error:
        # Python goes on after any other error here, and the tests would prove nothing.
        raise SystemExit(f"the fault finds no place in the worker: {error}") from error
