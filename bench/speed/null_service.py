"""A server whose workers make nothing (:mod:`bench.speed.null_worker`), started and stopped like any other."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import av
import numpy as np
from av.video.frame import VideoFrame

from bench.usage import Roles
from v2v_client.local_server import LocalServer
from v2v_protocol.errors import ServerLost
from v2v_protocol.recipe import Recipe

_FRAMES_PER_SECOND = 30
_SEQUENCES_PER_VIDEO = 2


@dataclass(frozen=True, slots=True)
class NullService:
    """A running one.

    Attributes:
        server: the broker's process, without workers of its own.
        workers_pid: the process of all null workers.
    """

    server: LocalServer
    workers_pid: int

    @property
    def roles(self) -> Roles:
        """The null workers, the broker, and this process as the client."""
        return {"workers": [self.workers_pid], "broker": [self.server.pid], "client": [os.getpid()]}


@contextmanager
def null_service(
    recipe: Recipe, *, workers: int, sequences: int = 240, flags: Sequence[str] = (), samples: Path | None = None
) -> Iterator[NullService]:
    """A server over small videos, which are catalogued and never opened again, with null workers.

    Args:
        recipe: of the server.
        workers: null workers.
        sequences: least number in an epoch; an epoch's end costs a consumer a new session.
        flags: for ``v2v-serve``; they must give that recipe.
        samples: folder of what they send, ``NAME.npy`` of each array; None: ones.

    Raises:
        ServerLost, UsageError: the server, or the null workers, do not start.
    """
    with tempfile.TemporaryDirectory(prefix="v2v-null-") as folder:
        corpus, door = Path(folder, "corpus"), f"ipc://{folder}/workers"
        corpus.mkdir()
        # As long as usual clips: what a lease says of a video's frames is looked up in an index of all of them.
        frames = (_SEQUENCES_PER_VIDEO - 1) * recipe.frames_per_sequence + recipe.frames_needed
        first = corpus / "0.mp4"
        still_video(first, frames, recipe.crop_height_px, recipe.crop_width_px)
        for number in range(1, -(-sequences // _SEQUENCES_PER_VIDEO)):
            (corpus / f"{number}.mp4").hardlink_to(first)
        own = ["--worker-bind", door, "--cache-dir", folder]
        with LocalServer(corpus, workers=0, flags=[*flags, *own]) as server:
            command = [
                sys.executable,
                "-m",
                "bench.speed.null_worker",
                "--connect",
                door,
                "--workers",
                str(workers),
            ]
            command += ["--parent-pid", str(os.getpid()), *([] if samples is None else ["--samples", str(samples)])]
            process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True)
            try:
                # A consumer that came earlier would get the credit of a server without workers.
                if process.stdout is None or process.stdout.readline() != "joined\n":
                    raise ServerLost("the null workers ended before the server knew them")
                yield NullService(server, process.pid)
            finally:
                process.terminate()
                process.communicate()


def still_video(path: Path, frames: int, height_px: int, width_px: int) -> None:
    """A grey picture that never changes: a few bytes and some ten microseconds a frame. Odd sides are rounded up."""
    height, width = height_px + height_px % 2, width_px + width_px % 2
    picture = VideoFrame.from_ndarray(np.full((height * 3 // 2, width), 128, np.uint8), format="yuv420p")
    with av.open(str(path), "w") as output:
        stream = output.add_stream("mpeg4", rate=_FRAMES_PER_SECOND)
        stream.width, stream.height, stream.pix_fmt, stream.gop_size = width, height, "yuv420p", 600
        stream.thread_count = 1
        for number in range(frames):
            picture.pts = number
            output.mux(stream.encode(picture))
        output.mux(stream.encode(None))
