"""What loaders and loops of others do with the dataset, where that needs something done, or an error that says what to
do instead.

``torch.utils.data.DataLoader`` passes batches on in a daemon thread of each loader worker, which moves tensors into
shared memory there, and does not wait for it when a trainer leaves an epoch early. A worker that was forked ends
without further ado. One that was spawned takes its interpreter down around that thread, and C++ answers with "terminate
called without an active exception": the trainer reads that its loader worker was killed by SIGABRT.

accelerate's ``prepare()`` wraps a loader: it cuts each batch up among processes, which have their own already, and it
sets the epoch by a count of its own, from 0 again after a resume.

Lightning restores the position of whatever has ``state_dict`` and ``load_state_dict``, which a plain DataLoader has
not: after a resume it would deliver epoch 0 again.
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
"""The name that CPython's multiprocessing/queues.py gives to the thread."""

_PATIENCE = 4.0
"""Seconds; a DataLoader kills workers that have not ended after five (torch.utils.data._utils)."""

_PARENT_SECONDS = 1.0
"""How often a loader worker checks that its parent lives."""

_ACCELERATE = "accelerate."
_STATEFUL = "torchdata.stateful_dataloader."
_LIGHTNING = ("lightning.pytorch.loops.fit_loop", "pytorch_lightning.loops.fit_loop")
_LIGHTNING_EVALUATION = ("lightning.pytorch.loops.evaluation_loop", "pytorch_lightning.loops.evaluation_loop")


@functools.cache
def send_before_exit() -> None:
    """To be called in a loader worker, as often as one likes: it ends only once its batches are on their way."""
    atexit.register(_wait_for_feeders)


def _wait_for_feeders() -> None:
    for thread in threading.enumerate():
        if thread.name == _FEEDER:
            thread.join(_PATIENCE)


@functools.cache
def end_with_parent() -> None:
    """End this loader worker within seconds of its parent's death, also while it waits for a server."""
    threading.Thread(target=_wait_for_orphaned, args=(os.getppid(),), name="v2v-parent", daemon=True).start()


def _wait_for_orphaned(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(_PARENT_SECONDS)
    os._exit(1)  # nothing can receive its batches any more


def is_evaluated_by_lightning() -> bool:
    """Return whether a validation loop of Lightning iterates, which takes the same samples on purpose."""
    frame: FrameType | None = sys._getframe(1)
    while frame is not None and _module(frame) not in _LIGHTNING_EVALUATION:
        frame = frame.f_back
    return frame is not None


def refuse_epoch_of_accelerate() -> None:
    """To be called where an epoch is set.

    Raises:
        UsageError: it is accelerate that sets it, as all of its loaders do before they iterate.
    """
    if _module(sys._getframe(2)).startswith(_ACCELERATE):
        raise UsageError(
            "this dataset's loader went through accelerate's prepare(), which cuts batches up among processes that "
            "have their own already, and counts epochs from 0 after a resume: leave the loader out of prepare(), and "
            "take batch.to(accelerator.device); ranks come from torch.distributed"
        )


def require_lightning_epoch(epoch: int) -> None:
    """To be called before the first batch of an epoch, in a loader worker too; not before, because Lightning makes an
    iterator to see whether it can, and loads the state after that.

    Raises:
        UsageError: Lightning's trainer is further on, so that it would train on the same samples again.
    """
    frame: FrameType | None = sys._getframe(1)
    while frame is not None and _module(frame) not in _LIGHTNING:
        if _module(frame).startswith(_STATEFUL):  # Lightning counts an epoch of which nothing was left as one
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
            "keeps no position of a plain DataLoader. Give fit() the dataset itself, or torchdata's "
            "StatefulDataLoader(dataset, batch_size=None, ...); if it leaves epochs early (limit_train_batches), call "
            "dataset.set_epoch(self.current_epoch) in on_train_epoch_start as well"
        )


def _module(frame: FrameType) -> str:
    return str(frame.f_globals.get("__name__"))
