"""The training loop: one page, read from top to bottom. It knows no task by name."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import chain, islice
from pathlib import Path

from trainer.config import TrainConfig
from trainer.feed import Feed, held_out_batch, streams
from trainer.learner import Learner
from trainer.run.checkpoint import BEST, LAST, Checkpoint, epoch_name, prune_epochs, save_checkpoint, unwritable
from trainer.run.distributed import Ranks
from trainer.run.interruption import StopRequest
from trainer.run.reporting import Meter, Reporter
from trainer.run.validation import Validation
from v2v_protocol.errors import UsageError, V2VError


class Diverged(V2VError):
    """A loss or gradient is infinite or not a number; nothing is saved after it."""


def train(
    config: TrainConfig,
    learner: Learner,
    addresses: Sequence[str],
    ranks: Ranks,
    stop: StopRequest,
    out: Path,
    resume: Checkpoint | None = None,
) -> int:
    """Train to the configured end, or until ``stop``, and save ``out/last.pt`` to resume from.

    Args:
        addresses: of the server of each stream of ``config.stream.mixed``.

    Returns:
        Optimiser steps so far, including those before ``resume``.

    Raises:
        Diverged: a loss or gradient is not finite.
        UsageError: the folder cannot be written, the server refuses ``resume``, or a recording cannot be scored.
        V2VError: the stream failed; the steps so far are saved first.
    """
    run, task = config.run, learner.task

    # Where to begin in the stream.
    dataset = streams(config, task.asked, addresses)
    step, epoch, position = 0, 0, None
    if resume is not None:
        learner.restore(resume)
        step, epoch, position = resume.step, resume.epoch, resume.stream
        if position is not None:
            dataset.load_state_dict(position)
        if dataset.epoch > epoch:
            # With this batch size or number of ranks, the rest of the epoch has no whole batch.
            epoch, position = dataset.epoch, dataset.state_dict()
    feed = Feed(dataset, ranks.device, config.stream.loader_workers)
    batches = feed.epochs(epoch, run.epochs)
    if run.steps:
        batches = islice(batches, max(0, run.steps - step))
    judges = ranks.first and (run.judge_every or run.preview_every)
    held_out = stop.next(held_out_batch(config, task.asked, addresses[0])) if judges else None
    validation = Validation(task, learner.trained, run, ranks) if run.validate else None
    # The first batch comes before anything is written: a server that refuses the run leaves its folder untouched.
    taken = stop.until(batches)
    first = list(islice(taken, 1))
    if not first and ranks.any(stop.failure is not None):
        raise stop.failure or UsageError("another rank got no data: see its message")

    meter = Meter(ranks)
    begun, saved, judged = step, None, step

    def look() -> None:
        """Read the meter and stop a run that has diverged; called before each save."""
        values = meter.read(feed.wait_seconds, feed.transfer_seconds)
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
        reporter.metrics(step, epoch, learner.optimizer.param_groups[0]["lr"], values)

    def judge(*, with_films: bool) -> None:
        """Report the losses, and films, of the held-out batch."""
        assert held_out is not None
        values, films = task.judge(learner.trained, held_out, run.preview_samples if with_films else 0)
        reporter.held_out(step, values)
        reporter.preview(step, films, task.panels)

    def save(name: str) -> None:
        if not ranks.first:
            return
        try:
            save_checkpoint(out / name, learner.checkpoint(step, position))
            if name not in (LAST, BEST):
                prune_epochs(out, run.keep_epochs)
        except OSError as error:
            raise UsageError(f"step {step} cannot be saved as {unwritable(out, name, error)}") from error

    def validate(epochs: int) -> None:
        """Score the network on recordings after ``epochs`` whole epochs, if that is due, and keep the best."""
        nonlocal saved
        if validation is None or epochs % run.validate_every != 0:
            return
        look()
        if saved != step and step > begun:
            save(LAST)  # validation may take long, and fail
            saved = step
        scores = validation(baseline=epochs == run.validate_every, stopping=lambda: stop.signal > 0)
        if scores and reporter.validated(step, scores):
            save(BEST)

    with Reporter(out, speaks=ranks.first, step=step) as reporter:
        reporter.configuration(config)
        if held_out is not None and first and step == 0:
            judge(with_films=False)
        if validation is not None and not ranks.from_first(step == 0 or reporter.is_validated(step)):
            # The run ended during this validation.
            if position is not None and position["position"] == 0:
                validate(epoch)
            if ranks.any(stop.wanted):
                first.clear()
        for batch in chain(first, taken):
            first.clear()  # its memory is free once its step is done
            values = learner.step(task.prepare(batch, batch.epoch), step, batch.epoch)
            step, epoch, position = step + 1, batch.epoch, batch.resume_state

            # Report and save.
            meter.add(values)
            reporter.advance(step, dataset, config)
            ended = position["epoch"] > epoch
            keep = run.keep_epochs and ended
            if held_out is not None:
                shown = run.preview_every and step % run.preview_every == 0
                if shown or (run.judge_every and step % run.judge_every == 0):
                    judge(with_films=bool(shown))
                    judged = step
            if step % run.log_every == 0 or step % run.save_every == 0 or keep:
                look()
            if step % run.save_every == 0:
                save(LAST)
                saved = step
            if keep:
                save(epoch_name(epoch))
            if ended:
                validate(epoch + 1)
        # If the data failed before the first step, nothing is saved, so that the folder is free for a new run.
        if saved != step and (step > begun or stop.failure is None):
            look()
            save(LAST)
        if held_out is not None and judged != step:
            judge(with_films=bool(run.preview_every))
    if stop.failure is not None:
        raise stop.failure
    return step
