"""Reports of a run: a progress bar, ``metrics.jsonl``, TensorBoard scalars, pictures and videos."""

from __future__ import annotations

import contextlib
import json
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

import torch
from rich.console import Console
from torch import Tensor

from trainer.config import TrainConfig
from trainer.config_file import show_config
from trainer.pictures import Image, Video, add_header, contact_sheet
from trainer.run.board import Board
from trainer.run.checkpoint import unwritable
from trainer.run.distributed import Ranks
from v2v_client import V2VStreamDataset
from v2v_pictures.files import png_bytes
from v2v_protocol.errors import UsageError
from v2v_protocol.progress import Progress
from v2v_protocol.write_aside import write_aside_and_rename

METRICS_FILE = "metrics.jsonl"
CONFIGURATION = "config.yaml"
_FRAMES_PER_SECOND = 8


class Meter:
    """Means over the steps since the last reading, summed on the device; only :meth:`read` waits for it."""

    def __init__(self, ranks: Ranks) -> None:
        self._ranks = ranks
        self._names: tuple[str, ...] = ()
        self._sum: Tensor | None = None
        self._steps = 0
        self._began = time.perf_counter()
        self._waited = self._transferred = 0.0

    def add(self, values: Mapping[str, Tensor]) -> None:
        """Add the scalars of one step; the names are the same each time."""
        self._names = tuple(values)
        stacked = torch.stack([value.detach().float() for value in values.values()])
        self._sum = stacked if self._sum is None else self._sum + stacked
        self._steps += 1

    def read(self, wait_seconds: float, transfer_seconds: float = 0.0) -> dict[str, float]:
        """Return means over steps and ranks, and the speed, and reset. All ranks call it.

        Args:
            wait_seconds, transfer_seconds: time spent waiting for data, and bringing it to the device, since the run
                began.

        Returns:
            The scalars by name; ``steps_per_second``; ``data_wait_seconds``, ``transfer_seconds`` and the rest,
            ``compute_seconds``, per step. Empty without a step.
        """
        if self._sum is None:
            return {}
        means = self._ranks.mean(self._sum / self._steps).tolist()
        now = time.perf_counter()
        seconds, waited = now - self._began, wait_seconds - self._waited
        transferred = transfer_seconds - self._transferred
        record = dict(zip(self._names, means, strict=True)) | {
            "steps_per_second": self._steps / seconds,
            "data_wait_seconds": waited / self._steps,
            "transfer_seconds": transferred / self._steps,
            "compute_seconds": (seconds - waited - transferred) / self._steps,
        }
        self._sum, self._steps, self._began = None, 0, now
        self._waited, self._transferred = wait_seconds, transfer_seconds
        return record


