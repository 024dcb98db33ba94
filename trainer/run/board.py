"""Write scalars and pictures of a run for TensorBoard in the calling thread.

PyTorch's ``SummaryWriter`` writes in a thread of its own. That thread prints a trace when the disk is full, and the
caller learns of the error at a later call.
"""

from __future__ import annotations

import os
import socket
import time
from pathlib import Path
from typing import Any

from tensorboard.compat.proto.event_pb2 import Event, SessionLog
from tensorboard.summary.writer.record_writer import RecordWriter
from torch.utils.tensorboard import summary

from trainer.pictures import Image


class Board:
    """Write an event file in ``folder``, which is created if it is missing.

    Args:
        first_step: TensorBoard drops what earlier files hold for this step and later ones.

    Raises:
        OSError: the file cannot be written; every method raises it too.
    """

    def __init__(self, folder: Path, first_step: int) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        name = f"events.out.tfevents.{time.time():020.9f}.{socket.gethostname()}.{os.getpid()}"
        self._file = (folder / name).open("xb")
        self._records = RecordWriter(self._file)
        self._add(file_version="brain.Event:2")
        self._add(step=first_step, session_log=SessionLog(status=SessionLog.START))

    def scalar(self, name: str, value: float, step: int) -> None:
        """Add one value of a curve."""
        self._add(step=step, summary=summary.scalar(name, value))  # type: ignore[no-untyped-call]

    def picture(self, name: str, picture: Image, step: int) -> None:
        """Add a picture, [height, width, 3] RGB."""
        image = summary.image(name, picture, dataformats="HWC")  # type: ignore[no-untyped-call]
        self._add(step=step, summary=image)

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _add(self, **content: Any) -> None:
        self._records.write(Event(wall_time=time.time(), **content).SerializeToString())
        self._records.flush()
