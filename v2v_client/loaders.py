"""Adapt the dataset to other loaders and training loops, or raise an error that says what to do instead.

``torch.utils.data.DataLoader`` sends batches in a daemon thread of each loader worker, which moves tensors into shared
memory. It does not wait for that thread when a trainer leaves an epoch early. A forked worker just ends. A spawned
worker finalizes its interpreter while the thread still runs, and C++ aborts with "terminate called without an active
exception": the trainer reads that its loader worker was killed by SIGABRT.

accelerate's ``prepare()`` wraps a loader. It splits each batch among processes, although each process already has its
own, and it sets the epoch from its own count, which restarts at 0 after a resume.

Lightning restores the position of objects that have ``state_dict`` and ``load_state_dict``. A plain DataLoader has
neither, so after a resume it would deliver epoch 0 again.
"""

from __future__ import annotations

import atexit
import functools
import os
import sys
import threading
import time
from types import FrameType

from v2v_protocol.errors import UsageError

_FEEDER = "QueueFeederThread"
"""Name of the thread in CPython's multiprocessing/queues.py."""

_PATIENCE = 4.0
"""Seconds to wait for the thread. A DataLoader kills workers that have not ended after 5 (torch.utils.data._utils)."""

_PARENT_SECONDS = 1.0
"""Interval at which a loader worker checks that its parent lives."""

_ACCELERATE = "accelerate."
_STATEFUL = "torchdata.stateful_dataloader."
_LIGHTNING = ("lightning.pytorch.loops.fit_loop", "pytorch_lightning.loops.fit_loop")
_LIGHTNING_EVALUATION = ("lightning.pytorch.loops.evaluation_loop", "pytorch_lightning.loops.evaluation_loop")


@functools.cache
def send_before_exit() -> None:
    """Delay this loader worker's exit until its batches are sent. Repeated calls do nothing."""
    atexit.register(_wait_for_feeders)


def _wait_for_feeders() -> None:
    for thread in threading.enumerate():
        if thread.name == _FEEDER:
            thread.join(_PATIENCE)


@functools.cache
def end_with_parent() -> None:
    """End this loader worker within seconds of its parent's death, even while it waits for a server."""
    threading.Thread(target=_wait_for_orphaned, args=(os.getppid(),), name="v2v-parent", daemon=True).start()


def _wait_for_orphaned(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(_PARENT_SECONDS)
    os._exit(1)  # without a parent, no process can receive its batches


def is_evaluated_by_lightning() -> bool:
    """Return whether Lightning's validation loop is the caller, which repeats the same samples on purpose."""
    frame: FrameType | None = sys._getframe(1)
    while frame is not None and _module(frame) not in _LIGHTNING_EVALUATION:
        frame = frame.f_back
    return frame is not None


def refuse_epoch_of_accelerate() -> None:
    """Check that the caller's caller, which sets an epoch, is not accelerate.

    Raises:
        UsageError: accelerate sets the epoch, as all of its loaders do before they iterate.
    """
    if _module(sys._getframe(2)).startswith(_ACCELERATE):
        raise UsageError(
            "this dataset's loader went through accelerate's prepare(), which splits batches among processes that "
            "already have their own, and counts epochs from 0 after a resume: leave the loader out of prepare(), and "
            "use batch.to(accelerator.device); ranks come from torch.distributed"
        )


def require_lightning_epoch(epoch: int) -> None:
    """Check that Lightning's trainer, if there is one, is not past ``epoch``.

    Call this right before the first batch of an epoch, also in a loader worker. An earlier call would fail, because
    Lightning creates an iterator to probe the dataset and loads the state afterwards.

    Raises:
        UsageError: Lightning's trainer is further on, so it would train on the same samples again.
    """
    frame: FrameType | None = sys._getframe(1)
    while frame is not None and _module(frame) not in _LIGHTNING:
        if _module(frame).startswith(_STATEFUL):  # Lightning counts a resumed epoch with no batches left as an epoch
            return
        frame = frame.f_back
    loop = None if frame is None else frame.f_locals.get("self")
    try:
        theirs, restarting = int(loop.trainer.current_epoch), bool(loop.restarting)  # type: ignore[union-attr]
        batches = int(loop.epoch_loop.batch_progress.current.ready) if restarting else 0  # type: ignore[union-attr]
    except AttributeError:  # no Lightning, or another release
        return
    if (theirs, batches) > (epoch, 0):
        raise UsageError(
            f"Lightning is at batch {batches} of epoch {theirs}, and this dataset would begin epoch {epoch}: Lightning "
            "does not save the position of a plain DataLoader. Give fit() the dataset itself, or torchdata's "
            "StatefulDataLoader(dataset, batch_size=None, ...); if it leaves epochs early (limit_train_batches), call "
            "dataset.set_epoch(self.current_epoch) in on_train_epoch_start as well"
        )


def _module(frame: FrameType) -> str:
    return str(frame.f_globals.get("__name__"))
