"""The training loop: one page, read from top to bottom."""

from __future__ import annotations

import math
from itertools import islice
from pathlib import Path

import torch
from torch.nn.utils import clip_grad_norm_

from trainer.config import TrainConfig
from trainer.feed import Feed, preview_batch, stream
from trainer.learner import Learner
from trainer.run.checkpoint import Checkpoint, save_checkpoint
from trainer.run.distributed import Ranks
from trainer.run.interruption import StopRequest
from trainer.run.preview import films
from trainer.run.reporting import Meter, Reporter
from trainer.run.resume import LAST
from v2v_protocol.errors import UsageError, V2VError


class Diverged(V2VError):
    """A loss or a gradient is infinite or not a number; nothing is saved from then on."""


def train(
    config: TrainConfig,
    learner: Learner,
    address: str,
    ranks: Ranks,
    stop: StopRequest,
    out: Path,
    resume: Checkpoint | None = None,
) -> int:
    """Train to the configured end, or until ``stop``; either way ``out/last.pt`` is where a later run goes on.

    Returns:
        optimiser steps so far, those before ``resume`` included.

    Raises:
        Diverged: see there.
        UsageError: a checkpoint cannot be written.
        V2VError: what the stream raises. It costs no steps: they are saved first.
    """
    run, device = config.run, ranks.device
    bfloat16 = config.compute.precision == "bfloat16"
    clip = config.optimizer.clip_gradient_norm or math.inf
    parameters = list(learner.network.parameters())

    # Where to begin in the stream.
    dataset = stream(config, address)
    step, epoch, position = 0, 0, None
    if resume is not None:
        learner.restore(resume)
        step, epoch, position = resume.step, resume.epoch, resume.stream
        if position is not None:
            dataset.load_state_dict(position)
        if dataset.epoch > epoch:
            # Under this batch size or number of ranks, nothing but what an epoch drops was left of the one before.
            learner.end_epoch()
            epoch, position = dataset.epoch, dataset.state_dict()
    feed = Feed(dataset, device, config.stream.loader_workers)
    batches = feed.epochs(epoch, run.epochs)
    if run.steps:
        batches = islice(batches, max(0, run.steps - step))
    shown = stop.next(preview_batch(config, address)) if ranks.first and run.preview_every else None

    meter = Meter(ranks)
    begun, saved = step, None

    def look() -> None:
        """Read the meter: from time to time, and always before anything is saved."""
        values = meter.read(feed.wait_seconds)
        if not values:
            return
        if not math.isfinite(values["total"] + values["gradient_norm"]):
            kept = (
                "nothing was saved since this start"
                if saved is None
                else f"{out / LAST} is of step {saved}, before that"
            )
            raise Diverged(
                f"step {step}: loss {values['total']}, gradient norm {values['gradient_norm']} since the last reading; "
                f"{kept}. Try a lower optimizer.learning_rate or optimizer.clip_gradient_norm"
            )
        reporter.metrics(step, epoch, float(learner.scheduler.get_last_lr()[0]), values)

    def save(name: str) -> None:
        if not ranks.first:
            return
        try:
            save_checkpoint(out / name, learner.checkpoint(step, position, config))
        except OSError as error:
            raise UsageError(
                f"step {step} cannot be saved as {out / name}: {error.strerror}; what was saved before is as it was"
            ) from error

    with Reporter(out, speaks=ranks.first, step=step) as reporter:
        for batch in stop.until(batches):
            voxels, target = batch.arrays["voxels"], batch.arrays["frames"] / 255.0

            # Forward, backward, update: work for the device is queued, and nothing here waits for it.
            with torch.autocast(device.type, torch.bfloat16, enabled=bfloat16):
                prediction, _ = learner.model(voxels)
                losses = learner.loss(prediction, target, learner.flow_of(batch, target))
            learner.optimizer.zero_grad()
            losses["total"].backward()
            norm = clip_grad_norm_(parameters, clip)
            learner.optimizer.step()
            step, epoch, position = step + 1, batch.epoch, batch.resume_state
            if learner.average is not None:
                learner.average.update(learner.network, step)
            epoch_ends = position["epoch"] > epoch
            if epoch_ends:
                learner.end_epoch()

            # What is said and kept of it.
            meter.add(losses | {"gradient_norm": norm})
            reporter.advance(step, dataset, config)
            keep = epoch_ends and run.keep_epochs
            if step % run.log_every == 0 or step % run.save_every == 0 or keep:
                look()
            if step % run.save_every == 0:
                save(LAST)
                saved = step
            if keep:
                save(f"epoch-{epoch:04d}.pt")
            if shown is not None and step % run.preview_every == 0:
                reporter.preview(step, films(learner.trained, shown, device))
        # Data that failed before the first step leave nothing to keep: the folder stays as it was, free for a new run.
        if saved != step and (step > begun or stop.failure is None):
            look()
            save(LAST)
        if shown is not None and step % run.preview_every:
            reporter.preview(step, films(learner.trained, shown, device))
    if stop.failure is not None:
        raise stop.failure
    return step