class Reporter:
    """Writes and prints the reports on the first rank; does nothing on the others.

    Args:
        out: folder of the run.
        speaks: whether this is the first rank.
        step: step at which the run continues. Readings of later steps are dropped; with 0, all of them.

    Raises:
        UsageError: the folder cannot be written (every method raises this too), or readings of an earlier run are
            damaged, other than by a cut at their end.
    """

    def __init__(self, out: Path, *, speaks: bool, step: int = 0) -> None:
        self._out = out
        self._console = Console(highlight=False, quiet=not speaks)
        self._board: Board | None = None
        self._first = self._step = step
        self._planned = False
        self._total: int | None = None
        self._held_out: float | None = None
        self._seconds = 0.0
        self._began = time.perf_counter()
        # Without a terminal, each reading is a line.
        has_bar = speaks and self._console.is_terminal
        self._progress = Progress("training", "steps", console=self._console, shows_rate=False) if has_bar else None
        self._last_note = ""
        if speaks:
            with self._writing(METRICS_FILE):
                out.mkdir(parents=True, exist_ok=True)
                _drop_after(out / METRICS_FILE, step)
            with self._writing("tensorboard"):
                self._board = Board(out / "tensorboard", step + 1 if step else 0)

    def __enter__(self) -> Reporter:
        return self

    def __exit__(
        self, _kind: type[BaseException] | None, error: BaseException | None, _trace: TracebackType | None
    ) -> None:
        if self._progress is not None:
            self._progress.close()
        if self._board is None:
            return
        try:
            self._board.close()
        except OSError as refused:
            if error is None:  # else the first error is the one to report
                raise unwritable(self._out, "tensorboard", refused) from refused

    @contextlib.contextmanager
    def _writing(self, name: str) -> Iterator[None]:
        """Turn an error of writing ``name`` in the folder of the run into one line with the remedy."""
        try:
            yield
        except OSError as error:
            raise unwritable(self._out, name, error) from error

    def advance(self, step: int, dataset: V2VStreamDataset, config: TrainConfig) -> None:
        """Update the progress after a step was queued; the first call computes the number of steps."""
        self._step = step
        if not self._planned:
            self._planned, self._seconds, self._total = True, config.run.seconds, _planned_steps(dataset, config)
        if self._progress is not None:
            self._progress(step, self._total, self._last_note)

    def metrics(self, step: int, epoch: int, learning_rate: float, values: Mapping[str, float]) -> None:
        """Record a reading of the meter."""
        if self._board is None:
            return
        self._write({"step": step, "epoch": epoch, "learning_rate": learning_rate, **values})
        note = self._note(values)
        self._last_note = note
        if self._progress is None:
            self._console.print(
                f"step {step}{f'/{self._total}' if self._total else ''}  {note}", markup=False, soft_wrap=True
            )

    def held_out(self, step: int, values: Mapping[str, float]) -> None:
        """Record the losses of the batch that is not trained on."""
        self._held_out = values["total"]
        self._write({"step": step} | {f"held_out_{name}": value for name, value in values.items()})

    def validated(self, step: int, scores: Mapping[str, float]) -> bool:
        """Record scores on recordings; return whether the first of them is the lowest of this run so far.

        False on all ranks but the first.
        """
        if self._board is None:
            return False
        decisive = f"validation_{next(iter(scores))}"
        before = [record[decisive] for record in self._records() if decisive in record]
        self._write({"step": step} | {f"validation_{name}": value for name, value in scores.items()})
        return all(scores[decisive.removeprefix("validation_")] < value for value in before)

    def is_validated(self, step: int) -> bool:
        """Return whether there are scores of this step on recordings."""
        names = [name for record in self._records() if record["step"] == step for name in record]
        return any(name.startswith("validation_") for name in names)

    def _records(self) -> list[dict[str, Any]]:
        with self._writing(METRICS_FILE):
            return read_metrics(self._out / METRICS_FILE) if (self._out / METRICS_FILE).exists() else []

    def configuration(self, config: TrainConfig) -> None:
        """Write all keys of the run to a file that ``v2v-train`` takes."""
        if self._board is not None:
            with self._writing(CONFIGURATION):
                (self._out / CONFIGURATION).write_text(show_config(config), "utf-8")

    def _write(self, record: Mapping[str, Any]) -> None:
        if self._board is None:
            return
        with self._writing(METRICS_FILE), (self._out / METRICS_FILE).open("a", encoding="utf-8") as file:
            file.write(json.dumps(record) + "\n")
        with self._writing("tensorboard"):
            for name, value in record.items():
                if name != "step":
                    group = "held_out" if name.startswith("held_out_") else _GROUPS.get(name, "loss")
                    self._board.scalar(f"{group}/{name.removeprefix('held_out_')}", value, record["step"])

    def preview(self, step: int, films: Sequence[Image], panels: Sequence[str]) -> None:
        """Write films of a task, one per sample, equally large; ``panels`` names what they show side by side."""
        if self._board is None:
            return
        with self._writing("previews"):
            (self._out / "previews").mkdir(exist_ok=True)
            for number, film in enumerate(films):
                sheet = add_header(contact_sheet(film), panels, f"step {step}", time_runs_down=True)
                path = self._out / "previews" / f"step-{step:07d}-{number}"
                path.with_suffix(".png").write_bytes(png_bytes(sheet))
                with Video(path.with_suffix(".mp4"), _FRAMES_PER_SECOND) as video:
                    for image in film:
                        video.add(add_header(image, panels))
                self._board.picture(f"preview/{number}", sheet, step)

    def _note(self, values: Mapping[str, float]) -> str:
        wait = values["data_wait_seconds"]
        spent = time.perf_counter() - self._began
        left = self._seconds - spent if self._seconds else math.inf
        if self._total:
            left = min(left, (self._total - self._step) * spent / max(1, self._step - self._first))
        # The loss of a step swings with its samples; that of the held-out batch shows what is learnt. It is shown once:
        # later readings would repeat a value that was not measured then.
        held_out = "" if self._held_out is None else f"held out {self._held_out:.4f}  "
        self._held_out = None
        return (
            f"{held_out}loss {values['total']:.4f}  {values['steps_per_second']:.2f} it/s  "
            f"data wait {wait * values['steps_per_second']:.0%}  ETA {_clock(max(0.0, left))}"
        )


_GROUPS = {
    **dict.fromkeys(("steps_per_second", "data_wait_seconds", "transfer_seconds", "compute_seconds"), "speed"),
    **dict.fromkeys(("epoch", "learning_rate", "gradient_norm"), "optimizer"),
}


def read_metrics(path: Path) -> list[dict[str, Any]]:
    """Return the records of a ``metrics.jsonl``.

    An incomplete last line is left out: it is still being written, or its writer was killed.

    Raises:
        UsageError: another line is not a record; the message gives its number.
    """
    *lines, torn = path.read_text(encoding="utf-8", errors="replace").split("\n")
    records = [_record(line) for line in [*lines, torn]]
    if records[-1] is None:
        del records[-1]
    for number, record in enumerate(records, start=1):
        if record is None:
            raise UsageError(f"{path}, line {number}, is no record of a run: remove the line, or the file")
    return [record for record in records if record is not None]


def _record(line: str) -> dict[str, Any] | None:
    try:
        record = json.loads(line)
    except ValueError:
        return None
    return record if isinstance(record, dict) and "step" in record else None


def _planned_steps(dataset: V2VStreamDataset, config: TrainConfig) -> int | None:
    """Return the number of steps of the whole run; None if only a time limit ends it."""
    if config.run.seconds and not config.run.steps:
        return None
    steps = config.run.epochs * len(dataset)
    return min(steps, config.run.steps or steps)


def _drop_after(path: Path, step: int) -> None:
    """Drop the records that a run will write again: those after ``step``, and with 0 all of them."""
    if path.exists():
        records = read_metrics(path) if step else []
        kept = [json.dumps(record) + "\n" for record in records if record["step"] <= step]
        with write_aside_and_rename(path, durable=True) as partial:
            partial.write_text("".join(kept), encoding="utf-8")


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
