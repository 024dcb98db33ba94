"""What a person sees of a running server: the summary at the start, and lines of figures."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import TextIO

from v2v_protocol.refusal import Refusal
from v2v_protocol.spec import StreamSpec
from v2v_server.corpus.catalogue import Catalogue
from v2v_server.schedule.sequences import SequenceTable
from v2v_server.status.state import CacheState, ServiceState
from v2v_server.system.log import write

_SHOWN = 5
_LOG_SECONDS = 10.0


def summary(catalogue: Catalogue, spec: StreamSpec, table: SequenceTable, *, list_refused: bool = False) -> list[str]:
    """Lines that say how many sequences there are, which videos give none, and which setting would admit them.

    Args:
        catalogue, spec, table: of the server.
        list_refused: names all of those videos, not only the first few.
    """
    recipe = spec.recipe
    lines = [
        f"{len(catalogue.videos)} videos in {catalogue.root}: {table.videos} give {table.count} sequences of "
        f"{recipe.frames_needed} frames (at most {spec.max_sequences_per_video} a video), rows {catalogue.rows}"
    ]
    if spec.scene != "off":
        split = 0 if catalogue.videos.split is None else len(catalogue.videos.split)
        lines.append(
            f"scene {spec.scene}: {split} videos have shot boundaries or empty parts; {table.spoilt} sequences are "
            "left out or moved"
        )
    if table.refusals:
        lines.append(f"{len(table.refusals)} videos give none under the server's own recipe:")
        lines += _listed(table.refusals, list_refused)
        lines += _shorter_clips(table)
    if catalogue.refusals:
        lines.append(f"{len(catalogue.refusals)} files cannot be used at all:")
        lines += _listed(catalogue.refusals, list_refused)
    return lines


def _listed(refused: Sequence[Refusal], all_of_them: bool) -> list[str]:
    shown = refused if all_of_them else refused[:_SHOWN]
    rest = len(refused) - len(shown)
    return [f"  {line}" for line in shown] + ([f"  ... and {rest} more: --list-refused names all"] if rest else [])


def _shorter_clips(table: SequenceTable) -> list[str]:
    """How many of the videos that are too short a shorter clip would admit: half of them, and all."""
    longest = sorted(table.longest_clips, reverse=True)
    if not longest:
        return []
    choices = dict.fromkeys((longest[(len(longest) - 1) // 2], longest[-1]))
    shown = ", ".join(f"{choice} admits {sum(voxels >= choice for voxels in longest)}" for choice in choices)
    return [f"  with --set voxels_per_clip=N (now the longest that fits is {longest[0]}): {shown} of them"]


class StatusLine:
    """A line every ten seconds, for what is no terminal.

    Args:
        stream: where to.
    """

    def __init__(self, stream: TextIO = sys.stderr) -> None:
        self._stream = stream
        self._next = 0.0

    def is_due(self, now: float) -> bool:
        """Whether it is time to show the state again."""
        return now >= self._next

    def show(self, now: float, state: ServiceState) -> None:
        """Shows the state."""
        self._next = now + _LOG_SECONDS
        write(self._stream, figures(state) + "\n")

    def interrupt(self) -> None:
        """Something else is about to be printed: nothing is in its way."""

    def close(self) -> None:
        """No more is shown."""


def figures(state: ServiceState) -> str:
    """Rates and counts in one line."""
    totals = state.totals
    achieved = ""
    if 0 < totals.decodes < totals.samples:
        achieved = f"{totals.samples / totals.decodes:.1f} a decode  "
    # Nothing where all come in messages: consumers elsewhere, or a container between worker and consumer.
    share = totals.in_slots / totals.samples if totals.samples else 0.0
    shared = f"{share:.0%} by shared memory  " if share else ""
    return (
        f"{state.batches_per_second:.2f} batches/s  {state.samples_per_second:.1f} samples/s  "
        f"{achieved}{shared}{_of_cache(state.cache)}"
        f"workers {state.worker_count}/{max(state.worker_processes, state.worker_count)}  "
        f"consumers {state.consumer_count}  queue {state.queue}  faults {totals.faults}  total {totals.samples} samples"
    )


def _of_cache(cache: CacheState | None) -> str:
    read = 0 if cache is None else cache.hits + cache.misses
    if cache is None or not read:
        return ""
    held = f", {cache.held_gib:.2f} of {cache.most_gib:g} GiB" if cache.folder else ""
    trouble = f" ({cache.trouble})" if cache.trouble else ""
    return f"cache {cache.hits / read:.0%} hits{held}{trouble}  "
