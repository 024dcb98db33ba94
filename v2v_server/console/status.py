"""What a person sees of a running server: the summary at the start and one live line."""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import TextIO

from v2v_protocol.refusal import Refusal
from v2v_protocol.spec import StreamSpec
from v2v_server.broker.counters import Counters
from v2v_server.broker.dispatcher import Dispatcher
from v2v_server.catalogue.catalogue import Catalogue
from v2v_server.schedule.sequences import SequenceTable
from v2v_server.store.cache import GIB, used_bytes

_SHOWN = 5
_LIVE_SECONDS = 0.5
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
        cut = sum(video.runs != ((0, video.frames),) for video in catalogue.videos)
        lines.append(
            f"scene {spec.scene}: {cut} videos have cuts or empty parts; {table.spoilt} sequences are left out or moved"
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


def write(stream: TextIO, text: str) -> None:
    """Says something to whoever looks on. That the log's disk is full, or its terminal gone, must not end a service;
    and there is nowhere left to say so."""
    with suppress(OSError):
        stream.write(text)
        stream.flush()


class Rate:
    """Events a second over the last few seconds.

    Args:
        window_seconds: how far back it looks.
    """

    def __init__(self, window_seconds: float) -> None:
        self._window_seconds = window_seconds
        self._points: deque[tuple[float, float]] = deque()

    def update(self, now: float, total: float) -> float:
        """Notes the running total and returns the rate since the window's beginning (0.0 before two notes)."""
        self._points.append((now, total))
        while len(self._points) > 2 and now - self._points[0][0] > self._window_seconds:
            self._points.popleft()
        (then, before), (_, after) = self._points[0], self._points[-1]
        return (after - before) / (now - then) if now > then else 0.0


class StatusLine:
    """One line that is kept up to date on a terminal, or printed every ten seconds into a log.

    Args:
        stream: where to.
        cache: folder of the cache; None: there is none on this host.
        cache_gib: how much it may hold.
    """

    def __init__(self, stream: TextIO = sys.stderr, cache: Path | None = None, cache_gib: float = 0.0) -> None:
        self._stream = stream
        self._cache, self._cache_gib = cache, cache_gib
        self._live = stream.isatty()
        self._period = _LIVE_SECONDS if self._live else _LOG_SECONDS
        self._next = 0.0
        self._batches = Rate(window_seconds=5.0)
        self._samples = Rate(window_seconds=5.0)
        self._width = 0

    def update(self, now: float, dispatcher: Dispatcher, running: int) -> None:
        """Shows the state if it is time to."""
        if now < self._next:
            return
        self._next = now + self._period
        self._show(self._text(now, dispatcher, running))

    def interrupt(self) -> None:
        """Clears the live line, because something else is about to be printed."""
        if self._live and self._width:
            write(self._stream, "\r" + " " * self._width + "\r")
            self._width = 0

    def close(self) -> None:
        """Leaves the last line standing."""
        if self._live and self._width:
            write(self._stream, "\n")

    def _text(self, now: float, dispatcher: Dispatcher, running: int) -> str:
        counters = dispatcher.counters
        achieved = ""
        if 0 < counters.decodes < counters.samples:
            achieved = f"{counters.samples / counters.decodes:.1f} a decode  "
        # Nothing where all come in messages: consumers elsewhere, or a container between worker and consumer.
        share = counters.in_slots / counters.samples if counters.samples else 0.0
        shared = f"{share:.0%} by shared memory  " if share else ""
        return (
            f"{self._batches.update(now, counters.batches):.2f} batches/s  "
            f"{self._samples.update(now, counters.samples):.1f} samples/s  "
            f"{achieved}{shared}{self._of_cache(counters)}"
            f"workers {dispatcher.workers}/{max(running, dispatcher.workers)}  consumers {len(dispatcher.sessions)}  "
            f"queue {dispatcher.waiting}  faults {counters.faults}  total {counters.samples} samples"
        )

    def _of_cache(self, counters: Counters) -> str:
        read = counters.cache_hits + counters.cache_misses
        if not read:
            return ""
        held = "" if self._cache is None else f", {used_bytes(self._cache) / GIB:.2f} of {self._cache_gib:g} GiB"
        trouble = f" ({counters.cache_trouble})" if counters.cache_trouble else ""
        return f"cache {counters.cache_hits / read:.0%} hits{held}{trouble}  "

    def _show(self, text: str) -> None:
        if self._live:
            write(self._stream, "\r" + text.ljust(self._width))
            self._width = len(text)
        else:
            write(self._stream, text + "\n")
